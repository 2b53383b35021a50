"""Policy gradients on active tiles: REINFORCE and actor-critic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from rl_yardstick.agents.common.algorithm import Transitions
from rl_yardstick.agents.common.exploration import (
    BOLTZMANN,
    action_probabilities,
    drawn_action,
    make_probabilities,
)
from rl_yardstick.agents.common.settings import FINITE, NOT_NEGATIVE
from rl_yardstick.agents.compiled.env_states import AFTER, BEFORE
from rl_yardstick.agents.compiled.loop import move_on
from rl_yardstick.agents.compiled.references import next_uniform
from rl_yardstick.agents.compiled.worlds import NotCompilable
from rl_yardstick.agents.linear.algorithm import LinearAgent, TileAlgorithm, add_up, look
from rl_yardstick.agents.tabular.updates import learning_in_turn
from rl_yardstick.envs.known_models import time_limit
from rl_yardstick.machine_code.compiling import called
from rl_yardstick.mdp.transition_model import Floats, Ints

# Softmax policies on preferences, and steps along their gradient.
#
# With binary features, the gradient of ln pi(a) by the weights of action b at an active tile is
# 1 - pi(b) for b = a, and -pi(b) else.
#
# Source: Sutton and Barto (2nd edition), sections 13.1 and 13.3.


@called
def draw_by_preference(agent: LinearAgent, progress: Any) -> int:
    """An action with probability proportional to exp(preference)."""
    uniform = next_uniform(agent.rng)
    make_probabilities(agent.room.values)
    return drawn_action(agent.room.values, uniform)


@called
def ascend(agent: LinearAgent, tiles: Ints, action: int, step: float) -> None:
    """Move the preferences at these tiles by a step along the gradient of ln pi(action)."""
    probabilities = agent.room.values
    add_up(agent, tiles)
    make_probabilities(probabilities)
    for other in range(len(probabilities)):
        chosen = 1.0 if other == action else 0.0
        move = step * (chosen - probabilities[other])
        for k in range(len(tiles)):
            agent.weights[tiles[k], other] += move


@called
def state_value(weights: Floats, tiles: Ints) -> float:
    """The sum of a state value's weights over the tiles."""
    total = 0.0
    for k in range(len(tiles)):
        total += weights[tiles[k]]
    return total


class SoftmaxAlgorithm(TileAlgorithm):
    """A policy gradient on preferences that are sums of weights over active tiles.

    Args:
        learning_rate: step size of the policy, as in `TileAlgorithm`.
        initial_preferences: each action's preference at the start, a number or a list of A.
        gamma_power: multiply the policy's update at step t of an episode by gamma to the power t,
            as in the book's pseudocode; many programs leave this out.
    """

    parameters = {"gamma_power": np.bool_}  # noqa: RUF012
    choose_by_sums = draw_by_preference
    _memory: Any

    hidden_arguments = ("tie_breaking",)

    def __init__(
        self,
        *args: Any,
        initial_preferences: float | Sequence[float] = 0.0,
        gamma_power: bool = True,
        **kwargs: Any,
    ) -> None:
        self.initial_preferences = initial_preferences
        self.gamma_power = gamma_power
        super().__init__(*args, **kwargs)

    def _initial_sums(self) -> Floats:
        given = np.asarray(self.initial_preferences, dtype=np.float64)
        if given.shape not in ((), (self.n_actions,)):
            raise ValueError(
                f"initial_preferences must be a number or {self.n_actions} numbers, "
                f"not {self.initial_preferences}"
            )
        for number in given.flat:
            FINITE.check("initial_preferences", float(number))
        return np.broadcast_to(given, self.n_actions)

    def _memory_in_use(self) -> Any:
        return self._memory._replace(values=self.policy.state_weights.numpy())

    def _probabilities(self, sums: Floats) -> Floats:
        return action_probabilities(BOLTZMANN, sums, 1.0, random_ties=False)


class Critic(NamedTuple):
    """The state of the agent besides its preferences."""

    values: Floats  # weights of the state values, shape (tiles,)
    # Gamma to the power of the steps so far in the episodes of n environments, shape (n,).
    discounts: Floats


@called
def actor_critic_step(agent: LinearAgent, env: Any, progress: Any, i: int) -> float:
    """Learn from an environment's last step, and return the absolute TD error."""
    room, values, discounts = agent.room, agent.memory.values, agent.memory.discounts
    discount = discounts[i] if agent.settings.gamma_power else 1.0
    look(agent, env, AFTER, room.next_tiles)
    look(agent, env, BEFORE, room.tiles)
    follows = 0.0 if env.terminated else agent.settings.gamma * state_value(values, room.next_tiles)
    td_error = env.reward + follows - state_value(values, room.tiles)
    n_tilings = len(room.tiles)
    value_step = agent.settings.value_step_size / n_tilings * td_error
    for k in range(n_tilings):
        values[room.tiles[k]] += value_step
    step = progress.learning_rate / n_tilings * discount * td_error
    ascend(agent, room.tiles, env.action, step)
    discounts[i] = 1.0 if env.done else discounts[i] * agent.settings.gamma
    return float(abs(td_error))


class ActorCritic(SoftmaxAlgorithm):
    """One-step actor-critic, episodic (Sutton and Barto, section 13.5).

    The TD error of a learnt state value moves that value, and the policy's preferences. If an
    episode is truncated, the target bootstraps from its last state.

    Args:
        learning_rate: step size of the policy, constant or scheduled, as in `TileAlgorithm`.
        value_step_size: step size of the state values, also divided by the number of tilings.
    """

    parameters = {"value_step_size": np.float64}  # noqa: RUF012
    ranges = {"value_step_size": NOT_NEGATIVE}  # noqa: RUF012
    learn_from_step = learning_in_turn
    learn_in = actor_critic_step
    values_states = True
    _memory: Critic

    def __init__(self, *args: Any, value_step_size: float = 0.2, **kwargs: Any) -> None:
        self.value_step_size = value_step_size
        super().__init__(*args, **kwargs)

    def _make_memory(self) -> Critic:
        return Critic(self.policy.state_weights.numpy(), np.ones(self.n_envs))


Baseline = Literal["none", "value"]

FIRST_CAPACITY = 64


class KeptEpisodes(NamedTuple):
    """The state of the agent besides its preferences: current episodes of n environments."""

    values: Floats  # weights of the state values, shape (tiles,); of shape (0,) without a baseline
    lengths: Ints  # numbers of stored steps, shape (n,)
    tiles: Ints  # active tiles of the observations, shape (n, capacity, n_tilings)
    actions: Ints  # shape (n, capacity)
    rewards: Floats  # shape (n, capacity); replaced by the returns when the episode is over


@called
def keep_step(agent: LinearAgent, env: Any, i: int) -> None:
    """Store the last step of environment ``i``."""
    kept, room = agent.memory, agent.room
    t = kept.lengths[i]
    look(agent, env, BEFORE, room.tiles)
    for k in range(len(room.tiles)):
        kept.tiles[i, t, k] = room.tiles[k]
    kept.actions[i, t] = env.action
    kept.rewards[i, t] = env.reward
    kept.lengths[i] = t + 1


@called
def reinforce_step(agent: LinearAgent, i: int, t: int, step: float) -> float:
    """Learn from step ``t`` of a finished episode; return its return less the baseline."""
    kept, room, settings = agent.memory, agent.room, agent.settings
    for k in range(len(room.tiles)):
        room.tiles[k] = kept.tiles[i, t, k]
    advantage = kept.rewards[i, t]
    if len(kept.values) > 0:
        advantage -= state_value(kept.values, room.tiles)
        value_step = settings.value_step_size / len(room.tiles) * advantage
        for k in range(len(room.tiles)):
            kept.values[room.tiles[k]] += value_step
    ascend(agent, room.tiles, kept.actions[i, t], step * advantage)
    return float(advantage)


@called
def learn_from_episode(agent: LinearAgent, env: Any, progress: Any, i: int) -> None:
    """Learn from the episode that has ended in environment ``i``, from its first step on."""
    kept, room, settings = agent.memory, agent.room, agent.settings
    n_steps, following, total = kept.lengths[i], 0.0, 0.0
    if len(kept.values) > 0 and not env.terminated:
        look(agent, env, AFTER, room.next_tiles)
        following = state_value(kept.values, room.next_tiles)
    for t in range(n_steps - 1, -1, -1):
        following = kept.rewards[i, t] + settings.gamma * following
        kept.rewards[i, t] = following
    step = progress.learning_rate / len(room.tiles)
    for t in range(n_steps):
        total += abs(reinforce_step(agent, i, t, step))
        if settings.gamma_power:
            step *= settings.gamma
    kept.lengths[i] = 0
    progress.mean_td_error = total / n_steps


@called
def learn_at_ends(agent: LinearAgent, envs: Any, progress: Any) -> None:
    """Store all steps, and learn from the episodes that have ended."""
    for i in range(len(envs)):
        env = envs[i]
        keep_step(agent, env, i)
        if env.done:
            learn_from_episode(agent, env, progress, i)
        move_on(agent.seen, env)


class Reinforce(SoftmaxAlgorithm):
    """REINFORCE, Monte Carlo policy gradient (Williams, 1992; Sutton and Barto, 13.3 and 13.4).

    It learns at the end of an episode, step by step from the first one on. The return of a
    truncated episode ends at the truncation; with the baseline ``"value"`` it bootstraps from the
    last state.

    Args:
        learning_rate: step size of the policy, constant or scheduled, as in `TileAlgorithm`.
        baseline: subtracted from returns: ``"none"``, or ``"value"``, a learnt state value.
        value_step_size: step size of that value, also divided by the number of tilings.
    """

    parameters = {"value_step_size": np.float64}  # noqa: RUF012
    ranges = {"value_step_size": NOT_NEGATIVE}  # noqa: RUF012
    learn_from_step = learn_at_ends
    _memory: KeptEpisodes

    def __init__(
        self, *args: Any, baseline: Baseline = "none", value_step_size: float = 0.2, **kwargs: Any
    ) -> None:
        self.baseline = baseline
        self.value_step_size = value_step_size
        super().__init__(*args, **kwargs)

    @property
    def values_states(self) -> bool:  # type: ignore[override]
        """Whether the policy has weights of state values."""
        return self.baseline == "value"

    def _make_memory(self, capacity: int = FIRST_CAPACITY) -> KeptEpisodes:
        n_envs, n_tilings = self.n_envs, self.policy.tiles.n_tilings
        return KeptEpisodes(
            self.policy.state_weights.numpy(),
            np.zeros(n_envs, dtype=np.int64),
            np.zeros((n_envs, capacity, n_tilings), dtype=np.int64),
            np.zeros((n_envs, capacity), dtype=np.int64),
            np.zeros((n_envs, capacity)),
        )

    def _keep_up_to(self, n_steps: int) -> None:
        """Enlarge the memory to ``n_steps`` steps of each episode, keeping stored steps."""
        old, self._memory = self._memory, self._make_memory(n_steps)
        self._memory.lengths[:] = old.lengths
        for name in ("tiles", "actions", "rewards"):
            stored = getattr(old, name)
            getattr(self._memory, name)[:, : stored.shape[1]] = stored

    def check_compilable(self) -> None:
        super().check_compilable()
        assert self.env is not None
        limits = [time_limit(env) or 0 for env in getattr(self.env, "envs", [])]
        if not all(limits):
            raise NotCompilable("episodes are kept, and there is no limit to their length")
        longest = max(limits, default=0)
        if longest > self._memory.rewards.shape[1]:
            self._keep_up_to(longest)

    def _learn_from(self, transitions: Transitions) -> None:
        capacity = self._memory.rewards.shape[1]
        if self._memory.lengths.max() >= capacity:
            self._keep_up_to(2 * capacity)
        super()._learn_from(transitions)
