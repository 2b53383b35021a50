"""CMA-ES whose state is worked out from the trials that are there.

Optuna's own sampler keeps its state in the storage as a pickle, and unpickles what it finds there:
whoever can write the storage could have code run. The state follows from the trials alone, so here
nothing is kept but which generation a trial belongs to.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution
from optuna.samplers import BaseSampler, RandomSampler
from optuna.search_space import IntersectionSearchSpace
from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState

from mdp.array_types import Floats

GENERATION = "yardstick:generation"
# Of the unit cube that parameters are mapped to.
FIRST_SPREAD = 1 / 6

Number = FloatDistribution | IntDistribution

_JUDGED = (TrialState.COMPLETE, TrialState.PRUNED)


class EvolutionSampler(BaseSampler):
    """CMA-ES over the numbers that all trials have; what else there is, is drawn at random.

    Args:
        seed: of this trial's draws.
        n_startup_trials: how many have to be judged before it begins. One that was ended early
            counts as what its seeds came to.

    Source: Hansen (2016), "The CMA evolution strategy: a tutorial".
    """

    def __init__(self, seed: int, n_startup_trials: int) -> None:
        self._seed = seed
        self._n_startup = n_startup_trials
        self._random = RandomSampler(seed=seed)

    def infer_relative_search_space(
        self, study: Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        space = IntersectionSearchSpace().calculate(study)
        return {
            name: kind
            for name, kind in space.items()
            if isinstance(kind, Number) and not kind.single()
        }

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        judged = [
            trial
            for trial in study.get_trials(deepcopy=False, states=_JUDGED)
            if trial.value is not None
        ]
        if len(search_space) < 2 or len(judged) < self._n_startup:
            return {}
        space = {name: kind for name, kind in search_space.items() if isinstance(kind, Number)}
        from cmaes import CMA

        strategy = CMA(
            mean=np.full(len(space), 0.5),
            sigma=FIRST_SPREAD,
            bounds=np.tile([0.0, 1.0], (len(space), 1)),
        )
        sign = 1.0 if study.direction == StudyDirection.MINIMIZE else -1.0
        kind = _kind(space)
        size = strategy.population_size
        while len(done := _of_generation(judged, kind, strategy.generation)) >= size:
            strategy.tell([(_to_cube(t.params, space), sign * _value(t)) for t in done[:size]])
        strategy.reseed_rng(self._seed)
        study._storage.set_trial_system_attr(
            trial._trial_id, GENERATION, f"{kind}:{strategy.generation}"
        )
        return _from_cube(strategy.ask(), space)

    def sample_independent(
        self,
        study: Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        return self._random.sample_independent(study, trial, param_name, param_distribution)


def _value(trial: FrozenTrial) -> float:
    assert trial.value is not None
    return trial.value


def _kind(space: Mapping[str, Number]) -> str:
    """Names what is searched: where it changes, as when a parameter drops out, all begins anew."""
    return ",".join(sorted(space))


def _of_generation(trials: Sequence[FrozenTrial], kind: str, generation: int) -> list[FrozenTrial]:
    wanted = f"{kind}:{generation}"
    return [trial for trial in trials if trial.system_attrs.get(GENERATION) == wanted]


def _to_cube(params: Mapping[str, Any], space: Mapping[str, Number]) -> Floats:
    return np.array([_share(params[name], space[name]) for name in sorted(space)])


def _ends(kind: Number) -> tuple[float, float]:
    """The ends between which a parameter is drawn; of whole numbers half a step further."""
    room = 0.5 * kind.step if isinstance(kind, IntDistribution) else 0.0
    low, high = kind.low - room, kind.high + room
    return (math.log(low), math.log(high)) if kind.log else (low, high)


def _share(value: float, kind: Number) -> float:
    low, high = _ends(kind)
    return ((math.log(value) if kind.log else value) - low) / (high - low)


def _from_cube(point: Floats, space: Mapping[str, Number]) -> dict[str, Any]:
    return {
        name: _drawn(float(share), space[name])
        for name, share in zip(sorted(space), point, strict=True)
    }


def _drawn(share: float, kind: Number) -> float | int:
    low, high = _ends(kind)
    value = low + share * (high - low)
    value = math.exp(value) if kind.log else value
    if kind.step is not None:
        value = kind.low + round((value - kind.low) / kind.step) * kind.step
    value = min(max(value, kind.low), kind.high)
    return int(value) if isinstance(kind, IntDistribution) else value
