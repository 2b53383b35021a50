"""The pack of a study: its page, tables and settings, the packs of its runs, the user's modules."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import IO, Any

from pipeline.digests import LOCK, RECORD
from pipeline.errors import UserError, one_line, visible
from pipeline.files import json_text, replacing
from pipeline.locks import folder_lock
from pipeline.models.find import run_in
from pipeline.module_records import COPIES
from pipeline.packing.model_card import fenced, plain_text, to_type
from pipeline.packing.pack_contents import CARD, STUDY_RECORD, contents
from pipeline.packing.pack_files import check_name
from pipeline.packing.scrubbing import check_untold, member_of, names_alone, zipped
from safe_files.files import MAX_ARCHIVE_BYTES, hold, read_file

RUNS = "runs"
SETTINGS = "study.yml"  # written beside the page, see `experiments.study`
_RUN = re.compile(r".*_\d+", re.DOTALL)  # not ``<run>.damaged-1``
_PAGE = "report.html"
_SHOWN = (_PAGE, "learning/*/*.html", "verdicts.*", "summary.csv", "curves.csv.gz", "figures/*")
_OF_A_STUDY = (*_SHOWN, SETTINGS, "settings/*.yml")
_TEXTS = frozenset([".html", ".md", ".tex", ".csv", ".yml", ".svg"])
_FIGURES = _TEXTS | frozenset([".gz", ".png", ".pdf"])
_LARGEST_FILE = 64 << 20  # bytes


@dataclass
class StudyPack:
    """What has come into the pack of a study.

    Attributes:
        digests: of its files, by name.
        agents: by agent and environment, as their folders are called: the first run's record and
            pack, and how many runs there are.
        modules: what to type for the modules of all runs.
    """

    digests: dict[str, str] = field(default_factory=dict)
    agents: dict[tuple[str, str], tuple[dict[str, Any], str, int]] = field(default_factory=dict)
    modules: list[str] = field(default_factory=list)

    @property
    def n_runs(self) -> int:
        """How many packs of runs it holds."""
        return sum(n_runs for _, _, n_runs in self.agents.values())

    @property
    def first(self) -> str:
        """The name of the first run's pack."""
        return next(place for _, place, _ in self.agents.values())


def is_study(folder: Path) -> bool:
    """Whether a folder is that of a study."""
    has_parts = any((folder / name).exists() for name in (RUNS, SETTINGS, LOCK))
    return has_parts and not os.path.lexists(folder / RECORD)


def pack_study(root: Path, target: Path, say: Callable[[str], object]) -> StudyPack:
    """Write a study as a pack that can be given to others.

    Args:
        root: the study's folder. No other command may be at work on it.
        target: a file ``.zip``, which is replaced.
        say: told in a line why it takes long, where it does.

    Raises:
        UserError: if a run cannot be packed, a file names a place on this machine, a command is at
            work on the study, or the target cannot be written.
    """
    hold(root)
    if target.suffix != ".zip" or target.is_dir():
        raise UserError(f"{target}: a study is packed as a file: name it {target.name}.zip")
    if not target.absolute().parent.is_dir():
        raise UserError(f"there is no folder {target.parent} to write the pack in")
    is_mine = os.access(root, os.W_OK)
    with folder_lock(root, lambda: None, say) if is_mine else contextlib.nullcontext():
        folders = sorted(path for path in root.glob(f"{RUNS}/*/*") if _RUN.fullmatch(path.name))
        if not folders:
            raise UserError(f"{root} holds no finished run: there is nothing to pack")
        # A file without a name: whoever kills this process leaves nothing.
        with tempfile.TemporaryFile(dir=target.absolute().parent) as draft:
            made = _write(draft, root, folders)
            draft.seek(0)
            with replacing(target) as file:
                shutil.copyfileobj(draft, file)
    return made


def _write(draft: IO[bytes], root: Path, folders: list[Path]) -> StudyPack:
    made = StudyPack()
    with zipfile.ZipFile(draft, "w") as archive:
        for name, content in _files(root, folders, made):
            if name in made.digests:
                continue
            check_name(name, 3)
            made.digests[name] = hashlib.sha256(content).hexdigest()
            archive.writestr(member_of(name), content, zipfile.ZIP_DEFLATED)
            if draft.tell() > MAX_ARCHIVE_BYTES:
                raise UserError(f"{root}: its pack would be larger than 1 GB: pack single runs")
        record = f"{json_text({'files': made.digests}, indent=2)}\n"
        archive.writestr(member_of(STUDY_RECORD), record)
    return made


def _files(root: Path, folders: list[Path], made: StudyPack) -> Iterator[tuple[str, bytes]]:
    for folder in folders:
        files = contents(folder)
        record = json.loads(files[RECORD])
        for name in [name for name in files if name.startswith(f"{COPIES}/")]:
            content = files[name]
            if made.digests.get(name, digest := hashlib.sha256(content).hexdigest()) != digest:
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
    """The table of all runs, with their packs in place of their folders."""
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
