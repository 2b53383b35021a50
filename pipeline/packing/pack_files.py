"""Packs on disk: written whole, and read as data, whoever made them."""

from __future__ import annotations

import io
import os
import secrets
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from pipeline.errors import UserError, one_line, shown
from pipeline.file_digests import FIELD, RECORD, RecordedFiles, read_record
from pipeline.files import portable_name, put_in_place, replacing, settle
from pipeline.models.recorded_runs import run_in
from pipeline.packing.pack_contents import contents
from pipeline.packing.scrubbing import zipped
from safe_files.archives import read_members
from safe_files.limits import MAX_ARCHIVE_BYTES
from safe_files.refusals import UnsafeFileError
from safe_files.regular_files import read_file

_DEEPEST = 2  # folders of a name, the file itself counted
_LONGEST_NAME = 255


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
    with unpacked(path) as folder:
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
            _check_name(name)
            RecordedFiles(folder, digests).check(folder / name)
    except (UserError, UnsafeFileError) as error:
        reason = one_line(error).replace(f"{folder}{os.sep}", "")
        raise UserError(f"{shown_as} is not as it was packed: {reason}") from error
    return len(digests)


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """The folder of a pack; of a zip a temporary one, with nothing in it but what its record lists.

    Any other path is given as it is.

    Args:
        path: of anything; of a zip, its suffix may be missing.

    Raises:
        UserError: if the zip holds anything that a pack may not, or not what its record says.
    """
    beside = path.with_name(f"{path.name}.zip") if path.name else path
    path = beside if not path.exists() and is_packed(beside) else path
    if not is_packed(path):
        yield path
        return
    try:
        files = _members(read_file(path, MAX_ARCHIVE_BYTES))
    except (OSError, ValueError, RuntimeError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path} is no pack that may be opened: {one_line(error)}") from error
    with tempfile.TemporaryDirectory(prefix="yardstick-pack-") as name:
        folder = Path(name) / path.stem
        folder.mkdir()
        _write(folder, files)
        _check_files(folder, path, files.keys())
        yield folder


def is_packed(path: Path) -> bool:
    """Whether a file is a zip with the record of a run in it, as no model has."""
    if not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return RECORD in archive.namelist()
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return False


def _members(content: bytes) -> Mapping[str, bytes]:
    """The files in a zip, whose names lie inside of it.

    Raises:
        UnsafeFileError: if there is a link, a name that leads elsewhere, or too much.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for info in archive.infolist():
            kind = stat.S_IFMT(info.external_attr >> 16)
            if kind not in (0, stat.S_IFREG):
                raise UnsafeFileError(f"holds {shown(info.filename)}, which is no regular file")
            _check_name(info.filename)
    files = read_members(content)
    if len({name.casefold() for name in files}) < len(files):
        raise UnsafeFileError("holds two names that some systems take for one")
    folders = {str(parent) for name in files for parent in PurePosixPath(name).parents}
    if not folders.isdisjoint(files):
        raise UnsafeFileError("holds a file that is a folder too")
    return files


def _check_name(name: str) -> None:
    parts = name.split("/")
    good = all(
        part not in ("", ".", "..") and portable_name(part, _LONGEST_NAME) == part for part in parts
    )
    if len(parts) > _DEEPEST or not good:
        raise UnsafeFileError(f"holds {shown(name)}, which would lie elsewhere")


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        with path.open("xb") as file:
            file.write(content)


def default_target(run_folder: Path) -> Path:
    """A name for the pack of a run, in the present folder: agent, environment, seed."""
    run = run_in(run_folder)
    spec = run.recorded_spec()
    name = "-".join(str(spec.get(key)) for key in ("algo", "env_id", "seed"))
    return Path(portable_name(name.replace("/", "-").replace(":", "-")))
