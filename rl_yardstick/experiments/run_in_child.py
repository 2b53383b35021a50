"""The work of child processes: do a run, and before the first run compile what runs share.

A run starts, or resumes from a state of another process. Machine code of this project is cached on
disk, but not that of the user's learning rules, whose sources are not all known. So the fork server
takes a few steps with each rule of the user, which compiles it once for all runs.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

from rl_yardstick.experiments.bandits import do_batch
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.run_folders import (
    claim_draft,
    holds_state,
    put_run_in_place,
    take_over,
)
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.failures import is_of_the_machine
from rl_yardstick.pipeline.loaded_code import recorded_code
from rl_yardstick.pipeline.locks import SECONDS_BETWEEN_SIGNS, give_sign
from rl_yardstick.pipeline.models.load import agent_class
from rl_yardstick.pipeline.runs import Run, recorded_versions, remove_states
from rl_yardstick.pipeline.settings.hyperparams import split
from rl_yardstick.pipeline.signs_of_life import Heartbeat
from rl_yardstick.pipeline.train_spec import TrainSpec
from rl_yardstick.pipeline.training import train
from rl_yardstick.pipeline.unfinished_runs import StateKeeping, go_on
from rl_yardstick.pipeline.user_modules import UserModule, import_again


def do_run(planned: PlannedRun, draft: Path, command: str) -> None:
    """Train in ``draft``, and rename it into place; an existing result of another process stays.

    If a dead process has left a state of the run, training resumes from it.
    """
    import_again(planned.spec.user_modules)
    take_over(draft)
    heart = Heartbeat(lambda: give_sign(draft), SECONDS_BETWEEN_SIGNS)
    heart.start()
    try:
        _do_or_go_on(planned, draft, command)
    finally:
        heart.stop()
    put_run_in_place(planned, draft)


def _do_or_go_on(planned: PlannedRun, draft: Path, command: str) -> None:
    """Finish a run in its draft.

    If another process has left the draft, the run resumes from its state, provided that the state
    is complete and saved with the same settings, sources and versions; otherwise the run starts
    again.
    """
    run = Run(draft, planned.run.env_name)
    keeping = _to_go_on_with(planned, run)
    if not keeping.goes_on:
        claim_draft(draft)
        run.params_path.mkdir()
        if planned.spec.tensorboard_log is not None:
            shutil.rmtree(planned.spec.tensorboard_log, ignore_errors=True)  # of an earlier try
    if planned.is_batch:
        do_batch(planned.spec, planned.n_runs, run, command)
        return
    args = {"algo": planned.spec.algo, "env": planned.spec.env_id, "seed": planned.seed}
    try:
        train(planned.spec, Console(quiet=True), args, command, run, keeping)
    except Exception as error:
        if not is_of_the_machine(error):
            remove_states(run.state_path)  # the next try starts again, maybe with other code
        raise


def _to_go_on_with(planned: PlannedRun, run: Run) -> StateKeeping:
    """The state that another process has left, or None."""
    anew = StateKeeping(was_cut_off=run.path.is_dir())
    if planned.is_batch or not holds_state(run.path) or not planned.is_of(run):
        return anew
    code = {"versions": recorded_versions(), **recorded_code(planned.spec.user_modules)}
    info = run.read_info()
    if {name: info.get(name) for name in code} != code:
        return anew
    try:
        keeping = go_on(run, StateKeeping(), str)  # nobody reads messages here
    except UserError:  # damaged, or another user's
        return anew
    is_ours = keeping.state is None or keeping.state.is_of_these_sources
    return keeping if is_ours else anew


# --- Compiling once for all runs.

N_STEPS = 10
# Passed in an environment variable, which Linux limits to 128 KB.
MAX_CHARACTERS = 100_000


def warm_ups(planned: Sequence[PlannedRun]) -> str:
    """The trainings that compile the user's rules of these runs, as JSON for `take_steps`."""
    chosen: dict[tuple[str, str], dict[str, Any]] = {}
    for run in planned:
        spec, key = run.spec, (run.spec.algo, run.environment)
        # A batch has its own process anyway.
        if not spec.user_modules or run.is_batch or key in chosen or not run.is_to_do:
            continue
        if _is_compiled_rule_of_users(spec.algo):
            chosen[key] = {
                "algo": spec.algo,
                "env_id": spec.env_id,
                "hyperparams": spec.saved_hyperparams,
                "modules": [asdict(module) for module in spec.user_modules],
            }
    text = json.dumps(list(chosen.values()))
    return text if len(text) < MAX_CHARACTERS else "[]"


def _is_compiled_rule_of_users(algo: str) -> bool:
    from rl_yardstick.agents.compiled.learning_algorithm import LearningAlgorithm

    algorithm = agent_class(algo)
    is_ours = algorithm.__module__.startswith("rl_yardstick.")
    return issubclass(algorithm, LearningAlgorithm) and not is_ours


def take_steps(wanted: str) -> None:
    """Do the trainings of `warm_ups`; ignores errors, which the run itself will report."""
    for item in json.loads(wanted):
        with contextlib.suppress(Exception):
            modules = tuple(UserModule(**module) for module in item["modules"])
            import_again(modules)
            raw = {k: v for k, v in item["hyperparams"].items() if k != "n_episodes"}
            raw["n_timesteps"] = N_STEPS
            spec = TrainSpec(
                item["algo"],
                item["env_id"],
                split(raw),
                raw,
                seed=0,
                eval_freq=-1,
                gym_packages=tuple(module.name for module in modules),
                user_modules=modules,
            )
            train_aside(spec)


def train_aside(spec: TrainSpec) -> None:
    """Train in a temporary folder, only to compile."""
    with TemporaryDirectory() as folder:
        spec = replace(spec, log_folder=Path(folder), pictures=False, verbose=0)
        train(spec, Console(quiet=True), {}, "")
