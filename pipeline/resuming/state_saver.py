"""Keeps the state of a training, and puts a training back into it."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import SubprocVecEnv

from agents.common.callback_horizons import Horizon
from machine_code.work_time import WorkTime
from pipeline.errors import UserError, one_line
from pipeline.evaluation.exact import ExactEvaluator
from pipeline.files import files_below, sync_file
from pipeline.progress import ProgressDisplay
from pipeline.resuming.global_generators import generator_states, set_generators
from pipeline.resuming.log_positions import Position, log_positions
from pipeline.resuming.monitor_rows import held_in, lists_in_files, read_back
from pipeline.resuming.saved_states import SavedState, save_state
from pipeline.resuming.state_folder import settings_digest
from pipeline.resuming.state_keeping import SaveInterval
from pipeline.resuming.user_state import put_back, user_state
from pipeline.run_folder import Run
from pipeline.safe_moments import StopAtSafeMoment
from pipeline.stopping import current
from pipeline.user_modules import UserModule
from snapshots.filling import NotRestorableError
from snapshots.kinds import NotRecordableError
from snapshots.recording import record
from snapshots.restoring import restore

# Saving may take this share of the time, where the user has not said how often.
SHARE_OF_TIME = 0.02
SHORTEST_INTERVAL = 1.0  # seconds
FIRST_COST = 0.05  # seconds; of states of which nothing is known
# What was cut off may be so again soon, and has to get ahead each time: its pauses begin short, and
# double, so that half of what was done since is kept.
SHORTEST_PAUSE = 0.1

# Bytes of a file since the last state. A fast table writes many times that in a second, and waiting
# until the disk has it would take more than all else.
MOST_SYNCED = 1 << 20


class StateSaver(StopAtSafeMoment):
    """Saves all that a training consists of, between two updates; the first of the callbacks.

    The state is that of the agent with its environments, of all other callbacks with the
    environments that they evaluate on, of the user's modules, and of the generators that libraries
    share.

    Args:
        run: whose folder the states go to.
        root: all callbacks, this one among them.
        interval: how often.
        tell: told in one line why no state is kept, where that is so.
        state: what the training goes on from, or None where it begins.
    """

    def __init__(
        self,
        run: Run,
        interval: SaveInterval,
        tell: Callable[[str], object],
        state: SavedState | None = None,
        was_cut_off: bool = False,
    ) -> None:
        super().__init__()
        self.run = run
        self.root: BaseCallback = self
        self.modules: tuple[UserModule, ...] = ()
        self.told: set[str] = set()
        self.interval = interval
        self.tell = tell
        self.state = state
        self.is_off = interval.is_off
        note = {} if state is None else state.note
        self.n_saved = int(note.get("number", 0))
        self.n_rollouts = int(note.get("rollouts", 0))
        self.time_before = WorkTime(
            float(note.get("seconds", 0.0)), float(note.get("cpu_seconds", 0.0))
        )
        self.started = WorkTime.now()
        self.n_synced: dict[str, int] = {}  # bytes, by the names of files
        self.stamps: dict[Path, tuple[int, int, int]] = {}  # of files that the disk has
        self.steps_at_save = 0
        self.saved_at = time.monotonic()
        self.was_cut_off = was_cut_off
        self.pause = interval.seconds or self._first_pause(note)

    @property
    def taken(self) -> WorkTime:
        """What the training has taken, in all processes that worked on it."""
        return self.time_before + (WorkTime.now() - self.started)

    def horizon(self) -> Horizon:
        if self.is_off or self.interval.steps < 1:
            return Horizon()
        steps = self.steps_at_save + self.interval.steps - self.model.num_timesteps
        return Horizon(calls=max(-(-steps // self.training_env.num_envs), 1))

    def wants_position(self) -> bool:
        return self.state is not None or self._is_due() or current().number is not None

    def at_safe_moment(self) -> None:
        if getattr(self.model, "tells_safe_moments", False):
            self._act()

    def before_stopping(self) -> None:
        """Save the state that the run is to go on from, unless a second signal is in a hurry."""
        if not (self.is_off or current().is_urgent):
            self.save()

    def _on_training_start(self) -> None:
        self.steps_at_save = self.model.num_timesteps
        self.saved_at, self.started = time.monotonic(), WorkTime.now()

    def _on_rollout_start(self) -> None:
        if not getattr(self.model, "tells_safe_moments", False):
            self._act()

    def _act(self) -> None:
        if self.state is not None:
            state, self.state = self.state, None
            self._go_back_to(state)
        elif self._is_due():
            self.save()
        self.stop_if_asked()
        self.n_rollouts += 1

    def _is_due(self) -> bool:
        if self.is_off:
            return False
        if self.interval.steps > 0:
            return self.model.num_timesteps - self.steps_at_save >= self.interval.steps
        return time.monotonic() - self.saved_at >= self.pause

    def save(self) -> None:
        """Save the state as it is, which must be a moment between two updates."""
        begun = time.monotonic()
        try:
            with _garbage_left():
                self._write()
        except NotRecordableError as error:
            self._give_up(f"no state can be kept: {one_line(error)}")
        except UserError as error:
            self._give_up(f"no state can be kept: {error}")
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

    def _first_pause(self, note: Mapping[str, Any]) -> float:
        """Seconds until the first state, where the user has not said how often.

        A training that begins waits until a state is likely to be `SHARE_OF_TIME` of it; one that
        was cut off no longer than saving took before.
        """
        if not self.was_cut_off:
            return FIRST_COST / SHARE_OF_TIME
        return max(float(note.get("pause", 0.0)) * SHARE_OF_TIME, SHORTEST_PAUSE)

    def _tell_once(self, line: str) -> None:
        """Say a line that would be the same at each state, as long as a disk is full."""
        if line not in self.told:
            self.told.add(line)
            self.tell(line)

    def _give_up(self, reason: str) -> None:
        self.is_off = True
        self.tell(f"{reason}; if this run is cut off, --resume begins it anew")

    def _write(self) -> None:
        environment = self.training_env.unwrapped
        if isinstance(environment, SubprocVecEnv):
            raise NotRecordableError("--vec-env subproc", "environments are in other processes")
        positions = log_positions(self.run.path, _log_folder(self.model))
        in_files = lists_in_files(self.training_env, self.run.path, positions)
        episodes = held_in(self.training_env, self.run.path, in_files)
        snapshot = record(self._roots(), _CONSTANTS, episodes)
        for lost in snapshot.lost:
            self._tell_once(f"{lost} is not kept: a run that goes by it may differ after --resume")
        note = {
            "folder": self._folder_names(),
            "log_folder": _log_folder(self.model),
            "files": positions,
            "episodes": in_files,
            "steps": self.model.num_timesteps,
            "rollouts": self.n_rollouts,
            **self.taken.as_data(),
            "pause": self.pause,
            "spec": settings_digest(self.run.recorded_spec()),
        }
        self._sync(positions)
        save_state(self.run.state_path, self.n_saved + 1, snapshot, note)
        self.n_saved += 1

    def _sync(self, positions: Mapping[str, Position]) -> None:
        """Let the disk have what the state is held against, and what is not written anew after it.

        Of logs that grow fast, only as far as that takes no time.
        """
        for name, (length, *_) in positions.items():
            if length - self.n_synced.get(name, 0) <= MOST_SYNCED:
                sync_file(self.run.path / name)
            self.n_synced[name] = length
        self.run.wait_for_disk(self._files_changed(positions))

    def _files_changed(self, logs: Mapping[str, Position]) -> list[Path]:
        """The files of the run beside its logs and states that the disk may not have yet."""
        changed = []
        for path in files_below(self.run.path):
            if path.parent == self.run.state_path or path.name in logs:
                continue
            status = path.stat()
            stamp = status.st_ino, status.st_mtime_ns, status.st_size
            if self.stamps.get(path) != stamp:
                self.stamps[path] = stamp
                changed.append(path)
        return changed

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
            restore(state.snapshot, roots, moved)
            read_back(self.training_env, self.run.path, state.note.get("episodes", {}))
        except Exception as error:
            if state.is_of_these_sources and not isinstance(error, NotRestorableError):
                raise
            raise UserError(
                f"{self.run.state_path} does not fit what the run's settings make today: "
                f"{one_line(error)}; remove it to begin the run again"
            ) from error
        put_back(self.modules, roots["modules"])
        set_generators(roots["generators"])
        self.steps_at_save = self.model.num_timesteps
        self.saved_at = time.monotonic()

    def _folder_names(self) -> list[str]:
        """The run folder as it was given, and from the root."""
        return [str(self.run.path), str(self.run.path.absolute())]


@contextmanager
def _garbage_left() -> Iterator[None]:
    """Do without the garbage collector: a state has no cycles, and may set off a search for them.

    That goes through all that the libraries hold, and takes several times as long as the state.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.collect(0)  # else what was made meanwhile would set off the search as soon as it can
            gc.enable()


def _log_folder(model: BaseAlgorithm) -> str | None:
    folder = model.logger.dir
    return None if folder is None else str(Path(folder).absolute())


# What is made anew from the settings, and holds nothing that training changes.
_CONSTANTS = (KVWriter, Logger, ExactEvaluator, ProgressDisplay, Run, StateSaver)
