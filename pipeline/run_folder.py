"""One run folder: its number, and what it says of itself.

The layout is rl_zoo3's, ``<log folder>/<algo>/<env>_<number>/``, so that its tools read our runs;
``run.json`` is ours and says what was asked for, how far it came, and what came out.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.file_digests import (
    FIELD,
    VERSION,
    VERSION_FIELD,
    RecordedFiles,
    digest_of,
    digests_of,
    read_record,
    sealed,
)
from pipeline.files import (
    drafts_in,
    is_kept_later,
    put_in_place,
    replacing,
    sync_together,
    write_json,
)
from pipeline.liveness import is_alive, mark
from pipeline.run_files import RunFiles, environment_name
from safe_files.files import hold

RUNNING = "running"
FINISHED = "finished"
INTERRUPTED = "interrupted"
FAILED = "failed"

# What ``run.json`` says of the end of a run.
OUTCOME = (
    "state",
    "reason",
    "stopped_by",
    "n_timesteps",
    "seconds",
    "cpu_seconds",
    "final",
    "best_mean_return",
    "best_timesteps",
    "best_episodes",
    "evaluation_steps",
    "engine",
    "regret",
    "pulls",
    FIELD,
)
# The field of ``run.json`` that says, while a run is running, which process is at work on it.
PROCESS = "process"
# Kept by a run that is under way: where nothing else fits on the disk, its last word does.
ROOM = ".room"
ROOM_BYTES = 16 << 10


class NoRunError(UserError):
    """An agent has not been trained on an environment yet."""

    def __init__(self, algo: str, env_id: str, log_folder: Path) -> None:
        super().__init__(f"no run of {algo} on {environment_name(env_id)} in {log_folder}")
        self.algo, self.env_id, self.log_folder = algo, env_id, log_folder


def _run_number(name: str, env_name: str) -> int:
    """The number in a run folder's name, with or without a unique suffix; 0 if it is none."""
    match = re.fullmatch(re.escape(env_name) + r"_(\d+)(?:_[0-9a-f-]{36})?", name)
    return int(match[1]) if match else 0


@dataclass(frozen=True)
class Run(RunFiles):
    """A run folder, and what it says of itself.

    It is held: nothing in it is read or written through a link.
    """

    def __post_init__(self) -> None:
        hold(self.path)

    @classmethod
    def claim(cls, log_folder: Path, algo: str, env_id: str, suffix: str = "") -> Run:
        """Make the folder of a new run, with the first number that is free.

        It says from its first moment on which process is at work on it.

        Raises:
            UserError: if the folder cannot be made.
        """
        name = environment_name(env_id)
        parent = log_folder / algo
        draft = cls(parent / f".{name}.{secrets.token_hex(8)}.tmp", name)
        try:
            draft.params_path.mkdir(parents=True)
            draft.update_info(state=RUNNING)
            number = max((n for n, _ in numbered_runs(parent, name)), default=0) + 1
            # Renaming is what claims the number: two runs never share one.
            while not _renamed(draft.path, path := parent / f"{name}_{number}{suffix}"):
                number += 1
        except OSError as error:
            draft.discard()
            raise UserError(f"cannot make a run folder in {parent}: {error.strerror}") from error
        return cls(path, name)

    @classmethod
    def find(cls, log_folder: Path, algo: str, env_id: str, number: int = 0) -> Run:
        """The run of that number, the newest where it is 0, that without a number where it is -1.

        The one without a number lies in ``<log folder>/<algo>/`` itself, and is also the newest
        where no other is, as in rl_zoo3.

        Raises:
            NoRunError: if there is none at all.
            UserError: if there is none of that number; it names those that there are.
        """
        name = environment_name(env_id)
        runs = numbered_runs(log_folder / algo, name)
        has_unnumbered = (log_folder / algo / f"{name}.zip").exists()
        if number < 0 or (number == 0 and not runs and has_unnumbered):
            return cls(log_folder / algo, name)
        if not runs:
            raise NoRunError(algo, env_id, log_folder)
        if number == 0:
            return cls(runs[-1][1], name)
        for known, path in runs:
            if known == number:
                return cls(path, name)
        numbers = ", ".join(str(known) for known, _ in runs)
        raise UserError(f"no run {number} of {algo} on {name} in {log_folder}: there is {numbers}")

    @property
    def number(self) -> int:
        """The number in the folder's name; 0 if there is none."""
        return _run_number(self.path.name, self.env_name)

    def read_info(self) -> dict[str, Any]:
        """The contents of ``run.json``; empty where there is none.

        Raises:
            UserError: if the file is damaged.
        """
        try:
            return read_record(self.info_path)
        except FileNotFoundError:
            return {}

    @property
    def state(self) -> str | None:
        """What became of the run: one whose process is gone before its end was interrupted.

        Raises:
            UserError: if ``run.json`` is damaged.
        """
        info = self.read_info()
        state = info.get("state")
        if state == RUNNING and is_alive(info.get(PROCESS)) is False:
            return INTERRUPTED
        return state if isinstance(state, str) else None

    def recorded_spec(self) -> dict[str, Any]:
        """What ``run.json`` says was asked for; empty where it says nothing.

        Raises:
            UserError: if the file is damaged.
        """
        spec = self.read_info().get("spec")
        return spec if isinstance(spec, dict) else {}

    def update_info(self, **fields: Any) -> None:
        """Set fields of ``run.json``, which names this process while the run is running."""
        info = {**self.read_info(), **fields}
        info.pop(PROCESS, None)
        if info.get("state") == RUNNING:
            info[PROCESS] = mark()
        write_json(self.info_path, sealed(info))

    def reopen(self) -> None:
        """Take out of ``run.json`` what came out so far: the run goes on."""
        info = {key: value for key, value in self.read_info().items() if key not in OUTCOME}
        write_json(self.info_path, {**info, "state": RUNNING, PROCESS: mark()})

    def keep_room(self) -> None:
        """Take the room on the disk that the run's last word needs."""
        with replacing(self.path / ROOM) as file:
            file.write(bytes(ROOM_BYTES))

    def _give_room(self) -> None:
        (self.path / ROOM).unlink(missing_ok=True)

    def fail(self, reason: str) -> None:
        """Note in ``run.json`` that the run has failed, if anything can be written at all."""
        with contextlib.suppress(OSError):
            self._give_room()
            self.update_info(state=FAILED, reason=reason)

    def end(self, **fields: Any) -> None:
        """Set fields of ``run.json``, the last file of a run, with the digests of all others.

        Before that the disk has all others, and the way to them.
        """
        self._give_room()
        for draft in drafts_in(self.path):  # of a file that was not to be finished any more
            draft.unlink(missing_ok=True)
        digests = digests_of(self.path)
        if not is_kept_later(self.path):
            self.wait_for_disk([self.path / name for name in digests])
        self.update_info(**fields, **{VERSION_FIELD: VERSION, FIELD: digests})

    def add_file(self, path: Path) -> None:
        """Let the record name a file that came into the folder after the end of the run."""
        digests = self.files.digests
        if digests is not None and path.parent.resolve() == self.path.resolve():
            self.update_info(**{FIELD: {**digests, path.name: digest_of(path)}})

    def wait_for_disk(self, files: Sequence[Path]) -> None:
        """Wait until the disk has files of the run, and the way to them."""
        way = [self.path, *self.path.parents][:3]
        sync_together(files, {*(path.parent for path in files), *way})

    @property
    def files(self) -> RecordedFiles:
        """The files that the run left, each held against what it was then.

        Raises:
            UserError: if ``run.json`` is damaged.
        """
        return RecordedFiles(self.path, self.read_info().get(FIELD))

    def discard(self) -> None:
        """Remove the folder of a run that left nothing, and those above it that are empty then."""
        shutil.rmtree(self.path, ignore_errors=True)
        for folder in list(self.path.parents)[:2]:
            try:
                folder.rmdir()
            except OSError:
                return


@dataclass(frozen=True)
class ReadRun(Run):
    """A run folder that is only read: all goes by what it said when it was first asked."""

    @cached_property
    def _info(self) -> dict[str, Any]:
        return super().read_info()

    def read_info(self) -> dict[str, Any]:
        return self._info

    @cached_property
    def files(self) -> RecordedFiles:
        """The files that the run left, each held against what it was then."""
        return super().files


def _renamed(draft: Path, path: Path) -> bool:
    """Rename a folder that holds something, unless something has the name already."""
    if os.path.lexists(path):
        return False
    try:
        put_in_place(draft, path)
    except OSError:
        if os.path.lexists(path):  # since a moment ago
            return False
        raise
    return True


def numbered_runs(parent: Path, env_name: str) -> list[tuple[int, Path]]:
    """The run folders of one environment, by rising number."""
    if not parent.is_dir():
        return []
    numbered = [(_run_number(path.name, env_name), path) for path in parent.iterdir()]
    return sorted((number, path) for number, path in numbered if number > 0)
