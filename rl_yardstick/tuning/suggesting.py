"""Suggests the settings of trials, and plans their runs.

The first trial has the shipped settings; the others come from one of Optuna's samplers. A sampler
that restarts after a kill would draw its first settings again. So each trial has its own generator,
seeded by the search's seed and the trial's number.
"""

from __future__ import annotations

import hashlib
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from optuna import Study, Trial
from optuna.distributions import BaseDistribution
from optuna.exceptions import ExperimentalWarning
from optuna.samplers import BaseSampler, RandomSampler, TPESampler
from optuna.trial import FrozenTrial

from rl_yardstick.experiments.plan import PlannedRun, plan, specs_of
from rl_yardstick.experiments.study import AgentSpec
from rl_yardstick.pipeline.components import arguments_of
from rl_yardstick.pipeline.files import json_text
from rl_yardstick.pipeline.settings import COMPONENTS, layered
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.tuning.search_spaces import SearchSpace, corners
from rl_yardstick.tuning.tuning_spec import TuningSpec


@dataclass(eq=False)
class SeededSampler(BaseSampler):
    """A new sampler of Optuna for each trial, and for each independently drawn parameter.

    Options are explicit although they are Optuna 5's defaults, because Optuna 5 changed them. TPE
    draws parameters jointly (``multivariate``), conditional ones together with others of the same
    condition (``group``), and treats running trials as bad ones (``constant_liar``), so that
    parallel trials do not try the same settings.
    """

    tuning: TuningSpec

    def _made(self, *numbers: int) -> BaseSampler:
        seeds = np.random.SeedSequence([self.tuning.seed, *numbers])
        seed = int(seeds.generate_state(1)[0])
        if self.tuning.sampler == "random":
            return RandomSampler(seed=seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)  # of ``group``, since 2.8
            return TPESampler(
                seed=seed,
                n_startup_trials=self.tuning.n_startup_trials,
                n_ei_candidates=24,
                multivariate=True,
                group=True,
                constant_liar=True,
            )

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, Any]:
        # Optuna calls this first; the sampler is kept for the second call.
        self._sampler = self._made(trial.number)
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        return self._sampler.sample_relative(*args, **kwargs)

    def sample_independent(
        self,
        study: Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        # Seeded by name, because after a kill some parameters of a trial are stored and not drawn.
        sampler = self._made(trial.number, zlib.crc32(param_name.encode()))
        return sampler.sample_independent(study, trial, param_name, param_distribution)


class Suggestions:
    """Suggests hyperparameters for each trial; ``shipped`` includes the user's fixed settings.

    Attributes:
        space: the search space, widened if necessary to include the shipped settings.
        first: the parameters of the first trial, which has the shipped settings.
        fixed: the parameters of settings that the user has fixed.
        n_free: the number of parameters to choose.
    """

    def __init__(self, tuning: TuningSpec, space: SearchSpace, shipped: Mapping[str, Any]) -> None:
        self.tuning, self.shipped = tuning, dict(shipped)
        self.space, self.first = space.including(self.shipped)
        given = set(tuning.agent.settings)
        dimensions = [each for each in self.space.entries.values() if given.issuperset(each.keys)]
        names = [name for each in dimensions for name in each.distributions]
        self.fixed = {name: self.first[name] for name in names if name in self.first}
        self.n_free = len(self.space.distributions.keys() - self.fixed.keys())

    def entry(self, trial: Trial) -> dict[str, Any]:
        """The hyperparameters of a trial."""
        suggested = self.space.suggest(trial)
        return self.merged(suggested) if trial.number else self.shipped

    def merged(self, suggested: Mapping[str, Any]) -> dict[str, Any]:
        """The shipped hyperparameters with suggested settings and the user's fixed settings.

        Batches that do not divide the buffer of an on-policy agent are replaced by the nearest that
        do, as the library recommends; the sampler keeps the parameters that it drew.
        """
        entry = self.space.merged(self.shipped, suggested)
        entry = layered(entry, self.tuning.agent.settings)
        known, sizes = arguments_of(self.tuning.agent.algo), ("n_steps", "n_envs", "batch_size")
        splits_buffer = {"n_steps", "batch_size"} <= {*known} and "buffer_size" not in known
        is_searched = not set(sizes).isdisjoint(self.space.keys)
        if splits_buffer and is_searched and "batch_size" not in self.tuning.agent.settings:
            n_steps, n_envs, batch_size = ({**self.space.defaults, **entry}[key] for key in sizes)
            divisors = [k for k in range(2, n_steps * n_envs + 1) if n_steps * n_envs % k == 0]
            nearest = min(divisors, key=lambda k: abs(k - batch_size), default=batch_size)
            entry |= {} if nearest == batch_size else {"batch_size": nearest}
        return entry

    def check(self, root: Path) -> None:
        """Raise UserError if the agent refuses an end or a word of the space."""
        for settings in corners(self.space):
            planned_runs(self.tuning, root, self.merged(settings))


# --- the runs of a trial: one for each seed; trials with equal settings share folders -------------


def name_of(entry: Mapping[str, Any]) -> str:
    """The name of settings; independent of their order."""
    text = json_text({key: entry[key] for key in sorted(entry)})
    return f"settings-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def shipped_entry(spec: TrainSpec) -> dict[str, Any]:
    """The entry of a training in the form of files, without what follows from its other values."""
    entry = spec.hyperparams
    scaled = entry.get("normalize")
    if scaled is not None and scaled.get("gamma") == spec.algorithm.get("gamma"):
        entry["normalize"] = {key: scaled[key] for key in scaled if key != "gamma"} or True
    alone = {key: entry[key][0] for key in COMPONENTS if len(entry.get(key, ())) == 1}
    return {**entry, **alone}


def planned_runs(tuning: TuningSpec, root: Path, entry: Mapping[str, Any]) -> list[PlannedRun]:
    """The runs of a trial, in the order of its seeds."""
    where = "its search space" if tuning.search_space is None else str(tuning.search_space)
    settings, algo = tuning.searched(entry), tuning.agent.algo
    agent = AgentSpec(name_of(entry), algo, settings, tuned=False, where=where)
    study = replace(tuning.study, agents=(agent,), n_seeds=1)
    specs = specs_of(study)
    return [plan(replace(study, first_seed=seed), root, specs=specs)[0] for seed in tuning.seeds]
