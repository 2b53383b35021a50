"""Suggests the settings of trials, and plans their runs.

The first trial has the shipped settings; the others are points of a grid, or come from one of
Optuna's samplers. A sampler that restarts after a kill would draw its first settings again. So each
trial has its own generator, seeded by the search's seed and the trial's number.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import random
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from optuna import Study, Trial
from optuna.distributions import BaseDistribution
from optuna.exceptions import ExperimentalWarning
from optuna.samplers import BaseSampler, GPSampler, RandomSampler, TPESampler
from optuna.trial import FixedTrial, FrozenTrial

from rl_yardstick.agents import load_algorithm
from rl_yardstick.experiments.plan import PlannedRun, plan, specs_of
from rl_yardstick.experiments.study import AgentSpec, layered
from rl_yardstick.pipeline.components import arguments_of
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import json_text
from rl_yardstick.pipeline.settings import COMPONENTS
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.tuning.dimensions import spread
from rl_yardstick.tuning.search_spaces import SearchSpace, corners
from rl_yardstick.tuning.tuning_spec import TuningSpec

# Points of the largest grid, which must fit into memory, and its values of one number.
MOST_POINTS, MOST_VALUES = 1_000_000, 100


class SeededSampler(BaseSampler):
    """A new sampler of Optuna for each trial, and for each independently drawn parameter.

    Options are explicit although they are Optuna 5's defaults, because Optuna 5 changed them. TPE
    draws parameters jointly (``multivariate``), conditional ones together with others of the same
    condition (``group``), and treats running trials as bad ones (``constant_liar``), so that
    parallel trials do not try the same settings. A grid has fixed trials, and ignores its sampler.
    """

    def __init__(self, tuning: TuningSpec) -> None:
        self._tuning = tuning

    def _made(self, *numbers: int) -> BaseSampler:
        seeds = np.random.SeedSequence([self._tuning.seed, *numbers])
        seed, n_startup = int(seeds.generate_state(1)[0]), self._tuning.n_startup_trials
        if self._tuning.sampler == "tpe":
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ExperimentalWarning)  # of ``group``, since 2.8
                return TPESampler(
                    seed=seed,
                    n_startup_trials=n_startup,
                    n_ei_candidates=24,
                    multivariate=True,
                    group=True,
                    constant_liar=True,
                )
        if self._tuning.sampler == "gp":
            return GPSampler(
                seed=seed,
                n_startup_trials=n_startup,
                independent_sampler=RandomSampler(seed=seed),
                deterministic_objective=False,
                warn_independent_sampling=False,
            )
        return RandomSampler(seed=seed)

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
    """Suggests hyperparameters for each trial; ``shipped`` includes the user's fixed settings."""

    def __init__(self, tuning: TuningSpec, space: SearchSpace, shipped: Mapping[str, Any]) -> None:
        self.tuning, self.shipped = tuning, dict(shipped)
        # The space, widened if necessary, and the parameters of the first trial.
        self.space, self.first = space.including(self.shipped)
        # The parameters of settings that the user has fixed.
        given = set(tuning.agent.settings)
        dimensions = [each for each in self.space.entries.values() if given.issuperset(each.keys)]
        names = [name for each in dimensions for name in each.distributions]
        self._fixed = {name: self.first[name] for name in names if name in self.first}

    @cached_property
    def fits_batches(self) -> bool:
        """Whether trials sample sizes of batches or buffers, and the agent splits its buffer."""
        from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

        algo = self.tuning.agent.algo
        keys = {"batch_size", "n_steps", "n_envs"} & set(self.space.keys)
        is_free = bool(keys - set(self.tuning.agent.settings))
        splits = "batch_size" in arguments_of(algo)
        return is_free and splits and issubclass(load_algorithm(algo), OnPolicyAlgorithm)

    @property
    def n_free(self) -> int:
        """The number of parameters to choose."""
        return len(self.space.distributions.keys() - self._fixed.keys())

    @cached_property
    def grid(self) -> list[dict[str, Any]]:
        """The points of the finest grid with fewer points than trials, in random order."""
        n_trials, found = self.tuning.n_trials, self._points(2)
        if len(found) >= n_trials:
            raise UserError(
                f"--sampler grid: {len(found):,} settings with two values of each number, beside "
                f"the shipped ones, and --trials says {n_trials:,}: give more trials or a smaller "
                "--search-space"
            )
        finer, n = self._points(3), 3
        while len(found) < len(finer) < n_trials and n < MOST_VALUES:
            found, n = finer, n + 1
            finer = self._points(n)
        random.Random(self.tuning.seed).shuffle(found)  # noqa: S311  # an order, and no secret
        return found

    def _points(self, n: int) -> list[dict[str, Any]]:
        """The distinct points of a grid; conditional parameters can make points equal."""
        values = {name: spread(kind, n) for name, kind in self.space.distributions.items()}
        values |= {name: [value] for name, value in self._fixed.items()}
        points: dict[str, dict[str, Any]] = {}
        for point in itertools.islice(itertools.product(*values.values()), MOST_POINTS):
            trial = FixedTrial(dict(zip(values, point, strict=True)))
            self.space.suggest(trial)
            points[json.dumps(trial.params, sort_keys=True)] = trial.params
        return list(points.values())

    @property
    def n_trials(self) -> int:
        """The number of trials; with a grid, at most one more than the number of points."""
        n_trials = self.tuning.n_trials
        return min(n_trials, 1 + len(self.grid)) if self.tuning.sampler == "grid" else n_trials

    def params(self, number: int) -> dict[str, Any]:
        """Parameters of a trial that are fixed before sampling."""
        if number == 0:
            return self.first
        return self.grid[number - 1] if self.tuning.sampler == "grid" else self._fixed

    def entry(self, trial: Trial) -> dict[str, Any]:
        """The hyperparameters of a trial."""
        suggested = self.space.suggest(trial)
        return self.merged(suggested) if trial.number else self.shipped

    def merged(self, suggested: Mapping[str, Any]) -> dict[str, Any]:
        """The shipped hyperparameters with suggested settings and the user's fixed settings."""
        entry = self.space.merged(self.shipped, suggested)
        entry = layered(entry, self.tuning.agent.settings)
        return self._with_fitting_batch(entry) if self.fits_batches else entry

    def _with_fitting_batch(self, entry: dict[str, Any]) -> dict[str, Any]:
        """The entry with batches that divide the buffer of steps, as the library recommends.

        If the user has fixed the batch size, the number of steps is changed instead. The sampler
        keeps the parameters that it drew.
        """
        fixed, names = self.tuning.agent.settings, ("n_steps", "batch_size", "n_envs")
        n_steps, batch_size, n_envs = ({**self.space.defaults, **entry}[name] for name in names)
        if batch_size is None:
            return entry
        if "batch_size" not in fixed:
            divisors = [k for k in range(2, n_steps * n_envs + 1) if n_steps * n_envs % k == 0]
            nearest = min(divisors, key=lambda k: abs(k - batch_size), default=batch_size)
            return entry if nearest == batch_size else {**entry, "batch_size": nearest}
        unit = batch_size // math.gcd(batch_size, n_envs)
        nearest = max(round(n_steps / unit), 1) * unit
        is_fixed = nearest == n_steps or "n_steps" in fixed
        return entry if is_fixed else {**entry, "n_steps": nearest}

    def check(self, root: Path) -> None:
        """Check that the agent takes all ends and words of the space.

        Raises:
            UserError: with the file of the space, and what is wrong there.
        """
        for settings in corners(self.space):
            planned_runs(self.tuning, root, self.merged(settings))


# --- the runs of a trial: one for each seed; trials with equal settings share folders -------------


def name_of(entry: Mapping[str, Any]) -> str:
    """The name of settings; independent of their order."""
    text = json_text({key: entry[key] for key in sorted(entry)})
    return f"settings-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def shipped_run(tuning: TuningSpec, root: Path) -> PlannedRun:
    """A planned run of the agent with the initial settings."""
    return plan(replace(tuning.study, n_seeds=1), root)[0]


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
