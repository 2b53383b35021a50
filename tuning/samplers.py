"""What suggests settings: Optuna's samplers, each option said, each trial with numbers of its own.

A sampler that several drivers seed alike would draw the same settings in all of them, and one that
goes on after a kill would draw its first again. So each trial has a generator of its own, seeded by
the search's seed and the trial's number, and each parameter that is drawn alone one that is seeded
by its name too: which driver asks, and when it was started, is no matter.
"""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution
from optuna.exceptions import ExperimentalWarning
from optuna.samplers import BaseSampler, GPSampler, RandomSampler, TPESampler
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from tuning.evolution import EvolutionSampler
from tuning.tuning_spec import TuningSpec


class SeededSampler(BaseSampler):
    """A sampler made anew for each trial.

    Args:
        make: makes one from a seed.
        seed: of the search.
    """

    def __init__(self, make: Callable[[int], BaseSampler], seed: int) -> None:
        self._make, self._seed = make, seed
        self._number: int | None = None
        self._sampler: BaseSampler = make(seed)

    def _of(self, trial: FrozenTrial) -> BaseSampler:
        if trial.number != self._number:
            self._number = trial.number
            self._sampler = self._make(_drawn_from([self._seed, trial.number]))
        return self._sampler

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        self._number = None
        self._of(trial).before_trial(study, trial)

    def infer_relative_search_space(
        self, study: Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        return self._of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        return self._of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self,
        study: Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        # By its name: after a kill some of a trial's parameters are in the storage, and not drawn.
        numbers = [self._seed, trial.number, zlib.crc32(param_name.encode())]
        sampler = self._make(_drawn_from(numbers))
        return sampler.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self,
        study: Study,
        trial: FrozenTrial,
        state: TrialState,
        values: Sequence[float] | None,
    ) -> None:
        self._of(trial).after_trial(study, trial, state, values)


def _drawn_from(numbers: list[int]) -> int:
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def make_sampler(tuning: TuningSpec) -> BaseSampler:
    """The sampler that a tuning asks for; of a grid, whose trials are settled, one for nothing."""
    n_startup = tuning.n_startup_trials

    def make(seed: int) -> BaseSampler:
        match tuning.sampler:
            case "tpe":
                return _tpe(seed, n_startup)
            case "gp":
                return GPSampler(
                    seed=seed,
                    independent_sampler=RandomSampler(seed=seed),
                    n_startup_trials=n_startup,
                    deterministic_objective=False,
                    warn_independent_sampling=False,
                )
            case "cmaes":
                return EvolutionSampler(seed, n_startup)
            case "random" | "grid":
                return RandomSampler(seed=seed)

    return SeededSampler(make, tuning.seed)


def _tpe(seed: int, n_startup: int) -> TPESampler:
    """Options are said although they are version 5's defaults: version 5 changed them.

    Parameters are drawn together, those that exist only under a condition with the others of that
    condition (``group``), and settings under way count as bad ones (``constant_liar``), so that
    trials side by side do not try the same.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)  # of ``group``, since 2.8
        return TPESampler(
            n_startup_trials=n_startup,
            n_ei_candidates=24,
            seed=seed,
            multivariate=True,
            group=True,
            constant_liar=True,
        )
