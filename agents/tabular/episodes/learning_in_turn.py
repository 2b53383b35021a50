"""Learning from the environments one after the other, with a memory of each of their episodes."""

from __future__ import annotations

from typing import Any

from agents.common.exploration import action_probability
from agents.compiled.dispatch import CompiledOnlyError, by_type
from agents.compiled.training_records import UNDECIDED
from agents.tabular.tabular_algorithm import TabularAlgorithm
from agents.tabular.temporal_difference import TabularAgent, commit, exploration_rate
from agents.tabular.value_tables import Room, action_at
from machine_code.compiling import inlined

NOTHING_LEARNT = -1.0

# Steps that are remembered of all environments together: some 32 bytes each, in a state too.
MOST_STEPS = 50_000_000


@by_type
def learn_in(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Learn from the step of environment ``i``.

    Returns:
        The mean absolute error of the entries that were updated, or `NOTHING_LEARNT`.
    """
    raise CompiledOnlyError


@inlined
def learning_in_turn(agent: TabularAgent, envs: Any, progress: Any) -> None:
    """All commitments, then the environments in order."""
    for i in range(len(envs)):
        commit(agent, envs[i], progress)
    total_error, n_learnt = 0.0, 0
    for i in range(len(envs)):
        env = envs[i]
        error = learn_in(agent, env, progress, i)
        if error >= 0.0:
            total_error += error
            n_learnt += 1
        env.obs = env.new_obs
        if env.done:
            env.next_action = UNDECIDED
    if n_learnt > 0:
        progress.mean_td_error = total_error / n_learnt


@inlined
def place_of(agent: TabularAgent, room: Room, action: int) -> int:
    """Where in the room the value of an action is; -1 where it is not allowed."""
    for k in range(len(room.values)):
        if action_at(agent.tables, room, k) == action:
            return k
    return -1


@inlined
def probability_of(agent: TabularAgent, room: Room, action: int, progress: Any) -> float:
    """How probable the action is under the exploring policy, by the values in the room."""
    place = place_of(agent, room, action)
    if place < 0:
        return 0.0
    settings, rate = agent.settings, exploration_rate(agent, progress)
    return float(
        action_probability(settings.strategy, room.values, rate, settings.tie_scale, place)
    )


class EpisodicAlgorithm(TabularAlgorithm):
    """A tabular agent that remembers more of an episode than its last step; see the base class.

    Several environments share the table and have each a memory of its own. ``skip_terminal_update``
    is refused: here a reward is learnt from at many steps.

    Raises:
        ValueError: as the base class has it, and if ``skip_terminal_update`` is asked for.
    """

    learn_from_step = learning_in_turn

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.skip_terminal_update:
            raise ValueError(
                f"{type(self).__name__} learns from the last reward at many steps: "
                "skip_terminal_update is for the agents that learn from single steps"
            )

    def _refuse_gaussian_noise(self, role: str) -> None:
        """Refuse an exploration without probabilities, where they are needed for something.

        Raises:
            ValueError: saying what for.
        """
        if self.exploration == "gaussian_noise":
            raise ValueError(
                f"{role} needs the probabilities of the actions, which gaussian_noise does not "
                "give: take epsilon_greedy or boltzmann"
            )
