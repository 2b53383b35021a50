"""One run folder: its file names, its number, and its ``run.json``.

The layout is that of rl_zoo3, ``<log folder>/<algo>/<env>_<number>/``. Files that rl_zoo3 has too
have the same names, so that its tools can read our runs. ``run.json`` belongs to this project.
"""

from __future__ import annotations

import _thread
import contextlib
import os
import platform
import re
import secrets
import shutil
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.pipeline.digests import (
    FIELD,
    LOCK,
    RECORD,
    STATE_FOLDER,
    VERSION,
    VERSION_FIELD,
    RecordedFiles,
    digest_of,
    digests_of,
    read_record,
    sealed,
)
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import (
    drafts_in,
    portable_name,
    put_in_place,
    replacing,
    write_json,
    write_text,
)
from rl_yardstick.pipeline.locks import folder_lock, is_alive, mark
from rl_yardstick.pipeline.user_modules import COPIES, keep_copies

if TYPE_CHECKING:
    from rl_yardstick.pipeline.train_spec import TrainSpec

PULLS_FILE = "pulls.npz"
LAST_PULLS = 100  # pulls at the end whose mean is reported

# Keeps the newest two states, so that one is complete.
GENERATIONS = 2


def state_file(folder: Path, number: int) -> Path:
    """The path of a state by its number; replaces the state before the last one."""
    return folder / f"{'odd' if number % GENERATIONS else 'even'}.state"


def state_files(folder: Path) -> list[Path]:
    """The possible paths of states."""
    return [state_file(folder, number) for number in range(GENERATIONS)]


def has_state(folder: Path) -> bool:
    """Whether a file exists that may be a state."""
    return any(path.is_file() for path in state_files(folder))


def remove_states(folder: Path) -> None:
    """Remove all states."""
    shutil.rmtree(folder, ignore_errors=True)


def environment_name(env_id: str) -> str:
    """The environment's id as a file name, without module prefix and slashes."""
    return portable_name(env_id.rpartition(":")[2].replace("/", "-"))


RUNNING = "running"
FINISHED = "finished"
INTERRUPTED = "interrupted"
FAILED = "failed"

# Fields of ``run.json`` that are written at the end of a run.
_OF_END = ("state", "reason", "stopped_by", "n_timesteps", "seconds", "cpu_seconds", FIELD)
_BEST = ("best_mean_return", "best_timesteps", "best_episodes", "evaluation_steps")
OUTCOME = (*_OF_END, "final", *_BEST, "engine", "regret", "pulls")
# The field of ``run.json`` with the process of a running run.
PROCESS = "process"
# Space reserved during a run, so that its last ``run.json`` fits on a full disk.
ROOM = ".room"
ROOM_BYTES = 16 << 10


class NoRunError(UserError):
    """The agent has not been trained on the environment yet."""

    def __init__(self, algo: str, env_id: str, log_folder: Path) -> None:
        super().__init__(f"no run of {algo} on {environment_name(env_id)} in {log_folder}")
        self.algo, self.env_id, self.log_folder = algo, env_id, log_folder


def _run_number(name: str, env_name: str) -> int:
    """The number in a run folder's name, with or without a unique suffix; 0 if there is none."""
    match = re.fullmatch(re.escape(env_name) + r"_(\d+)(?:_[0-9a-f-]{36})?", name)
    return int(match[1]) if match else 0


@dataclass(frozen=True)
class Run:
    """A run folder; it never reads or writes through a link in it."""

    path: Path
    env_name: str  # the environment's name in file names

    @classmethod
    def claim(cls, log_folder: Path, algo: str, env_id: str, suffix: str = "") -> Run:
        """Make the folder of a new run, with the first free number."""
        name = environment_name(env_id)
        parent = log_folder / algo
        draft = cls(parent / f".{name}.{secrets.token_hex(8)}.tmp", name)
        try:
            draft.params_path.mkdir(parents=True)
            draft.update_info(state=RUNNING)
            number = max((n for n, _ in numbered_runs(parent, name)), default=0) + 1
            # Renaming claims the number atomically: two runs never share one.
            while not _renamed(draft.path, path := parent / f"{name}_{number}{suffix}"):
                number += 1
        except OSError as error:
            draft.discard()
            raise UserError(f"cannot make a run folder in {parent}: {error.strerror}") from error
        return cls(path, name)

    @classmethod
    def find(cls, log_folder: Path, algo: str, env_id: str, number: int = 0) -> Run:
        """Find a run by number; 0: the newest, -1: the one without a number.

        The run without a number is in ``<log folder>/<algo>/``; if it is the only one, 0 finds it.
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
    def params_path(self) -> Path:  # settings and VecNormalize statistics
        return self.path / self.env_name

    @property
    def model_path(self) -> Path:  # the agent at the end of training
        return self.path / f"{self.env_name}.zip"

    @property
    def best_model_path(self) -> Path:  # the agent that evaluated best
        return self.path / "best_model.zip"

    def checkpoint_path(self, n_steps: int) -> Path:
        """The agent after ``n_steps`` steps."""
        return self.path / f"rl_model_{n_steps}_steps.zip"

    def checkpoints(self) -> list[Path]:
        """The existing checkpoints, by rising number of steps."""
        steps = (
            re.fullmatch(r"rl_model_(\d+)_steps\.zip", path.name) for path in self.path.iterdir()
        )
        return [self.checkpoint_path(n) for n in sorted(int(match[1]) for match in steps if match)]

    @property
    def evaluations_path(self) -> Path:  # during training
        return self.path / "evaluations.npz"

    @property
    def vecnormalize_path(self) -> Path:
        return self.params_path / "vecnormalize.pkl"

    @property
    def state_path(self) -> Path:  # the folder of saved states
        return self.path / STATE_FOLDER

    @property
    def info_path(self) -> Path:  # settings and results of the run
        return self.path / RECORD

    @property
    def curve_path(self) -> Path:
        return self.path / "learning_curve.png"

    @property
    def value_maps_path(self) -> Path:  # the policy and its values during training, on grid worlds
        return self.path / "value_maps.npz"

    @property
    def diagnosis_path(self) -> Path:  # errors of values and gradients, with ``--diagnose``
        return self.path / "diagnosis.csv"

    @property
    def value_map_path(self) -> Path:  # the picture of the policy at the end, on grid worlds
        return self.path / "value_map.png"

    @property
    def number(self) -> int:
        """The number in the folder's name; 0 if there is none."""
        return _run_number(self.path.name, self.env_name)

    def read_info(self) -> dict[str, Any]:
        """Read ``run.json``; empty if there is none."""
        try:
            return read_record(self.info_path)
        except FileNotFoundError:
            return {}

    @property
    def state(self) -> str | None:
        """The ``state`` in ``run.json``; ``interrupted`` if the run's process no longer exists."""
        info = self.read_info()
        state = info.get("state")
        if state == RUNNING and is_alive(info.get(PROCESS)) is False:
            return INTERRUPTED
        return state if isinstance(state, str) else None

    def recorded_spec(self) -> dict[str, Any]:
        """The spec in ``run.json``; empty if there is none."""
        spec = self.read_info().get("spec")
        return spec if isinstance(spec, dict) else {}

    def update_info(self, **fields: Any) -> None:
        """Set fields of ``run.json``; adds this process while the run is running."""
        info = {**self.read_info(), **fields}
        info.pop(PROCESS, None)
        if info.get("state") == RUNNING:
            info[PROCESS] = mark()
        write_json(self.info_path, sealed(info))

    def reopen(self) -> None:
        """Remove the outcome from ``run.json``, because the run continues."""
        info = {key: value for key, value in self.read_info().items() if key not in OUTCOME}
        write_json(self.info_path, {**info, "state": RUNNING, PROCESS: mark()})

    def keep_room(self) -> None:
        """Reserve space on the disk for the last ``run.json``."""
        with replacing(self.path / ROOM) as file:
            file.write(bytes(ROOM_BYTES))

    def fail(self, reason: str) -> None:
        """Record in ``run.json`` that the run has failed, if writing is possible."""
        with contextlib.suppress(OSError):
            (self.path / ROOM).unlink(missing_ok=True)
            self.update_info(state=FAILED, reason=reason)

    def end(self, **fields: Any) -> None:
        """Write ``run.json``, the last file of a run, with the digests of all other files."""
        (self.path / ROOM).unlink(missing_ok=True)
        for draft in drafts_in(self.path):  # temporary files of interrupted writes
            draft.unlink(missing_ok=True)
        self.update_info(**fields, **{VERSION_FIELD: VERSION, FIELD: digests_of(self.path)})

    def add_file(self, path: Path) -> None:
        """Record the digest of a file that was written after the end of the run."""
        digests = self.files.digests
        if digests is not None and path.parent.resolve() == self.path.resolve():
            self.update_info(**{FIELD: {**digests, path.name: digest_of(path)}})

    @property
    def files(self) -> RecordedFiles:
        """The run's files, checked against their digests when read."""
        return RecordedFiles(self.path, self.read_info().get(FIELD))

    def discard(self) -> None:
        """Remove the folder of a run without results, and parent folders that become empty."""
        shutil.rmtree(self.path, ignore_errors=True)
        for folder in list(self.path.parents)[:2]:
            try:
                folder.rmdir()
            except OSError:
                return


@dataclass(frozen=True)
class ReadRun(Run):
    """A read-only run folder; caches ``run.json``."""

    @cached_property
    def _info(self) -> dict[str, Any]:
        return super().read_info()

    def read_info(self) -> dict[str, Any]:
        return self._info

    @cached_property
    def files(self) -> RecordedFiles:
        return super().files


def _renamed(draft: Path, path: Path) -> bool:
    """Rename a folder that is not empty, unless the new name exists."""
    if os.path.lexists(path):
        return False
    try:
        put_in_place(draft, path)
    except OSError:
        if os.path.lexists(path):  # created meanwhile
            return False
        raise
    return True


def numbered_runs(parent: Path, env_name: str) -> list[tuple[int, Path]]:
    """The run folders of one environment, by rising number."""
    if not parent.is_dir():
        return []
    numbered = [(_run_number(path.name, env_name), path) for path in parent.iterdir()]
    return sorted((number, path) for number, path in numbered if number > 0)


# The field of ``run.json`` with the digest of the zip from which a run continues.
TRAINED_AGENT = "trained_agent_digest"
_PROCESSORS = Path("/proc/cpuinfo")
RECORDED_PACKAGES = ("rl-yardstick", "stable-baselines3", "gymnasium", "torch", "numpy", "numba")


def write_settings(run: Run, spec: TrainSpec, command: str) -> None:
    """Write hyperparameters and command at rl_zoo3's places; copy the user's files."""
    write_text(run.params_path / "config.yml", _yaml(spec.saved_hyperparams))
    write_text(run.params_path / "command.txt", command + "\n")
    keep_copies(spec.user_modules, run.path)


def write_arguments(run: Run, spec: TrainSpec, args: Mapping[str, Any]) -> None:
    """Write the arguments of the command, like rl_zoo3."""
    # Its tools use env_kwargs as the environment's arguments, before those in config.yml.
    args = {**args, "env_kwargs": spec.saved_hyperparams.get("env_kwargs")}
    write_text(run.params_path / "args.yml", _yaml(args))


def _yaml(data: Mapping[str, Any]) -> str:
    """Like `yaml.safe_dump`, with the faster C version if available."""
    import yaml

    return str(yaml.dump(data, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper)))


@cache
def recorded_versions() -> dict[str, str]:
    """The versions of software that may affect a run's results."""
    from importlib.metadata import version

    packages = {package: version(package) for package in RECORDED_PACKAGES}
    return {"python": platform.python_version(), **packages}


@cache
def recorded_machine() -> dict[str, str]:
    """Hardware that may affect times and the bits of networks; does not identify the machine."""
    return {
        "processor": _processor(),
        "cores": str(os.cpu_count() or "unknown"),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
    }


def _processor() -> str:
    """The processor's model, as Linux reports it."""
    try:
        lines = _PROCESSORS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine() or "unknown"


@contextmanager
def at_work_on(run: Run, say: Callable[[str], object]) -> Iterator[None]:
    """Lock a run inside the ``with`` statement."""
    with folder_lock(run.path, partial(_thread.interrupt_main, signal.SIGTERM), say):
        yield


def check_left(run: Run) -> None:
    """Check that no process works on a run without a lock, such as a study's run."""
    info = run.read_info()
    process: Any = info.get(PROCESS)
    if info.get("state") == RUNNING and is_alive(process):
        raise UserError(f"{run.path}: process {process['pid']} is at work on it")


_CLAIM = re.compile(r"\.(.+)\.[0-9a-f]{16}\.tmp")


def remove_leftovers(log_folder: Path, algo: str, env_id: str) -> None:
    """Remove temporary files of killed runs, and runs that were killed before their first step."""
    parent, env_name = log_folder / algo, environment_name(env_id)
    names = {path: env_name for _, path in numbered_runs(parent, env_name)}
    for path in list(parent.glob(".*.tmp")):  # without a number yet
        if claim := _CLAIM.fullmatch(path.name):
            names[path] = claim[1]
    for path, name in names.items():
        if not path.is_dir() or path.is_symlink():
            continue
        run = Run(path, name)
        with contextlib.suppress(OSError, UserError):
            drafts = drafts_in(path)  # first: a resuming process may write new ones
            if run.model_path.exists() and not drafts:
                continue
            info = run.read_info()
            if info.get("state") != RUNNING or is_alive(info.get(PROCESS)) is not False:
                continue
            if "spec" not in info and _is_mere_set_up(run):
                shutil.rmtree(path)
                continue
            for draft in drafts:
                draft.unlink(missing_ok=True)


def _is_mere_set_up(run: Run) -> bool:
    """Whether the folder contains only files that are written before the first step."""
    own_files = "|".join(map(re.escape, (RECORD, LOCK, ROOM)))
    own = re.compile(
        rf"{own_files}|\d+\.monitor\.csv|{re.escape(run.env_name)}(/(config|args)\.yml|/command\.txt)?"
        rf"|{COPIES}(/.+\.py)?|(.+/)?\.[^/]+\.[0-9a-f]{{16}}\.tmp"
    )
    paths = (
        p for p in run.path.rglob("*") if p.is_symlink() or not (p.is_dir() and any(p.iterdir()))
    )
    names = (path.relative_to(run.path).as_posix() for path in paths)
    return all(own.fullmatch(name) and not (run.path / name).is_symlink() for name in names)
