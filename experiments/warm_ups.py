"""What is compiled once for all runs of a study: learning rules of the user's own.

Machine code of ours is kept on disk. That of a rule of the user's is not, since nobody knows all
the sources that it depends on; and each run has a process of its own, which would compile it anew.
So the server that runs are forked from takes a few steps with each such rule before the first.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from experiments.plan import PlannedRun
from machine_code.sources import kept_packages
from pipeline.models.load import agent_class
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.user_modules import UserModule, import_again

N_STEPS = 10
# It goes by an environment variable, which Linux bounds at 128 KB.
MAX_CHARACTERS = 100_000


def warm_ups(planned: Sequence[PlannedRun]) -> str:
    """The trainings that compile what the runs need, as JSON for `take_steps`."""
    chosen: dict[tuple[str, str], dict[str, Any]] = {}
    for run in planned:
        spec, key = run.spec, (run.spec.algo, run.environment)
        # A batch is one process, and a batch alone.
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
    from agents.compiled.learning_algorithm import LearningAlgorithm

    algorithm = agent_class(algo)
    is_ours = algorithm.__module__.partition(".")[0] in kept_packages()
    return issubclass(algorithm, LearningAlgorithm) and not is_ours


def take_steps(wanted: str) -> None:
    """Do the trainings of `warm_ups`; whatever goes wrong, the run itself will say so."""
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
    """Train, and keep nothing of it but what has been compiled."""
    from rich.console import Console

    from pipeline.training import train

    with TemporaryDirectory() as folder:
        spec = replace(spec, log_folder=Path(folder), pictures=False, verbose=0)
        train(spec, Console(quiet=True), {}, "")
