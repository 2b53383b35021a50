"""n-step tree backup."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from agents.common.exploration import expected_value, highest_value
from agents.common.setting_checks import check_option
from agents.tabular.episodes.learning_in_turn import place_of, probability_of
from agents.tabular.episodes.step_windows import WindowAlgorithm
from agents.tabular.temporal_difference import TabularAgent, exploration_rate, values_at
from agents.tabular.value_tables import Room
from machine_code.compiling import inlined

TargetPolicy = Literal["exploring", "greedy"]


@inlined
def target_mean(agent: TabularAgent, room: Room, progress: Any) -> float:
    """The mean of the values in the room under the target policy."""
    if agent.settings.targets_greedy:
        return highest_value(room.values)
    rate = exploration_rate(agent, progress)
    return float(expected_value(agent.settings.strategy, room.values, rate))


@inlined
def target_probability(agent: TabularAgent, room: Room, action: int, progress: Any) -> float:
    """How probable the action is under the target policy, to which all best actions are one."""
    if not agent.settings.targets_greedy:
        return probability_of(agent, room, action, progress)
    place = place_of(agent, room, action)
    return 1.0 if place >= 0 and room.values[place] == highest_value(room.values) else 0.0


@inlined
def target_value_ahead(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The mean next value under the target policy."""
    return target_mean(agent, agent.room, progress)


@inlined
def tree_backed_up(
    agent: TabularAgent, progress: Any, obs: int, action: int, later: float
) -> float:
    """The mean value, in which the action that was taken counts by what came after it."""
    room = values_at(agent, obs, 0)
    probability = target_probability(agent, room, action, progress)
    surprise = later - agent.tables.values[0, obs, action]
    return float(target_mean(agent, room, progress) + probability * surprise)


class NStepTreeBackup(WindowAlgorithm):
    """n-step tree backup (Precup et al., 2000; Sutton and Barto, section 7.5).

    Of each state within the window it takes the mean value under the target policy, in which only
    the action that was taken counts by what came after it. It learns about the target policy
    whatever is done, without importance sampling. With one step it is Expected SARSA, or, towards
    the greedy policy, Q-learning.

    Args:
        args: as in `WindowAlgorithm`.
        target_policy: what is learnt about: the ``"exploring"`` policy, by the present epsilon or
            temperature, or the ``"greedy"`` one.
        kwargs: as in `WindowAlgorithm`.
    """

    parameters = {"targets_greedy": np.bool_}  # noqa: RUF012
    next_value = target_value_ahead
    backed_up = tree_backed_up

    def __init__(
        self, *args: Any, target_policy: TargetPolicy = "exploring", **kwargs: Any
    ) -> None:
        self.target_policy = target_policy
        super().__init__(*args, **kwargs)

    @property
    def targets_greedy(self) -> bool:
        """Whether the greedy policy is learnt about."""
        return self.target_policy == "greedy"

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_option("target_policy", self.target_policy, TargetPolicy)
        if not self.targets_greedy:
            self._refuse_gaussian_noise("target_policy: exploring")
