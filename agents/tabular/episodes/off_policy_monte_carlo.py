"""Off-policy Monte Carlo control."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from stable_baselines3.common.policies import BasePolicy

from agents.common.exploration import greedy_action, highest_value
from agents.tabular.episodes.episode_records import RecordAlgorithm
from agents.tabular.episodes.importance_policy import ImportanceTablePolicy
from agents.tabular.episodes.learning_in_turn import place_of, probability_of
from agents.tabular.temporal_difference import TabularAgent, act_on_values, values_at
from machine_code.compiling import inlined
from mdp.array_types import Floats, Ints

# Beyond it the sum of the weights would soon be infinite.
LARGEST_WEIGHT = 1e150


class WeightedRecords(NamedTuple):
    """The fields of `EpisodeRecords`, and the weights of the policy, shape (1, S, A)."""

    states: Ints
    actions: Ints
    rewards: Floats
    probabilities: Floats
    lengths: Ints
    weights: Floats


@inlined
def act_and_tell(agent: TabularAgent, env: Any, progress: Any) -> None:
    """Act, and note how probable that was."""
    act_on_values(agent, env, progress)
    room = values_at(agent, env.obs, 0)
    env.probability = probability_of(agent, room, env.action, progress)


@inlined
def is_first_best(agent: TabularAgent, state: int, action: int) -> bool:
    """Whether the action is what `predict` would do."""
    room = values_at(agent, state, 0)
    return bool(place_of(agent, room, action) == greedy_action(room.values, 0.0))


@inlined
def learn_by_importance(agent: TabularAgent, env: Any, progress: Any, i: int, length: int) -> float:
    """Weigh returns by how much more probable they are under the greedy policy."""
    records, values, weight = agent.memory, agent.tables.values, 1.0
    later = 0.0 if env.terminated else highest_value(values_at(agent, env.next_obs, 0).values)
    total_error, n_learnt = 0.0, 0
    for k in range(length - 1, -1, -1):
        state, action = records.states[i, k], records.actions[i, k]
        later = records.rewards[i, k] + agent.settings.gamma * later
        records.weights[0, state, action] += weight
        agent.tables.visit_counts[0, state, action] += 1
        error = later - values[0, state, action]
        values[0, state, action] += weight / records.weights[0, state, action] * error
        total_error += abs(error)
        n_learnt += 1
        if records.probabilities[i, k] <= 0.0 or not is_first_best(agent, state, action):
            break
        weight /= records.probabilities[i, k]
        if weight > LARGEST_WEIGHT:
            break
    return total_error / n_learnt


class OffPolicyMonteCarlo(RecordAlgorithm):
    """Off-policy Monte Carlo control by weighted importance sampling (Sutton and Barto, 5.7).

    It learns what the greedy policy is worth while it explores, from the end of each episode back
    to the last action that the greedy policy would not have taken. Where an episode is truncated,
    the best value in its last state counts. A weight of more than 1e150 ends the learning from an
    episode. The sums of the weights are saved with the table.

    Args:
        args: as in `RecordAlgorithm`; ``learning_rate`` can only be ``"sample_average"``.
        kwargs: as in `RecordAlgorithm`.
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

    def _check_tables(self) -> None:
        super()._check_tables()
        if self.policy.weights.shape != self.policy.q_tables.shape:
            shape = tuple(self.policy.q_tables.shape)
            raise ValueError(
                f"weights must be of shape {shape}, not {tuple(self.policy.weights.shape)}"
            )

    def _memory_in_use(self) -> WeightedRecords:
        return WeightedRecords._make((*self._memory, self.policy.weights.numpy()))
