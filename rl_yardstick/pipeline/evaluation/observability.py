"""The yardstick under partial observability: the optima of policies of observations.

There are three optima: of policies of the state, of policies of all observations so far, and of
memoryless policies, which use only the current observation. An agent's score uses that of its kind.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.mdp import TransitionModel
from rl_yardstick.mdp.beliefs import Bracket, memory_optimum
from rl_yardstick.mdp.memoryless import PROVED, BestMemoryless, best_memoryless, observation_groups
from rl_yardstick.pipeline.evaluation.yardstick import HiddenState, Yardstick

MOST_KEPT = 16


@dataclass(frozen=True, eq=False)
class HiddenScale:
    """The optima of an environment whose observations hide the state."""

    full_optimum: float
    baseline: float
    memory: Bracket  # of policies of all observations so far
    now: Bracket  # of memoryless policies
    best: BestMemoryless | None  # the best memoryless policy found; None if none was searched

    def yardstick(self, with_memory: bool) -> Yardstick:
        """The yardstick for agents with memory, or for memoryless agents."""
        lower, upper = self.memory if with_memory else self.now
        hidden = HiddenState(self.full_optimum, (self.memory.lower, self.memory.upper), with_memory)
        return Yardstick(upper, self.baseline, None if lower == upper else lower, hidden=hidden)

    @property
    def note(self) -> str | None:
        """A line on the best memoryless policy, if it is stochastic."""
        best = self.best
        if best is None or not best.needs_chance:
            return None
        found = "" if best.lower == best.upper else " found"
        firm_found = "" if best.is_firm_known else " found"
        return (
            f"the best memoryless policy{found} is stochastic and returns {best.lower:.2f}; "
            f"the best deterministic one{firm_found}, as in evaluations, returns {best.firm:.2f}"
        )


def hidden_scale(
    model: TransitionModel,
    observations: NDArray[np.generic],
    horizon: int,
    full_optimum: float,
    baseline: float,
) -> HiddenScale | None:
    """The optima under partial observability; None if a memoryless policy reaches the optimum.

    Args:
        model: the decision process.
        observations: the observation of each state, states along the first axis.
        horizon: the time limit.
        full_optimum: the optimum of policies of the state.
        baseline: the return of the best random or constant policy.
    """
    groups = observation_groups(observations, model.reachable)
    if groups is None:
        return None
    digest = hashlib.blake2b(repr((horizon, model.prob.shape)).encode())
    for array in (
        *(model.prob, model.next_state, model.reward, model.terminated, model.initial),
        groups,
    ):
        digest.update(array.tobytes())
    key = digest.digest()
    found = (
        _kept.pop(key) if key in _kept else _scale(model, groups, horizon, full_optimum, baseline)
    )
    _kept[key] = found
    if len(_kept) > MOST_KEPT:
        _kept.popitem(last=False)
    return found


_kept: OrderedDict[bytes, HiddenScale | None] = OrderedDict()


def _scale(
    model: TransitionModel,
    groups: NDArray[np.int64],
    horizon: int,
    full_optimum: float,
    baseline: float,
) -> HiddenScale | None:
    memory = memory_optimum(model, groups, horizon) or Bracket(baseline, full_optimum)
    most = min(memory.upper, full_optimum)
    best = best_memoryless(model, groups, horizon, most)
    if best is not None and best.lower >= full_optimum - PROVED * max(1.0, abs(full_optimum)):
        return None
    now = Bracket(baseline, most)
    if best is not None:
        now = Bracket(max(best.lower, baseline), max(best.upper, baseline))
    least = memory.lower if memory.lower == memory.upper else max(memory.lower, now.lower)
    return HiddenScale(full_optimum, baseline, Bracket(least, most), now, best)
