"""Packs on disk: written whole, and read as data, whoever made them."""

from __future__ import annotations

import hashlib
import io
import json
import os
import secrets
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from pipeline.digests import FIELD, RECORD, RecordedFiles, read_record
from pipeline.errors import UserError, one_line, shown
from pipeline.files import portable_name, put_in_place, replacing, settle
from pipeline.models.find import run_in
from pipeline.module_records import COPIES
from pipeline.packing.pack_contents import STUDY_RECORD, contents
from pipeline.packing.scrubbing import zipped
from safe_files.archives import opened_zip, read_member, read_members
from safe_files.files import MAX_ARCHIVE_BYTES, Budget, UnsafeFileError, read_file

_DEEPEST = 2  # folders of a name, the file itself counted
_DEEPEST_MODULE = 8
_DEEPEST_OF_STUDY = 3
_MOST, _MOST_OF_STUDY = 1000, 100_000  # files
_LONGEST_NAME = 255
_DAMAGE = (OSError, ValueError, LookupError, RuntimeError, EOFError, zipfile.BadZipFile)


def pack(run_folder: Path, target: Path) -> Path:
    """Write a finished run as a pack that can be given to others.

    Args:
        run_folder: the run.
        target: a folder that is not there yet, or a file ``.zip``, which is replaced.

    Returns:
        The target.

    Raises:
        UserError: if the run cannot be packed, or the target cannot be written.
    """
    if not target.absolute().parent.is_dir():
        raise UserError(f"there is no folder {target.parent} to write the pack in")
    is_zip = target.suffix == ".zip"
    if target.is_dir() if is_zip else (target.exists() or target.is_symlink()):
        raise UserError(f"{target} is there already: name another place for the pack")
    files = contents(run_folder)
    for name in files:
        check_name(name)
    if len(files) > _MOST:
        raise UserError(f"{run_folder} has modules of more files than a pack holds, {_MOST:,}")
    if is_zip:
        with replacing(target) as file:
            file.write(zipped(dict(sorted(files.items()))))
        return target
    draft = target.with_name(f".{target.name}.{secrets.token_hex(8)}.tmp")
    draft.mkdir()
    try:
        _write(draft, files)
        settle(draft)
        put_in_place(draft, target)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return target


def check_pack(path: Path) -> int:
    """Hold every file of a pack against its digest.

    Args:
        path: its folder or zip.

    Returns:
        How many files there are.

    Raises:
        UserError: if one is missing or changed, or it is no pack.
    """
    if is_packed(path, STUDY_RECORD):
        return _check_study(path)
    with unpacked(path) as (folder, _):
        if not (folder / RECORD).is_file():
            raise UserError(f"{path} is no pack: it holds no {RECORD}")
        return _check_files(folder, path)


def _check_files(folder: Path, shown_as: Path, names: Collection[str] = ()) -> int:
    """Hold the files of a pack against their digests; the number of them.

    Args:
        folder: where they lie.
        shown_as: what the pack is called in a message.
        names: those that there may be, where there may be no others.
    """
    try:
        digests = read_record(folder / RECORD).get(FIELD)
        if not isinstance(digests, dict):
            raise UserError(f"{RECORD} lists no files")
        if strange := set(names) - digests.keys():
            raise UserError(f"{shown(min(strange))} is not among the files that {RECORD} lists")
        for name in digests.keys() - {RECORD}:
            check_name(name)
            RecordedFiles(folder, digests).check(folder / name)
    except (UserError, UnsafeFileError) as error:
        reason = one_line(error).replace(f"{folder}{os.sep}", "")
        raise UserError(f"{shown_as} is not as it was packed: {reason}") from error
    return len(digests)


def _check_study(path: Path) -> int:
    """The same for the pack of a study."""
    try:
        with _opened_study(path) as (read, names):
            record = json.loads(read(STUDY_RECORD))
            digests = record.get("files") if isinstance(record, dict) else None
            if not isinstance(digests, dict) or digests.keys() != names - {STUDY_RECORD}:
                raise UnsafeFileError(f"{STUDY_RECORD} does not list its files, and no others")
            for name, digest in digests.items():
                if hashlib.sha256(read(name)).hexdigest() != digest:
                    raise UnsafeFileError(f"{shown(name)} is not as the record says")
    except _DAMAGE as error:
        raise UserError(f"{path} is not as it was packed: {one_line(error)}") from error
    return len(names)


@contextmanager
def _opened_study(path: Path) -> Iterator[tuple[Callable[[str], bytes], set[str]]]:
    """What reads a file in the pack of a study, and the names of all, none of which leads away."""
    content = read_file(path, MAX_ARCHIVE_BYTES)
    with opened_zip(content, Budget(len(content))) as archive:
        infos = archive.infolist()
        if len(infos) > _MOST_OF_STUDY:
            raise UnsafeFileError(f"holds more than {_MOST_OF_STUDY:,} files")
        _check_members(infos, _DEEPEST_OF_STUDY)

        def read(name: str) -> bytes:
            info = archive.getinfo(name)
            # Twice: Python puts it together from pieces. Not by what the zip says of its own size.
            Budget(len(content)).charge(2 * info.file_size)
            return read_member(archive, info)

        yield read, {info.filename for info in infos}


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[Path, Path | None]]:
    """The folder of a pack; of a zip a temporary one, with nothing in it but what its record lists.

    Any other path is given as it is.

    Args:
        path: of anything; of a zip, its suffix may be missing. In the pack of a study, a run is
            ``study.zip/runs/<agent>/<run>.zip``.

    Yields:
        The folder, and the zip that it was unpacked from, or None.

    Raises:
        UserError: if the zip holds anything that a pack may not, or not what its record says.
    """
    beside = path.with_name(f"{path.name}.zip") if path.name else path
    path = beside if not path.exists() and is_packed(beside) else path
    study = next((above for above in path.parents if is_packed(above, STUDY_RECORD)), None)
    if study is None and not is_packed(path):
        if is_packed(path, STUDY_RECORD):
            raise UserError(f"{path} is the pack of a study: name one of its runs, {_a_run(path)}")
        yield path, None
        return
    try:
        if study is None:
            content = read_file(path, MAX_ARCHIVE_BYTES)
        else:
            content = _run_of(study, path.relative_to(study).as_posix())
        files = _members(content)
    except _DAMAGE as error:
        raise UserError(f"{path} is no pack that may be opened: {one_line(error)}") from error
    with tempfile.TemporaryDirectory(prefix="yardstick-pack-") as name:
        folder = Path(name) / path.stem
        folder.mkdir()
        _write(folder, files)
        _check_files(folder, path, files.keys())
        yield folder, study or path


def _run_of(study: Path, name: str) -> bytes:
    """The pack of a run in the pack of a study; its suffix may be missing."""
    with _opened_study(study) as (read, names):
        found = next((n for n in (name, f"{name}.zip") if n in names), None)
        if found is None:
            raise UserError(
                f"{study} holds no {shown(name)}: name one of its runs, {_a_run(study)}"
            )
        return read(found)


def _a_run(study: Path) -> str:
    """An example of the runs in the pack of a study."""
    with _opened_study(study) as (_, names):
        runs = sorted(name for name in names if name.endswith(".zip"))
        return f"such as {study}/{runs[0]}" if runs else "but it holds none"


def is_packed(path: Path, record: str = RECORD) -> bool:
    """Whether a file is a zip with the record of a run in it, as no model has, or of a study."""
    if not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return record in archive.namelist()
    except _DAMAGE:
        return False


def _members(content: bytes) -> Mapping[str, bytes]:
    """The files in a zip, whose names lie inside of it.

    Raises:
        UnsafeFileError: if there is a link, a name that leads elsewhere, or too much.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        _check_members(archive.infolist())
    return read_members(content, most=_MOST)


def _check_members(infos: Collection[zipfile.ZipInfo], deepest: int = _DEEPEST) -> None:
    """Refuse members that would not be files of their own, inside of the folder.

    Raises:
        UnsafeFileError: naming one.
    """
    for info in infos:
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG):
            raise UnsafeFileError(f"holds {shown(info.filename)}, which is no regular file")
        check_name(info.filename, deepest)
    names = [info.filename for info in infos]
    if len({name.casefold() for name in names}) < len(names):
        raise UnsafeFileError("holds two names that some systems take for one")
    folders = {str(parent) for name in names for parent in PurePosixPath(name).parents}
    if not folders.isdisjoint(names):
        raise UnsafeFileError("holds a file that is a folder too")


def check_name(name: str, deepest: int = _DEEPEST) -> None:
    """Refuse a name that leads elsewhere, or that some file system does not take.

    Raises:
        UnsafeFileError: naming it.
    """
    parts = name.split("/")
    deepest = _DEEPEST_MODULE if parts[0] == COPIES else deepest
    good = all(
        part not in ("", ".", "..") and portable_name(part, _LONGEST_NAME) == part for part in parts
    )
    if len(parts) > deepest or not good:
        raise UnsafeFileError(f"holds {shown(name)}, which would lie elsewhere")


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as file:
            file.write(content)


def default_target(run_folder: Path) -> Path:
    """A name for the pack of a run, in the present folder: agent, environment, seed."""
    run = run_in(run_folder)
    spec = run.recorded_spec()
    name = "-".join(str(spec.get(key)) for key in ("algo", "env_id", "seed"))
    return Path(portable_name(name.replace("/", "-").replace(":", "-")))
