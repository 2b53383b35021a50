"""Writes packs of runs and studies, and reads packs of any origin as data."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import os
import re
import secrets
import shlex
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePath, PurePosixPath
from typing import IO, Any

import yaml

from rl_yardstick.pipeline.digests import (
    FIELD,
    LOCK,
    RECORD,
    VERSION,
    VERSION_FIELD,
    RecordedFiles,
    read_record,
    sealed,
)
from rl_yardstick.pipeline.errors import UserError, one_line, shown, visible
from rl_yardstick.pipeline.files import json_text, portable_name, put_in_place, replacing, settle
from rl_yardstick.pipeline.locks import folder_lock
from rl_yardstick.pipeline.model_card import card, fenced, plain_text, results, to_type
from rl_yardstick.pipeline.models.find import read_recorded, run_in
from rl_yardstick.pipeline.runs import FINISHED, Run
from rl_yardstick.pipeline.scrubbing import (
    check_secrets,
    check_untold,
    member_of,
    names_alone,
    record_to_tell,
    zip_to_tell,
    zipped,
)
from rl_yardstick.pipeline.user_modules import COPIES
from rl_yardstick.safe_files.archives import opened_zip, read_member, read_members
from rl_yardstick.safe_files.files import (
    MAX_ARCHIVE_BYTES,
    Budget,
    UnsafeFileError,
    read_file,
)

CARD = "README.md"
STUDY_RECORD = "study.json"  # in the pack of a study, with the digests of its files
FILMS = (".mp4", ".gif")
MOST_FILM_BYTES = 64 << 20


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a pack of a finished run, by name, checked and without private data."""
    run = run_in(folder)
    if not run.recorded_spec():
        raise UserError(f"{folder} has no record of a training of this project")
    info = run.read_info()
    if info.get("state") != FINISHED:
        raise UserError(f"{folder} is {info.get('state')}: only finished runs can be packed")
    check_secrets(info["spec"]["hyperparams"])
    try:
        record = record_to_tell(info)
        files = dict(_files(run, record))
        files[CARD] = card(record, files.keys()).encode()
    except (TypeError, ValueError, LookupError, AttributeError) as error:  # strange contents
        raise UserError(f"{folder} cannot be packed: {one_line(error)}") from error
    record |= {VERSION_FIELD: VERSION, FIELD: {name: _digest(files[name]) for name in files}}
    files[RECORD] = (json_text(sealed(record), indent=2) + "\n").encode()
    check_untold(files, run)
    return files


def _files(run: Run, record: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    """All files except the card and the record; of the run's files, only the recorded ones."""
    recorded = run.files.digests
    if recorded is None:
        raise UserError(f"{run.path} recorded no digests of its files: train again to pack it")
    spec, settings = record["spec"], run.params_path.name
    yield run.model_path.name, zip_to_tell(read_recorded(run, run.model_path, MAX_ARCHIVE_BYTES))
    for name in sorted(recorded):
        if name.startswith(f"{COPIES}/") and name.endswith(".py"):
            yield name, read_recorded(run, run.path / name, MAX_ARCHIVE_BYTES)
    arguments = {"algo": spec["algo"], "env": spec["env_id"], "seed": spec["seed"]}
    arguments["env_kwargs"] = spec["hyperparams"].get("env_kwargs")
    yield f"{settings}/config.yml", str(yaml.safe_dump(spec["hyperparams"])).encode()
    yield f"{settings}/args.yml", str(yaml.safe_dump(arguments)).encode()
    for name, path in (
        (f"{settings}/vecnormalize.pkl", run.vecnormalize_path),
        ("value_map.png", run.value_map_path),
        ("learning_curve.png", run.curve_path),
    ):
        if path.relative_to(run.path).as_posix() in recorded:
            yield name, read_recorded(run, path, MAX_ARCHIVE_BYTES)
    if (told := results(record)) is not None:
        yield "results.json", told.encode()
    films = (name for name in sorted(recorded) if Path(name).suffix in FILMS and "/" not in name)
    if name := next(films, ""):
        film = read_recorded(run, run.path / name, MOST_FILM_BYTES)
        yield f"replay{Path(name).suffix}", film


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


# --- packs on disk --------------------------------------------------------------------------------

_DEEPEST = 2  # parts of a name, including the file
_DEEPEST_MODULE = 8
_DEEPEST_OF_STUDY = 3
_MOST, _MOST_OF_STUDY = 1000, 100_000  # files
_LONGEST_NAME = 255
_DAMAGE = (OSError, ValueError, LookupError, RuntimeError, EOFError, zipfile.BadZipFile)


def pack(run_folder: Path, target: Path) -> Path:
    """Write a finished run as a pack: a new folder, or a zip, which may replace another."""
    _check_parent(target)
    is_zip = target.suffix == ".zip"
    if target.is_dir() if is_zip else (target.exists() or target.is_symlink()):
        raise UserError(f"{target} is there already: name another place for the pack")
    files = contents(run_folder)
    for name in files:
        check_name(name)
    if len(files) > _MOST:
        raise UserError(f"{run_folder} has too many modules: a pack holds at most {_MOST:,} files")
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
    """Check the digest of every file in a pack, and return the number of files."""
    if is_packed(path, STUDY_RECORD):
        return _check_study(path)
    with unpacked(path) as (folder, _):
        if not (folder / RECORD).is_file():
            raise UserError(f"{path} is no pack: it holds no {RECORD}")
        return _check_files(folder, path)


def _check_files(folder: Path, shown_as: Path, names: Collection[str] = ()) -> int:
    """Check the digests of the files in a pack; ``names`` are the existing files."""
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
    try:
        with _opened_study(path) as (read, names):
            record = json.loads(read(STUDY_RECORD))
            digests = record.get("files") if isinstance(record, dict) else None
            if not isinstance(digests, dict) or digests.keys() != names - {STUDY_RECORD}:
                raise UnsafeFileError(f"{STUDY_RECORD} does not list its files, and no others")
            for name, digest in digests.items():
                if _digest(read(name)) != digest:
                    raise UnsafeFileError(f"{shown(name)} is not as the record says")
    except _DAMAGE as error:
        raise UserError(f"{path} is not as it was packed: {one_line(error)}") from error
    return len(names)


@contextmanager
def _opened_study(path: Path) -> Iterator[tuple[Callable[[str], bytes], set[str]]]:
    """Open a study's pack: a function that reads a file, and the checked names of all files."""
    content = read_file(path, MAX_ARCHIVE_BYTES)
    with opened_zip(content, Budget(len(content))) as archive:
        infos = archive.infolist()
        if len(infos) > _MOST_OF_STUDY:
            raise UnsafeFileError(f"holds more than {_MOST_OF_STUDY:,} files")
        _check_members(infos, _DEEPEST_OF_STUDY)

        def read(name: str) -> bytes:
            info = archive.getinfo(name)
            # Twice, because Python joins pieces. The size in the zip is not trusted.
            Budget(len(content)).charge(2 * info.file_size)
            return read_member(archive, info)

        yield read, {info.filename for info in infos}


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[Path, Path | None]]:
    """Yield the folder of a pack, and the zip from which it was unpacked, or None.

    For a zip, the folder is temporary, and contains only files in the record. Any other path is
    yielded unchanged. A run in the pack of a study is ``study.zip/runs/<agent>/<run>.zip``.
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
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            _check_members(archive.infolist())
        files = read_members(content)
    except _DAMAGE as error:
        raise UserError(f"{path} is no pack that may be opened: {one_line(error)}") from error
    with tempfile.TemporaryDirectory(prefix="yardstick-pack-") as name:
        folder = Path(name) / path.stem
        folder.mkdir()
        _write(folder, files)
        _check_files(folder, path, files.keys())
        yield folder, study or path


def _run_of(study: Path, name: str) -> bytes:
    """Find the pack of a run in the pack of a study; the suffix may be missing."""
    with _opened_study(study) as (read, names):
        found = next((n for n in (name, f"{name}.zip") if n in names), None)
        if found is not None:
            return read(found)
    raise UserError(f"{study} holds no {shown(name)}: name one of its runs, {_a_run(study)}")


def _a_run(study: Path) -> str:
    """The name of one run in the pack of a study, as an example for messages."""
    with _opened_study(study) as (_, names):
        runs = sorted(name for name in names if name.endswith(".zip"))
        return f"such as {study}/{runs[0]}" if runs else "but it holds none"


def is_packed(path: Path, record: str = RECORD) -> bool:
    """Whether a file is a zip with the record of a run or study, which models do not have."""
    if not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            return record in archive.namelist()
    except _DAMAGE:
        return False


def _check_members(infos: Collection[zipfile.ZipInfo], deepest: int = _DEEPEST) -> None:
    """Refuse members that would not become separate files inside the folder."""
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
    """Refuse a name that leads out of the folder, or is invalid on some file system."""
    parts = name.split("/")
    deepest = _DEEPEST_MODULE if parts[0] == COPIES else deepest
    is_good = {"", ".", ".."}.isdisjoint(parts) and len(parts) <= deepest
    if not is_good or any(portable_name(part, _LONGEST_NAME) != part for part in parts):
        raise UnsafeFileError(f"holds {shown(name)}, which would lie elsewhere")


def _check_parent(target: Path) -> None:
    if not target.absolute().parent.is_dir():
        raise UserError(f"there is no folder {target.parent} to write the pack in")


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as file:
            file.write(content)


def default_target(run_folder: Path) -> Path:
    """The default name for the pack of a run, in the current folder: agent, environment, seed."""
    run = run_in(run_folder)
    spec = run.recorded_spec()
    name = "-".join(str(spec.get(key)) for key in ("algo", "env_id", "seed"))
    return Path(portable_name(name.replace("/", "-").replace(":", "-")))


# --- the pack of a study: page, tables and settings, packs of its runs, the user's modules --------

RUNS = "runs"
SETTINGS = "study.yml"  # beside the page, see `experiments.study`
_RUN = re.compile(r".*_\d+", re.DOTALL)  # not ``<run>.damaged-1``
_PAGE = "report.html"
_SHOWN = (_PAGE, "learning/*/*.html", "verdicts.*", "summary.csv", "curves.csv.gz", "figures/*")
_OF_A_STUDY = (*_SHOWN, SETTINGS, "settings/*.yml")
_TEXTS = frozenset([".html", ".md", ".tex", ".csv", ".yml", ".svg"])
_FIGURES = _TEXTS | frozenset([".gz", ".png", ".pdf"])
_LARGEST_FILE = 64 << 20  # bytes


@dataclass
class StudyPack:
    """Collects the contents of a study's pack while it is written."""

    digests: dict[str, str] = field(default_factory=dict)  # of its files, by name
    # by agent and environment: record and pack name of the first run, and the number of runs
    agents: dict[tuple[str, str], tuple[dict[str, Any], str, int]] = field(default_factory=dict)
    modules: list[str] = field(default_factory=list)  # arguments for the modules of all runs

    @property
    def n_runs(self) -> int:
        """The number of packs of runs."""
        return sum(n_runs for _, _, n_runs in self.agents.values())

    @property
    def first(self) -> str:
        """The name of the first run's pack."""
        return next(place for _, place, _ in self.agents.values())


def is_study(folder: Path) -> bool:
    """Whether a folder contains a study."""
    has_parts = any((folder / name).exists() for name in (RUNS, SETTINGS, LOCK))
    return has_parts and not os.path.lexists(folder / RECORD)


def pack_study(root: Path, target: Path, say: Callable[[str], object]) -> StudyPack:
    """Write a study as a zip, which may replace another; no other command may use the study."""
    if target.suffix != ".zip" or target.is_dir():
        raise UserError(f"{target}: a study is packed as a file: name it {target.name}.zip")
    _check_parent(target)
    is_mine = os.access(root, os.W_OK)
    with folder_lock(root, lambda: None, say) if is_mine else contextlib.nullcontext():
        folders = sorted(path for path in root.glob(f"{RUNS}/*/*") if _RUN.fullmatch(path.name))
        if not folders:
            raise UserError(f"{root} holds no finished run: there is nothing to pack")
        # An anonymous file disappears if this process is killed.
        with tempfile.TemporaryFile(dir=target.absolute().parent) as draft:
            made = _write_study(draft, root, folders)
            draft.seek(0)
            with replacing(target) as file:
                shutil.copyfileobj(draft, file)
    return made


def _write_study(draft: IO[bytes], root: Path, folders: list[Path]) -> StudyPack:
    made = StudyPack()
    with zipfile.ZipFile(draft, "w") as archive:
        for name, content in _study_files(root, folders, made):
            if name in made.digests:
                continue
            check_name(name, 3)
            made.digests[name] = _digest(content)
            archive.writestr(member_of(name), content, zipfile.ZIP_DEFLATED)
            if draft.tell() > MAX_ARCHIVE_BYTES:
                raise UserError(f"{root}: its pack would be larger than 1 GB: pack single runs")
        record = f"{json_text({'files': made.digests}, indent=2)}\n"
        archive.writestr(member_of(STUDY_RECORD), record)
    return made


def _study_files(root: Path, folders: list[Path], made: StudyPack) -> Iterator[tuple[str, bytes]]:
    for folder in folders:
        files = contents(folder)
        record = json.loads(files[RECORD])
        for name in [name for name in files if name.startswith(f"{COPIES}/")]:
            content = files[name]
            if made.digests.get(name, digest := _digest(content)) != digest:
                raise UserError(
                    f"{folder} was trained with another {name} than the runs before it: pack runs "
                    "one by one, or do the study again with --replace"
                )
            yield name, content
        modules = to_type(record["spec"], files)
        made.modules += [word for word in modules if word not in made.modules]
        place = "/".join((RUNS, folder.parent.name, f"{folder.name}.zip"))
        label = folder.parent.name, folder.name.rpartition("_")[0]
        first, first_place, n_runs = made.agents.get(label, (record, place, 0))
        made.agents[label] = first, first_place, n_runs + 1
        yield place, zipped(dict(sorted(files.items())))
    run, shown = run_in(folders[0]), []
    for path in sorted(path for pattern in _OF_A_STUDY for path in root.glob(pattern)):
        if path.suffix not in _FIGURES:
            continue
        content, name = read_file(path, _LARGEST_FILE), path.relative_to(root).as_posix()
        content = _without_folders(content) if name == "summary.csv" else content
        content = names_alone(name, content, run) if path.suffix in _TEXTS else content
        check_untold({name: content}, run)
        shown.append(name)
        yield name, content
    yield CARD, visible(_card(root.name, made, shown)).encode()


def _without_folders(summary: bytes) -> bytes:
    """The table of all runs, with packs in place of folders."""
    try:
        head, *rows = list(csv.reader(io.StringIO(summary.decode())))
        place = head.index("path")
        for row in rows:
            row[place] = "/".join((RUNS, *PurePath(row[place]).parts[-2:])) + ".zip"
    except (ValueError, IndexError, csv.Error) as error:
        raise UserError(f"summary.csv is damaged: {one_line(error)}") from error
    told = io.StringIO()
    csv.writer(told, lineterminator="\n").writerows([head, *rows])
    return told.getvalue().encode()


def _card(name: str, made: StudyPack, shown: list[str]) -> str:
    record = next(iter(made.agents.values()))[0]
    parts = [f"# {plain_text(name)}\n", f"{made.n_runs} runs, made with Yardstick.\n"]
    if _PAGE in shown:
        parts.append(f"[{_PAGE}]({_PAGE}) has all results. It opens in any browser, offline.\n")
    parts += ["| agent | environment | runs | the first |\n|---|---|---|---|"]
    for (agent, environment), (_, place, n_runs) in made.agents.items():
        words = map(plain_text, (agent, environment, n_runs, place))
        parts.append(f"| {' | '.join(words)} |")
    parts += ["\n## Play a run\n", "Unzip this pack, and type in its folder:\n"]
    modules = f" --gym-packages {shlex.join(made.modules)}" if made.modules else ""
    parts.append(fenced("sh", f"yardstick enjoy {shlex.quote(made.first)}{modules}\n"))
    if made.modules:
        parts.append(
            "The runs need modules of their maker. They are imported because you type their names, "
            "and for no other reason: read them first.\n"
        )
    if SETTINGS in shown:
        parts += ["## Do the study again\n", "Its settings are in `study.yml`.\n"]
        parts.append(fenced("sh", f"yardstick compare {SETTINGS}{modules}\n"))
    versions = (f"- {plain_text(key)} {plain_text(v)}" for key, v in record["versions"].items())
    return "\n".join([*parts, "## Versions\n", *versions, ""])
