"""Monte Carlo control: learning from whole episodes, on-policy and off-policy."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy

from rl_yardstick.agents.common.exploration import greedy_action, highest_value
from rl_yardstick.agents.common.settings import whole
from rl_yardstick.agents.compiled.learning_algorithm import StepSize
from rl_yardstick.agents.compiled.loop import by_type
from rl_yardstick.agents.tabular.algorithm import QTablePolicy
from rl_yardstick.agents.tabular.n_step import EpisodicAlgorithm, place_of, probability_of
from rl_yardstick.agents.tabular.updates import (
    NOTHING_LEARNT,
    TabularAgent,
    act_on_values,
    choose,
    move_towards,
    values_at,
)
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats, Ints

# Whole episodes, stored until the agent learns from them at their end.
#
# Source: Sutton and Barto (2nd edition), chapter 5.


class EpisodeRecords(NamedTuple):
    """The current episodes."""

    states: Ints  # shape (n_envs, longest_episode)
    actions: Ints  # shape (n_envs, longest_episode)
    rewards: Floats  # shape (n_envs, longest_episode)
    probabilities: Floats  # of the actions, by the policy, shape (n_envs, longest_episode)
    lengths: Ints  # number of steps so far, shape (n_envs,)
    # Of each entry: its first visit (scratch), shape (S, A); or its weight, shape (1, S, A).
    of_entries: Any


@by_type
def learn_episode(agent: TabularAgent, env: Any, progress: Any, i: int, length: int) -> float:
    """Learn from the record of environment ``i``; returns the mean absolute error."""
    raise NotImplementedError


@inlined
def record_and_learn(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Store the step, and learn when the episode is over or fills the record."""
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
    """Learns from whole episodes, when they are over.

    The return of a truncated episode bootstraps from the value of its last state. An episode is
    treated as truncated after ``longest_episode`` steps, and its rest as another episode.

    Args:
        learning_rate: as in `TabularAlgorithm`; the textbook's is ``"sample_average"``.
        longest_episode: maximal number of stored steps of an episode, at least 1.
    """

    learn_in = record_and_learn
    _memory: EpisodeRecords
    ranges = {"longest_episode": whole(1)}  # noqa: RUF012

    def __init__(
        self,
        *args: Any,
        learning_rate: StepSize = "sample_average",
        longest_episode: int = 10_000,
        **kwargs: Any,
    ) -> None:
        self.longest_episode = longest_episode
        super().__init__(*args, learning_rate=learning_rate, **kwargs)

    def _make_memory(self) -> EpisodeRecords:
        shape = (self.n_envs, self.longest_episode)
        states, actions = (np.zeros(shape, dtype=np.int64) for _ in range(2))
        lengths = np.zeros(self.n_envs, dtype=np.int64)
        return EpisodeRecords(
            states, actions, np.zeros(shape), np.zeros(shape), lengths, np.zeros(0)
        )


class ImportanceTablePolicy(QTablePolicy):
    """Greedy in a table of action values, each the weighted mean of returns."""

    # Sum of the weights of the returns of each entry, float64 of shape (T, S, A).
    weights: th.Tensor

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.register_buffer("weights", th.zeros_like(self.q_tables))


@inlined
def value_where_cut_off(agent: TabularAgent, env: Any, progress: Any) -> float:
    """The value of the policy's next action; 0 after a termination."""
    if env.terminated:
        return 0.0
    env.next_action = choose(agent, env.next_obs, progress)
    return float(agent.tables.values[0, env.next_obs, env.next_action])


@inlined
def learn_from_visits(agent: TabularAgent, env: Any, progress: Any, i: int, length: int) -> float:
    """Move each entry towards the return after its first visit, or after every visit."""
    records = agent.memory
    later = value_where_cut_off(agent, env, progress)
    for k in range(length - 1, -1, -1):  # the first visit is written last
        records.of_entries[records.states[i, k], records.actions[i, k]] = k
    total_error, n_learnt = 0.0, 0
    for k in range(length - 1, -1, -1):
        state, action = records.states[i, k], records.actions[i, k]
        later = records.rewards[i, k] + agent.settings.gamma * later
        if agent.settings.every_visit or records.of_entries[state, action] == k:
            total_error += abs(move_towards(agent, progress, 0, state, action, later))
            n_learnt += 1
    return total_error / n_learnt


class MonteCarlo(RecordAlgorithm):
    """On-policy Monte Carlo control (Sutton and Barto, section 5.4).

    It learns the values of the exploring policy, at the end of each episode. Exploring starts are
    up to the environment: Blackjack has some.

    Args:
        every_visit: learn from every visit of an entry in an episode, not only from the first.
    """

    parameters = {"every_visit": np.bool_}  # noqa: RUF012
    learn_episode = learn_from_visits

    def __init__(self, *args: Any, every_visit: bool = False, **kwargs: Any) -> None:
        self.every_visit = every_visit
        super().__init__(*args, **kwargs)

    def _memory_in_use(self) -> EpisodeRecords:
        room = np.empty(self.policy.q_tables.shape[1:], dtype=np.int64)
        return self._memory._replace(of_entries=room)


# With larger weights their sum could become infinite.
LARGEST_WEIGHT = 1e150


@inlined
def act_and_tell(agent: TabularAgent, env: Any, progress: Any) -> None:
    """Act, and store the probability of the action."""
    act_on_values(agent, env, progress)
    room = values_at(agent, env.obs, 0)
    env.probability = probability_of(agent, room, env.action, progress)


@inlined
def learn_by_importance(agent: TabularAgent, env: Any, progress: Any, i: int, length: int) -> float:
    """Weigh returns by importance sampling ratios of the greedy to the exploring policy."""
    records, values, weight = agent.memory, agent.tables.values, 1.0
    later = 0.0 if env.terminated else highest_value(values_at(agent, env.next_obs, 0).values)
    total_error, n_learnt = 0.0, 0
    for k in range(length - 1, -1, -1):
        state, action = records.states[i, k], records.actions[i, k]
        later = records.rewards[i, k] + agent.settings.gamma * later
        records.of_entries[0, state, action] += weight
        agent.tables.visit_counts[0, state, action] += 1
        error = later - values[0, state, action]
        values[0, state, action] += weight / records.of_entries[0, state, action] * error
        total_error += abs(error)
        n_learnt += 1
        room = values_at(agent, state, 0)
        is_greedy = place_of(room, action) == greedy_action(room.values, 0.0)
        if records.probabilities[i, k] <= 0.0 or not is_greedy:
            break
        weight /= records.probabilities[i, k]
        if weight > LARGEST_WEIGHT:
            break
    return total_error / n_learnt


class OffPolicyMonteCarlo(RecordAlgorithm):
    """Off-policy Monte Carlo control by weighted importance sampling (Sutton and Barto, 5.7).

    It learns the values of the greedy policy while it explores, from the end of each episode back
    to the last action that the greedy policy would not have taken. A truncated episode bootstraps
    from the best value in its last state. A weight above 1e150 ends the learning from an episode.
    The sums of the weights are saved with the table.

    Args:
        args: as in `RecordAlgorithm`; ``learning_rate`` can only be ``"sample_average"``.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"QTablePolicy": ImportanceTablePolicy}
    policy: ImportanceTablePolicy

    act = act_and_tell
    learn_episode = learn_by_importance

    def _check_arguments(self) -> None:
        super()._check_arguments()
        self._refuse_gaussian_noise("off_policy_monte_carlo")
        if not self.averages_samples:
            raise ValueError(
                "off_policy_monte_carlo takes weighted means: learning_rate must be "
                f"'sample_average', not {self.learning_rate!r}"
            )

    def _memory_in_use(self) -> EpisodeRecords:
        return self._memory._replace(of_entries=self.policy.weights.numpy())
