"""Finds interrupted runs and prepares to resume them; its import does not load PyTorch."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.pipeline.digests import STATE_FOLDER, DamagedFileError, digest_of
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.pipeline.loaded_code import DISTRIBUTIONS, distributions
from rl_yardstick.pipeline.runs import (
    FINISHED,
    TRAINED_AGENT,
    Run,
    environment_name,
    has_state,
    numbered_runs,
    recorded_versions,
    remove_states,
)
from rl_yardstick.pipeline.train_spec import TrainSpec, completed
from rl_yardstick.pipeline.user_modules import UserModule, changed_since
from rl_yardstick.safe_files.files import NO_LIMIT, UnsafeFileError, opened

if TYPE_CHECKING:
    from rl_yardstick.pipeline.state_files import SavedState

# Settings that comparisons of specs ignore, and that may change when a run resumes.
_SHOWN_ONLY = ("verbose", "progress", "log_folder", "gym_packages", "user_modules", "unique_id")

EVENT_FILES = "events.out.tfevents.*"
# Named by the numbers of environments; a wrapper in the settings restarts its file.
MONITOR_FILES = "[0-9]*.monitor.csv"
_PIECE = 1 << 20  # bytes

# A length in bytes, and the checksum of these bytes of a file.
Position = tuple[int, int]


@dataclass(frozen=True)
class SaveInterval:
    """How often to save the state."""

    seconds: float = 0.0  # between two saves; 0: saving takes `SHARE_OF_TIME`
    steps: int = 0  # steps between two saves instead, counted over all environments
    is_off: bool = False  # saves no state


@dataclass(frozen=True)
class StateKeeping:
    """How a training saves, resumes and removes its state."""

    interval: SaveInterval = SaveInterval()
    state: SavedState | None = None  # the state to resume from
    goes_on: bool = False  # uses the run folder of an earlier process, maybe without a state
    was_cut_off: bool = False  # an earlier process was interrupted: save sooner
    stays: bool = False  # keeps the state of a finished run


def newest_unfinished(log_folder: Path, algo: str, env_id: str) -> Run:
    """The newest unfinished run of an agent on an environment."""
    name = environment_name(env_id)
    runs = [Run(path, name) for _, path in numbered_runs(log_folder / algo, name)]
    for run in reversed(runs):
        with suppress(DamagedFileError):
            if run.recorded_spec() and not is_finished(run):
                return run
    there = f"all {len(runs)} are finished" if runs else "there is none at all"
    raise UserError(f"no run of {algo} on {name} in {log_folder} was interrupted: {there}")


def run_of_spec(spec: TrainSpec, any_seed: bool) -> Run | None:
    """The newest run with the same settings, finished or not; None if there is none."""
    name = environment_name(spec.env_id)
    wanted = _settings(spec.as_data(), any_seed)
    for _, path in reversed(numbered_runs(spec.log_folder / spec.algo, name)):
        run = Run(path, name)
        try:
            recorded = run.recorded_spec()
        except DamagedFileError:
            continue
        if recorded and _settings(completed(recorded), any_seed) == wanted:
            return run
    return None


def is_finished(run: Run) -> bool:
    """Whether a run is finished."""
    return run.read_info().get("state") == FINISHED


def recorded_training(run: Run, modules: Iterable[UserModule]) -> TrainSpec:
    """The spec of a run; its user modules have to be typed again."""
    recorded = run.recorded_spec()
    if not recorded:
        raise UserError(f"{run.path} has no record of a training of this project")
    data, typed = completed(recorded), tuple(modules)
    missing = [name for name in data["gym_packages"] if name not in {m.name for m in typed}]
    if missing:
        raise UserError(f"the run needs --gym-packages {' '.join(missing)}: type it again")
    raw = data["hyperparams"]
    if not isinstance(raw, dict) or environment_name(str(data["env_id"])) != run.env_name:
        what = "its hyperparameters or its environment are invalid"
        raise UserError(f"{run.info_path} is damaged: {what}")
    return replace(
        TrainSpec.of_data({**data, "user_modules": ()}),
        log_folder=run.path.parent.parent,
        gym_packages=tuple(module.name for module in typed),
        user_modules=typed,
        verbose=1,
        progress=False,
    )


def go_on(run: Run, keeping: StateKeeping, tell: Callable[[str], object]) -> StateKeeping:
    """Reset a run's files to its newest state, or its beginning; report differences."""
    from rl_yardstick.pipeline.state_files import newest_state  # imports PyTorch

    info, now = run.read_info(), {**distributions(), **recorded_versions()}
    found = [info.get(name) for name in (DISTRIBUTIONS, "versions")]
    before = {k: v for known in found if isinstance(known, dict) for k, v in known.items()}
    known = {name: before[name] for name in now if name in before}
    changed = [f"{name} {was} -> {now[name]}" for name, was in known.items() if was != now[name]]
    if changed:
        what = "the run began with other versions, so that its result may differ"
        tell(f"{what}: {', '.join(changed)}")
    state = newest_state(run.state_path, tell) if has_state(run.state_path) else None
    if state is None:  # remove files that a restarted run would not overwrite
        remove_states(run.state_path)
        for path in monitor_files(run.path):  # a hard link keeps the content
            path.unlink()
    else:
        if state.note["spec"] != settings_digest(run.recorded_spec()):
            raise UserError(f"{run.state_path} holds the state of a run with other settings")
        if not state.is_of_these_sources:
            tell(
                f"{run.state_path} was saved by other code of Yardstick, so the result may "
                "differ; remove it to start the run again"
            )
        cut_back(run.path, state.note["log_folder"], state.note["files"])
    return replace(keeping, state=state, goes_on=True, was_cut_off=True)


def tell_changes(run: Run, spec: TrainSpec, tell: Callable[[str], object]) -> None:
    """Report files that changed since a run began: the user's modules, the agent of -i."""
    changed = changed_since(spec.user_modules, run.path)
    agent, before = spec.trained_agent, run.read_info().get(TRAINED_AGENT)
    if agent is not None and before is not None and agent.is_file() and digest_of(agent) != before:
        changed.append(agent)
    for path in changed:
        tell(f"{path} has changed since the run began, so that its result may differ")


def _settings(spec: Mapping[str, Any], any_seed: bool) -> Any:
    left_out = (*_SHOWN_ONLY, "seed") if any_seed else _SHOWN_ONLY
    return json.loads(json.dumps({k: v for k, v in spec.items() if k not in left_out}))


def settings_digest(spec: Mapping[str, Any]) -> str:
    """The digest of a run's settings."""
    text = json.dumps(spec, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


# --- files to which a training only appends ------------------------------------------------------


def log_positions(run_folder: Path, log_folder: str | None) -> dict[str, Position]:
    """Positions in Monitor's files, by name, and in TensorBoard's, by absolute path."""
    paths = {path.name: path for path in monitor_files(run_folder)}
    paths |= {str(path): path for path in _event_files(log_folder)}
    return {name: _position(path, path.stat().st_size) for name, path in paths.items()}


def cut_back(run_folder: Path, log_folder: str | None, positions: Mapping[str, Position]) -> None:
    """Remove appended data by writing new files, so that hard links to the old ones keep it."""
    for name, position in positions.items():
        path = run_folder / name  # or the name itself, if it is absolute
        try:
            found = _position(path, position[0])
        except (FileNotFoundError, UnsafeFileError):
            found = None
        if found != tuple(position):
            raise UserError(
                f"{path} has changed since the run wrote it, so the run cannot resume; remove "
                f"{run_folder / STATE_FOLDER} to begin the run again"
            )
    for path in [*monitor_files(run_folder), *_event_files(log_folder)]:
        name = path.name if path.parent == run_folder else str(path)
        if name in positions:
            with replacing(path) as draft:
                draft.writelines(_pieces(path, positions[name][0]))
        else:
            path.unlink()


def _position(path: Path, length: int) -> Position:
    """Length and checksum of the first bytes of a file."""
    checksum = n_read = 0
    for piece in _pieces(path, length):
        checksum, n_read = zlib.crc32(piece, checksum), n_read + len(piece)
    return n_read, checksum


def _pieces(path: Path, length: int) -> Iterator[bytes]:
    """The first bytes of a file, or all if it has fewer."""
    with opened(path, NO_LIMIT) as file:
        while piece := file.read(min(_PIECE, length)):
            yield piece
            length -= len(piece)


def monitor_files(run_folder: Path) -> list[Path]:
    """The files to which Monitor appends."""
    return sorted(run_folder.glob(MONITOR_FILES))


def _event_files(log_folder: str | None) -> list[Path]:
    return [] if log_folder is None else sorted(Path(log_folder).resolve().glob(EVENT_FILES))
