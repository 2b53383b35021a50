"""Semi-gradient control on active tiles: Q-learning and SARSA."""

from __future__ import annotations

from typing import Any

import numpy as np

from rl_yardstick.agents.common.exploration import (
    EPSILON_GREEDY,
    action_probabilities,
    greedy_action,
)
from rl_yardstick.agents.common.settings import EPSILONS, FINITE, ExplorationDecay
from rl_yardstick.agents.compiled.env_states import AFTER, BEFORE
from rl_yardstick.agents.compiled.references import next_uniform
from rl_yardstick.agents.linear.algorithm import (
    LinearAgent,
    TileAlgorithm,
    add_up,
    choose,
    look,
    sum_of,
)
from rl_yardstick.agents.tabular.q_learning_and_sarsa import best_next_value
from rl_yardstick.agents.tabular.updates import learning_in_turn, next_value
from rl_yardstick.machine_code.compiling import called
from rl_yardstick.mdp.transition_model import Floats

# Semi-gradient control: action values are sums of weights, moved towards bootstrapped targets.
#
# It is the temporal-difference learning of `agents.tabular`, with sums instead of table entries. If
# each observation is a tile of its own, both are the same bit for bit. After termination the
# discount is 0; a truncated episode still bootstraps. As there, an algorithm defines `next_value`,
# which gets the values of the next actions in ``agent.room.values``, and perhaps `commit`.
#
# Source: Sutton and Barto (2nd edition), section 10.1 (SARSA) and chapter 11 (Q-learning).


@called
def choose_epsilon_greedily(agent: LinearAgent, progress: Any) -> int:
    """A uniformly random action with probability epsilon, else a best one."""
    values, explore, place = agent.room.values, next_uniform(agent.rng), next_uniform(agent.rng)
    if explore < progress.exploration:
        return int(place * len(values))
    return greedy_action(values, place * agent.settings.tie_scale)


@called
def semi_gradient_step(agent: LinearAgent, env: Any, progress: Any, i: int) -> float:
    """Learn from an environment's last step, and return the absolute TD error."""
    room, weights = agent.room, agent.weights
    look(agent, env, AFTER, room.next_tiles)
    add_up(agent, room.next_tiles)
    discount = 0.0 if env.terminated else agent.settings.gamma
    target = env.reward + discount * next_value(agent, env, progress, 0)
    look(agent, env, BEFORE, room.tiles)
    td_error = target - sum_of(weights, room.tiles, env.action)
    step = progress.learning_rate / len(room.tiles) * td_error
    for k in range(len(room.tiles)):
        weights[room.tiles[k], env.action] += step
    return float(abs(td_error))


class SemiGradientAlgorithm(TileAlgorithm):
    """Epsilon-greedy control on action values that are sums of weights over active tiles.

    Args:
        learning_rate: as in `TileAlgorithm`.
        exploration_fraction: share of training over which epsilon falls.
        exploration_initial_eps: epsilon at the start.
        exploration_final_eps: epsilon at the end of that share.
        exploration_decay: how epsilon falls; ``"constant"`` stays at the initial value.
        tie_breaking: as in `LearningAlgorithm`.
        initial_q: every action's value at the start; high values are optimistic.
    """

    # Called by the training loops; each algorithm defines `next_value`.
    choose_by_sums = choose_epsilon_greedily
    learn_from_step = learning_in_turn
    learn_in = semi_gradient_step
    ranges = {"initial_q": FINITE, **EPSILONS}  # noqa: RUF012

    def __init__(
        self,
        *args: Any,
        exploration_fraction: float = 0.5,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        exploration_decay: ExplorationDecay = "linear",
        initial_q: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.exploration_fraction = exploration_fraction
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_decay = exploration_decay
        self.initial_q = initial_q
        super().__init__(*args, **kwargs)

    def _initial_sums(self) -> Floats:
        return np.full(self.n_actions, float(self.initial_q))

    def _probabilities(self, sums: Floats) -> Floats:
        ties = self.tie_breaking == "random"
        return action_probabilities(EPSILON_GREEDY, sums, self.exploration_rate, random_ties=ties)

    def _record_training(self) -> None:
        super()._record_training()
        self.logger.record("rollout/exploration_rate", self.exploration_rate)


class SemiGradientQ(SemiGradientAlgorithm):
    """Semi-gradient Q-learning (Sutton and Barto, chapter 11).

    It may diverge, because it combines off-policy learning, bootstrapping and function
    approximation (the deadly triad), as in Baird's counterexample (section 11.2).
    """

    next_value = best_next_value


@called
def commit_to_next_action(agent: LinearAgent, env: Any, progress: Any) -> None:
    """Choose the next action, unless the episode has terminated."""
    env.next_action = 0
    if not env.terminated:
        look(agent, env, AFTER, agent.room.next_tiles)
        env.next_action = choose(agent, agent.room.next_tiles, progress)


@called
def committed_value(agent: LinearAgent, env: Any, progress: Any, table: int) -> float:
    """The value of the next action that the agent has committed to."""
    return float(agent.room.values[env.next_action])


class SemiGradientSARSA(SemiGradientAlgorithm):
    """Episodic semi-gradient SARSA (Sutton and Barto, section 10.1).

    It commits to its next action before the update that uses it. If an episode is truncated, it
    chooses an action in the last state for the target only.
    """

    commit = commit_to_next_action
    next_value = committed_value
