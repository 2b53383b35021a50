"""Dyna-Q+."""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np

from agents.common.setting_checks import check_at_least, check_finite, settings_of
from agents.tabular.models.dyna_q import DynaQ
from agents.tabular.models.learnt_models import add_pair, note_outcome
from agents.tabular.models.model_policy import ModelPolicy
from agents.tabular.temporal_difference import TabularAgent
from agents.tabular.value_tables import action_at, room_at
from machine_code.compiling import inlined
from mdp.array_types import Bools, Floats, Ints


class DatedModel(NamedTuple):
    """A model that knows how old its outcomes are.

    Attributes:
        next_obs: this and the next ones as in `LearntModel`.
        rewards: see there.
        terminated: see there.
        counts: see there.
        pairs: see there.
        n_pairs: see there.
        tried_at: the time when a pair was tried last, 0 for never, shape (S, A).
        time: steps of all environments so far, shape (1,).
    """

    next_obs: Ints
    rewards: Floats
    terminated: Bools
    counts: Ints
    pairs: Ints
    n_pairs: Ints
    tried_at: Ints
    time: Ints


@inlined
def remember_outcome_and_time(agent: TabularAgent, env: Any) -> None:
    """Keep the outcome and its time; planning draws from all actions of the states met."""
    model = agent.memory
    seen = 0
    for action in range(model.counts.shape[1]):
        seen += model.counts[env.obs, action]
    if seen == 0:
        room = room_at(agent.tables, env.obs, agent.room)
        for k in range(len(room.values)):
            add_pair(model, env.obs, action_at(agent.tables, room, k))
    note_outcome(model, env)
    model.time[0] += 1
    model.tried_at[env.obs, env.action] = model.time[0]


@inlined
def reward_for_trying(agent: TabularAgent, obs: int, action: int, reward: float) -> float:
    """The reward, and a bonus for what was not tried for long."""
    idle = agent.memory.time[0] - agent.memory.tried_at[obs, action]
    return float(reward + agent.settings.kappa * math.sqrt(idle))


class DatedModelPolicy(ModelPolicy):
    """The policy of Dyna-Q+."""

    model_type: ClassVar[Any] = DatedModel

    def _nothing_learnt(self, n_states: int, n_actions: int, n: int) -> dict[str, Any]:
        times = {
            "tried_at": np.zeros((n_states, n_actions), dtype=np.int64),
            "time": np.zeros(1, dtype=np.int64),
        }
        return {**super()._nothing_learnt(n_states, n_actions, n), **times}


class DynaQPlus(DynaQ):
    """Dyna-Q that is curious about what may have changed (Sutton and Barto, section 8.3).

    In planning, a pair that was not tried for t steps earns ``kappa`` * sqrt(t) more. Planning
    considers all actions of the states met, and takes those never tried to lead back to where they
    were taken and to earn nothing (the book's footnote). The values hold the bonus, so that they
    overestimate, and a greedy policy may stray: the less, the smaller ``kappa``.

    Time is counted in steps of all environments together.

    Args:
        args: as in `DynaQ`.
        kappa: weight of the bonus.
        kwargs: as in `DynaQ`.
    """

    policy_aliases = {"QTablePolicy": DatedModelPolicy}  # noqa: RUF012
    parameters = {"kappa": np.float64}  # noqa: RUF012
    remember = remember_outcome_and_time
    imagined_reward = reward_for_trying

    def __init__(self, *args: Any, kappa: float = 0.001, **kwargs: Any) -> None:
        self.kappa = kappa
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_at_least(0.0, settings_of(self, "kappa"))
        check_finite(settings_of(self, "kappa"))
