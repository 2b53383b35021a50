"""Watkins's Q(lambda)."""

from __future__ import annotations

from typing import Any

from agents.common.exploration import highest_value
from agents.tabular.episodes.eligibility_traces import TraceAlgorithm
from agents.tabular.q_learning import best_next_value
from agents.tabular.temporal_difference import TabularAgent, values_at
from machine_code.compiling import inlined


@inlined
def note_greediness(agent: TabularAgent, env: Any, progress: Any) -> None:
    """The greedy policy's probability of the action, while the tables are those it was chosen by.

    All best actions are one to it.
    """
    best = highest_value(values_at(agent, env.obs, 0).values)
    env.probability = 1.0 if agent.tables.values[0, env.obs, env.action] == best else 0.0


@inlined
def cut_where_exploring(agent: TabularAgent, env: Any) -> float:
    """What the greedy policy would not have done says nothing of what led to it."""
    return float(env.probability)


class QLambda(TraceAlgorithm):
    """Watkins's Q(lambda) (Watkins, 1989; Sutton and Barto, section 12.10).

    Traces are cut where an action is taken that is none of the best; with ``trace_decay`` 0 it is
    Q-learning.
    """

    commit = note_greediness
    next_value = best_next_value
    trace_kept = cut_where_exploring
