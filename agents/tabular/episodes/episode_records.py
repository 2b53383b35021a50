"""Whole episodes, kept until they end and learnt from then.

Source: Sutton and Barto (2nd edition), chapter 5.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.common.setting_checks import check_whole, settings_of
from agents.compiled.dispatch import CompiledOnlyError, by_type
from agents.compiled.learning_algorithm import StepSize
from agents.tabular.episodes.learning_in_turn import MOST_STEPS, NOTHING_LEARNT, EpisodicAlgorithm
from agents.tabular.temporal_difference import TabularAgent
from machine_code.compiling import inlined
from mdp.array_types import Floats, Ints


class EpisodeRecords(NamedTuple):
    """The episodes under way.

    Attributes:
        states: shape (n_envs, longest_episode).
        actions: what was done there, shape (n_envs, longest_episode).
        rewards: what that earned, shape (n_envs, longest_episode).
        probabilities: how probable the policy thought it, shape (n_envs, longest_episode).
        lengths: number of steps so far, shape (n_envs,).
    """

    states: Ints
    actions: Ints
    rewards: Floats
    probabilities: Floats
    lengths: Ints


@by_type
def learn_episode(agent: TabularAgent, env: Any, progress: Any, i: int, length: int) -> float:
    """Learn from the record of environment ``i``; returns the mean absolute error."""
    raise CompiledOnlyError


@inlined
def record_and_learn(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Write down the step, and learn once the episode is over or fills the record."""
    records = agent.memory
    place = records.lengths[i]
    records.states[i, place] = env.obs
    records.actions[i, place] = env.action
    records.rewards[i, place] = env.reward
    records.probabilities[i, place] = env.probability
    records.lengths[i] = place + 1
    if not env.done and place + 1 < records.states.shape[1]:
        return NOTHING_LEARNT
    records.lengths[i] = 0
    return float(learn_episode(agent, env, progress, i, place + 1))


class RecordAlgorithm(EpisodicAlgorithm):
    """Learns from whole episodes, once they are over.

    Where an episode is truncated, the rest of its return is not known: the value of the state that
    it was cut off in stands for it. An episode of more than ``longest_episode`` steps counts as
    truncated there, and what follows as another.

    Args:
        policy: as in `TabularAlgorithm`.
        env: as in `TabularAlgorithm`.
        learning_rate: as in `TabularAlgorithm`; the textbook averages.
        longest_episode: steps of an episode that are remembered, at least 1.
        kwargs: as in `TabularAlgorithm`.
    """

    learn_in = record_and_learn

    def __init__(
        self,
        policy: str | type[BasePolicy] = "QTablePolicy",
        env: GymEnv | str | None = None,
        learning_rate: StepSize = "sample_average",
        longest_episode: int = 10_000,
        **kwargs: Any,
    ) -> None:
        self.longest_episode = longest_episode
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_whole(1, settings_of(self, "longest_episode"), MOST_STEPS // self.n_envs)

    def _make_memory(self) -> EpisodeRecords:
        shape = (self.n_envs, self.longest_episode)
        states, actions = (np.zeros(shape, dtype=np.int64) for _ in range(2))
        lengths = np.zeros(self.n_envs, dtype=np.int64)
        return EpisodeRecords(states, actions, np.zeros(shape), np.zeros(shape), lengths)
