"""On-policy Monte Carlo control."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.tabular.episodes.episode_records import RecordAlgorithm
from agents.tabular.temporal_difference import TabularAgent, choose, move_towards
from machine_code.compiling import inlined
from mdp.array_types import Floats, Ints


class VisitRecords(NamedTuple):
    """The fields of `EpisodeRecords`, and room for a number for each entry, shape (S, A)."""

    states: Ints
    actions: Ints
    rewards: Floats
    probabilities: Floats
    lengths: Ints
    first_visits: Ints


@inlined
def value_where_cut_off(agent: TabularAgent, env: Any, progress: Any) -> float:
    """The value of what the policy would do next; 0 where nothing follows."""
    if env.terminated:
        return 0.0
    env.next_action = choose(agent, env.next_obs, progress)
    return float(agent.tables.values[0, env.next_obs, env.next_action])


@inlined
def note_first_visits(agent: TabularAgent, i: int, length: int) -> None:
    """At which step of the episode each of its entries was visited first."""
    records = agent.memory
    for k in range(length - 1, -1, -1):
        records.first_visits[records.states[i, k], records.actions[i, k]] = k


@inlined
def learn_from_visits(agent: TabularAgent, env: Any, progress: Any, i: int, length: int) -> float:
    """Move each entry towards the return after its first visit, or after every one."""
    records = agent.memory
    later = value_where_cut_off(agent, env, progress)
    note_first_visits(agent, i, length)
    total_error, n_learnt = 0.0, 0
    for k in range(length - 1, -1, -1):
        state, action = records.states[i, k], records.actions[i, k]
        later = records.rewards[i, k] + agent.settings.gamma * later
        if agent.settings.every_visit or records.first_visits[state, action] == k:
            total_error += abs(move_towards(agent, progress, 0, state, action, later))
            n_learnt += 1
    return total_error / n_learnt


class MonteCarlo(RecordAlgorithm):
    """On-policy Monte Carlo control (Sutton and Barto, section 5.4).

    It learns what the exploring policy is worth, at the end of each episode, and explores as its
    settings say. Exploring starts are the environment's affair: Blackjack has some.

    Args:
        args: as in `RecordAlgorithm`.
        every_visit: learn from every visit of an entry in an episode, not the first alone.
        kwargs: as in `RecordAlgorithm`.
    """

    parameters = {"every_visit": np.bool_}  # noqa: RUF012
    learn_episode = learn_from_visits

    def __init__(self, *args: Any, every_visit: bool = False, **kwargs: Any) -> None:
        self.every_visit = every_visit
        super().__init__(*args, **kwargs)

    def _memory_in_use(self) -> VisitRecords:
        room = np.empty(self.policy.q_tables.shape[1:], dtype=np.int64)
        return VisitRecords._make((*self._memory, room))
