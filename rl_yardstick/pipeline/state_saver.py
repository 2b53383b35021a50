"""Saves the state of a training, and restores it."""

from __future__ import annotations

import enum
import functools
import gc
import random
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from inspect import signature
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger, make_output_format
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv

from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon
from rl_yardstick.machine_code import WorkTime
from rl_yardstick.machine_code.sources import ROOT
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.critics import KnownWorld
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.files import files_below, sync
from rl_yardstick.pipeline.progress import ProgressDisplay
from rl_yardstick.pipeline.runs import Run
from rl_yardstick.pipeline.state_files import SavedState, save_state
from rl_yardstick.pipeline.states import NotFittingError, NotKeepableError, pickled, unpickled
from rl_yardstick.pipeline.stopping import current
from rl_yardstick.pipeline.unfinished_runs import StateKeeping, log_positions, settings_digest
from rl_yardstick.pipeline.user_modules import UserModule

# Saving may take this share of the time, unless the user has set the interval.
SHARE_OF_TIME = 0.02
SHORTEST_INTERVAL = 1.0  # seconds
FIRST_COST = 0.05  # seconds; assumed before the first save
# An interrupted run may soon be interrupted again, and must make progress each time: the pauses
# between its saves begin short and double, so that at least half of its new work is saved.
SHORTEST_PAUSE = 0.1


class StateSaver(BlockCallback):
    """Saves the state of a training; ends the training after a signal to stop.

    Both happen at a safe moment: after the last update and before the environments step. The state
    consists of the agent with its environments, all callbacks with their evaluation environments,
    the user's modules, and the global random generators.
    """

    takes_blocks = True

    def __init__(
        self,
        run: Run,
        keeping: StateKeeping,
        tell: Callable[[str], object],
        modules: tuple[UserModule, ...] = (),
    ) -> None:
        super().__init__()
        self.run = run
        self.root: BaseCallback = self  # all callbacks, including this one
        self.modules = modules  # the user's
        self.told: set[str] = set()
        self.interval = keeping.interval
        self.tell = tell  # prints a line on why no state is saved
        self.state = keeping.state  # the state to resume from
        self.is_off = keeping.interval.is_off
        self.acts = True  # at the next safe moment; False after `wants_position` returned False
        note = {} if self.state is None else self.state.note
        self.n_saved = int(note.get("number", 0))
        self.time_before = WorkTime(
            float(note.get("seconds", 0.0)), float(note.get("cpu_seconds", 0.0))
        )
        self.started = WorkTime.now()
        self.stamps: dict[Path, tuple[int, int, int]] = {}  # of files, at the last save
        self.steps_at_save = 0
        self.saved_at = time.monotonic()
        self.was_cut_off = keeping.was_cut_off
        self.pause = self.interval.seconds  # until the next save
        if self.pause == 0.0:  # no interval from the user
            self.pause = FIRST_COST / SHARE_OF_TIME
            if self.was_cut_off:
                self.pause = max(float(note.get("pause", 0.0)) * SHARE_OF_TIME, SHORTEST_PAUSE)

    @property
    def taken(self) -> WorkTime:
        """The time of the training in all its processes."""
        return self.time_before + (WorkTime.now() - self.started)

    def horizon(self) -> Horizon:
        if self.is_off or self.interval.steps < 1:
            return Horizon()
        steps = self.steps_at_save + self.interval.steps - self.model.num_timesteps
        return Horizon(calls=max(-(-steps // self.training_env.num_envs), 1))

    def wants_position(self) -> bool:
        self.acts = self.state is not None or self._is_due() or current().number is not None
        return self.acts

    def at_safe_moment(self) -> None:
        if getattr(self.model, "tells_safe_moments", False):
            self._act()

    def _on_training_start(self) -> None:
        self.steps_at_save = self.model.num_timesteps
        self.saved_at, self.started = time.monotonic(), WorkTime.now()

    def _on_rollout_start(self) -> None:
        if not getattr(self.model, "tells_safe_moments", False):
            self._act()

    def _on_step(self) -> bool:
        return True

    def _act(self) -> None:
        # After `wants_position` returned False, the environments are not up to date: saving waits.
        if self.acts:
            self._restore_or_save()
        self.acts = True

    def _restore_or_save(self) -> None:
        if self.state is not None:
            state, self.state = self.state, None
            self._go_back_to(state)
        elif self._is_due():
            self.save()
        stop = current()
        if stop.number is not None:
            with stop.held():
                if not (self.is_off or stop.is_urgent):
                    self.save()
            stop.raise_if_asked()

    def _is_due(self) -> bool:
        if self.is_off:
            return False
        if self.interval.steps > 0:
            return self.model.num_timesteps - self.steps_at_save >= self.interval.steps
        return time.monotonic() - self.saved_at >= self.pause

    def save(self) -> None:
        """Save the current state; must be called between two updates."""
        begun = time.monotonic()
        try:
            with _garbage_left():
                self._write()
        except (NotKeepableError, UserError) as error:
            self.is_off = True
            what = f"no state can be kept: {one_line(error)}"
            self.tell(f"{what}; if this run is cut off, --resume starts it from the beginning")
        except OSError as error:
            reason = error.strerror or one_line(error)
            self._tell_once(f"no state was saved: {self.run.state_path}: {reason}")
        except MemoryError:
            self._tell_once("no state was saved: there is no memory left for it")
        self.saved_at = time.monotonic()
        self.steps_at_save = self.model.num_timesteps
        if self.interval.seconds == 0:
            seconds = self.saved_at - begun
            pause = max(seconds / SHARE_OF_TIME, SHORTEST_INTERVAL)
            self.pause = min(pause, 2 * (self.pause + seconds)) if self.was_cut_off else pause

    def _tell_once(self, line: str) -> None:
        """Report a line only once, for example while the disk stays full."""
        if line not in self.told:
            self.told.add(line)
            self.tell(line)

    def _write(self) -> None:
        environment = self.training_env.unwrapped
        if isinstance(environment, SubprocVecEnv):
            raise NotKeepableError("--vec-env subproc: environments are in other processes")
        positions = log_positions(self.run.path, _log_folder(self.model))
        content = pickled(self._roots(), _OF_THIS_PROCESS)
        for lost in content.lost:
            self._tell_once(f"{lost} is not kept: a run that uses it may differ after --resume")
        note = {
            "folder": self._folder_names(),
            "log_folder": _log_folder(self.model),
            "files": positions,
            "steps": self.model.num_timesteps,
            **self.taken.as_data(),
            "pause": self.pause,
            "spec": settings_digest(self.run.recorded_spec()),
        }
        # Flush the files that the state is checked against, and files that are not written again.
        sync(*self._changed_files(positions), *self.run.path.parents[:2])
        save_state(self.run.state_path, self.n_saved + 1, content, note)
        self.n_saved += 1

    def _changed_files(self, logs: Iterable[str]) -> set[Path]:
        """Files of run and logs that changed since the last save, and their folders."""
        paths = {*files_below(self.run.path), *(self.run.path / name for name in logs)}
        before, self.stamps = self.stamps, {}
        for path in paths:
            status = path.stat()
            self.stamps[path] = status.st_ino, status.st_mtime_ns, status.st_size
        changed = {path for path, stamp in self.stamps.items() if before.get(path) != stamp}
        return {*changed, *(path.parent for path in changed)}

    def _roots(self) -> dict[str, Any]:
        logger = self.model.logger
        pending = [logger.name_to_value, logger.name_to_count, logger.name_to_excluded]
        return {
            "model": self.model,
            "callbacks": self.root,
            "pending": pending,
            "generators": generator_states(),
            "modules": user_state(self.modules),
        }

    def _go_back_to(self, state: SavedState) -> None:
        roots = self._roots()
        moved = dict(zip(state.note["folder"], self._folder_names(), strict=True))
        try:
            restored = unpickled(state.content, roots, moved)
        except Exception as error:
            if state.is_of_these_sources and not isinstance(error, NotFittingError):
                raise
            raise UserError(
                f"{self.run.state_path} does not fit the training that its settings make now: "
                f"{one_line(error)}; remove it to begin the run again"
            ) from error
        logger = self.model.logger
        logger.name_to_value, logger.name_to_count, logger.name_to_excluded = restored["pending"]
        put_back(self.modules, restored["modules"])
        set_generators(restored["generators"])
        self.steps_at_save = self.model.num_timesteps
        self.saved_at = time.monotonic()

    def _folder_names(self) -> list[str]:
        """The run folder as given, and as an absolute path."""
        return [str(self.run.path), str(self.run.path.absolute())]


@contextmanager
def _garbage_left() -> Iterator[None]:
    """Disable the garbage collector, which would take several times as long as saving."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.collect(0)  # else the new objects would trigger a full collection soon
            gc.enable()


def _log_folder(model: BaseAlgorithm) -> str | None:
    folder = model.logger.dir
    return None if folder is None else str(Path(folder).absolute())


# Rebuilt from the settings; training changes nothing in them.
_OF_THIS_PROCESS = (
    ExactEvaluator,
    KnownWorld,
    KVWriter,
    Logger,
    ProgressDisplay,
    ResultsWriter,
    Run,
    StateSaver,
)


# --- the global random generators ---


def generator_states() -> dict[str, Any]:
    """The states of the random generators."""
    cuda = (
        [state.numpy() for state in th.cuda.get_rng_state_all()] if th.cuda.is_available() else []
    )
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002  # libraries draw from it
        "torch": th.get_rng_state().numpy(),
        "cuda": cuda,
    }


def set_generators(states: dict[str, Any]) -> None:
    """Restore the states of the random generators."""
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])  # noqa: NPY002
    th.set_rng_state(th.from_numpy(states["torch"].copy()))
    if states["cuda"]:
        th.cuda.set_rng_state_all([th.from_numpy(state.copy()) for state in states["cuda"]])


# --- global state of the user's modules ---

_CODE = (ModuleType, type, FunctionType)


def user_state(modules: Iterable[UserModule]) -> dict[str, dict[str, Any]]:
    """Global names and class attributes of the user's modules and files beside them."""
    return {name: _values(holder) for name, holder in _holders(modules)}


def put_back(modules: Iterable[UserModule], state: Mapping[str, Mapping[str, Any]]) -> None:
    """Restore the values of the user's modules."""
    for name, holder in _holders(modules):
        before = _values(holder)
        for attribute, value in state.get(name, {}).items():
            if attribute not in before or before[attribute] is not value:
                setattr(holder, attribute, value)


def _holders(modules: Iterable[UserModule]) -> Iterator[tuple[str, ModuleType | type]]:
    typed = [module for module in modules if module.path is not None]
    if not typed:
        return
    for name, module in list(sys.modules.items()):
        if not any(_is_of(module, name, user) for user in typed):
            continue
        yield name, module
        for held in list(vars(module).values()):
            is_own = isinstance(held, type) and held.__module__ == name
            if is_own and not issubclass(held, enum.Enum):
                yield f"{name}:{held.__qualname__}", held


def _is_of(module: ModuleType, name: str, user: UserModule) -> bool:
    """Whether a module is the typed one, part of it, or a file beside it."""
    top = user.name.partition(".")[0]
    if name == top or name.startswith(f"{top}."):
        return True
    file, folder = getattr(module, "__file__", None), Path(user.path or "").parent
    return bool(file) and Path(str(file)).parent == folder and folder != ROOT.parent


def _values(holder: ModuleType | type) -> dict[str, Any]:
    """The data in a module or class: no code, and no attributes of Python itself."""
    return {
        name: value
        for name, value in vars(holder).items()
        if not name.startswith(("__", "_abc_"))
        and not isinstance(value, _CODE)
        # In a class: no methods or other descriptors, but their caches.
        and not (
            isinstance(holder, type)
            and hasattr(type(value), "__get__")
            and not isinstance(value, functools._lru_cache_wrapper)
        )
    }


# --- the log of a resumed training: the same folder, and continued iteration counts ---

# The library's on-policy algorithms count iterations from 1 at each `learn`.
ITERATIONS = "time/iterations"


class IterationInterval(int):
    """A log interval; adds the iterations of an earlier `learn` before taking the remainder."""

    before: int

    def __rmod__(self, iteration: int) -> int:
        return (iteration + self.before) % int(self)


class IterationLogger(Logger):
    """A logger that adds the iterations of an earlier `learn` to recorded ones."""

    before = 0

    def record(self, key: str, value: Any, *args: Any, **kwargs: Any) -> None:
        """As in the library, except for the number of iterations."""
        super().record(key, value + self.before if key == ITERATIONS else value, *args, **kwargs)


def iterations_before(model: BaseAlgorithm, note: dict[str, Any]) -> int:
    """Iterations of an on-policy agent before a saved state; call this before `learn`."""
    if not isinstance(model, OnPolicyAlgorithm):
        return 0
    return int(note["steps"] - model.num_timesteps) // (model.n_steps * model.n_envs)


def default_log_interval(model: BaseAlgorithm) -> int:
    """The default log interval of ``learn``: 1 for PPO, 100 for A2C."""
    learns = (vars(kind)["learn"] for kind in type(model).__mro__ if "learn" in vars(kind))
    named = (signature(learn).parameters.get("log_interval") for learn in learns)
    return next((int(each.default) for each in named if each is not None), 1)


def resumed_logger(model: BaseAlgorithm, note: dict[str, Any]) -> Logger:
    """A logger that appends to the log of a saved state."""
    folder = note["log_folder"]
    names = ["stdout"] if model.verbose > 0 or folder is None else []
    names += [] if model.tensorboard_log is None else ["tensorboard"]
    logger = IterationLogger(folder, [make_output_format(name, folder or "") for name in names])
    logger.before = iterations_before(model, note)
    return logger
