"""Runs that were cut off: which there are, and what is needed to go on with one."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.digests import DamagedFileError, digest_of
from pipeline.errors import UserError
from pipeline.module_records import changed_since
from pipeline.resuming.log_positions import cut_back, monitor_files
from pipeline.resuming.state_folder import has_state, remove_states, settings_digest
from pipeline.resuming.state_keeping import StateKeeping
from pipeline.runs import (
    FINISHED,
    TRAINED_AGENT,
    Run,
    environment_name,
    numbered_runs,
    recorded_versions,
)
from pipeline.train_spec import TrainSpec, completed
from pipeline.user_modules import UserModule

# What may be given anew, and what stands in no settings of a run.
_SHOWN_ONLY = ("verbose", "progress", "log_folder", "gym_packages", "user_modules", "unique_id")


def newest_unfinished(log_folder: Path, algo: str, env_id: str) -> Run:
    """The newest run of an agent on an environment that is not finished.

    Raises:
        UserError: if there is none.
    """
    name = environment_name(env_id)
    runs = [Run(path, name) for _, path in numbered_runs(log_folder / algo, name)]
    for run in reversed(runs):
        if _may_go_on(run):
            return run
    there = f"all {len(runs)} are finished" if runs else "there is none at all"
    raise UserError(f"no run of {algo} on {name} in {log_folder} was interrupted: {there}")


def run_of_spec(spec: TrainSpec, any_seed: bool) -> Run | None:
    """The newest run of the very same settings, finished or not; None where there is none.

    Args:
        spec: the settings.
        any_seed: whether the seed does not matter.
    """
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
    """Whether a run came to its end.

    Raises:
        UserError: if ``run.json`` is damaged.
    """
    return run.read_info().get("state") == FINISHED


def recorded_training(run: Run, modules: Iterable[UserModule]) -> TrainSpec:
    """What a run was asked to do.

    Args:
        run: the run folder.
        modules: those of the user's that were typed again.

    Raises:
        UserError: if the folder does not say, or needs a module that was not typed.
    """
    recorded = run.recorded_spec()
    if not recorded:
        raise UserError(f"{run.path} does not say what it was asked for: it is no run of ours")
    data, typed = completed(recorded), tuple(modules)
    missing = [name for name in data["gym_packages"] if name not in {m.name for m in typed}]
    if missing:
        raise UserError(f"the run needs --gym-packages {' '.join(missing)}: type it again")
    raw = data["hyperparams"]
    if not isinstance(raw, dict) or environment_name(str(data["env_id"])) != run.env_name:
        raise UserError(
            f"{run.info_path} is damaged: its hyperparameters or its names are not ours"
        )
    return replace(
        TrainSpec.of_data({**data, "user_modules": ()}),
        log_folder=run.path.parent.parent,
        gym_packages=tuple(module.name for module in typed),
        user_modules=typed,
        verbose=1,
        progress=False,
    )


def go_on(run: Run, keeping: StateKeeping, tell: Callable[[str], object]) -> StateKeeping:
    """Put the files of a run back to where its newest state was, or to its beginning.

    Args:
        run: the run folder.
        keeping: what becomes of states from now on.
        tell: told in one line what will not be as it was.

    Raises:
        UserError: if its states are all damaged or another user's, or its files are gone.
    """
    from pipeline.resuming.saved_states import newest_state  # it takes PyTorch

    _tell_versions(run, tell)
    state = newest_state(run.state_path, tell) if has_state(run.state_path) else None
    if state is None:
        _forget(run)
    else:
        if state.note["spec"] != settings_digest(run.recorded_spec()):
            raise UserError(f"{run.state_path} holds the state of a run of other settings")
        if not state.is_of_these_sources:
            tell(
                f"{run.state_path} was saved by other sources of Yardstick, so that the result may "
                "differ; remove it to begin the run anew"
            )
        cut_back(run.path, state.note["log_folder"], state.note["files"])
    return replace(keeping, state=state, goes_on=True, was_cut_off=True)


def tell_changes(run: Run, spec: TrainSpec, tell: Callable[[str], object]) -> None:
    """Tell of files that are no more what a run began with: the user's modules, the agent of -i."""
    changed = changed_since(spec.user_modules, run.path)
    agent, before = spec.trained_agent, run.read_info().get(TRAINED_AGENT)
    if agent is not None and before is not None and agent.is_file() and digest_of(agent) != before:
        changed.append(agent)
    for path in changed:
        tell(f"{path} has changed since the run began, so that its result may differ")


def _may_go_on(run: Run) -> bool:
    try:
        return bool(run.recorded_spec()) and not is_finished(run)
    except DamagedFileError:
        return False


def _settings(spec: Mapping[str, Any], any_seed: bool) -> Any:
    left_out = (*_SHOWN_ONLY, "seed") if any_seed else _SHOWN_ONLY
    return json.loads(json.dumps({k: v for k, v in spec.items() if k not in left_out}))


def _tell_versions(run: Run, tell: Callable[[str], object]) -> None:
    versions, now = run.read_info().get("versions"), recorded_versions()
    before = versions if isinstance(versions, dict) else {}
    changed = [
        f"{name} {before[name]} -> {now[name]}"
        for name in now
        if before.get(name, now[name]) != now[name]
    ]
    if changed:
        what = ", ".join(changed)
        tell(f"the run began with other versions, so that its result may differ: {what}")


def _forget(run: Run) -> None:
    """Remove what a run without a state would not write over, beginning anew."""
    remove_states(run.state_path)
    for path in monitor_files(run.path):  # another name of one keeps what it holds
        path.unlink()
