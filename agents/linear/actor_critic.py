"""One-step actor-critic."""

from __future__ import annotations

from typing import Any, NamedTuple, Unpack

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from agents.common.setting_checks import check_at_least, settings_of
from agents.linear.softmax import (
    SoftmaxAlgorithm,
    SoftmaxArguments,
    ascend,
    move_state_value,
    state_value,
)
from agents.linear.weighted_tiles import LinearAgent, look
from agents.networks.observations import AFTER, BEFORE, move_on
from machine_code.compiling import called
from mdp.array_types import Floats


class Critic(NamedTuple):
    """What the agent keeps besides its preferences.

    Attributes:
        values: weights of the state values, shape (tiles,).
        discounts: gamma to the power of the steps of the episode under way in each of n
            environments, shape (n,).
    """

    values: Floats
    discounts: Floats


@called
def actor_critic_step(agent: LinearAgent, env: Any, progress: Any, discount: float) -> float:
    """Learn from an environment's last step, and return the TD error.

    Args:
        agent: the agent.
        env: the environment's record.
        progress: how far the training is.
        discount: weighs what is learnt about the policy.
    """
    room, values = agent.room, agent.memory.values
    look(agent, env, AFTER, room.next_tiles)
    look(agent, env, BEFORE, room.tiles)
    follows = 0.0 if env.terminated else agent.settings.gamma * state_value(values, room.next_tiles)
    td_error = env.reward + follows - state_value(values, room.tiles)
    n_tilings = len(room.tiles)
    move_state_value(values, room.tiles, agent.settings.value_step_size / n_tilings * td_error)
    step = progress.learning_rate / n_tilings * discount * td_error
    ascend(agent, room.tiles, env.action, step)
    return float(td_error)


@called
def actor_critic_learning(agent: LinearAgent, envs: Any, progress: Any) -> None:
    """The updates in order."""
    total_error, discounts = 0.0, agent.memory.discounts
    for i in range(len(envs)):
        env = envs[i]
        discount = discounts[i] if agent.settings.gamma_power else 1.0
        total_error += abs(actor_critic_step(agent, env, progress, discount))
        discounts[i] = 1.0 if env.done else discounts[i] * agent.settings.gamma
        move_on(agent.seen, env)
    progress.mean_td_error = total_error / len(envs)


class ActorCritic(SoftmaxAlgorithm):
    """One-step actor-critic, episodic (Sutton and Barto, section 13.5).

    The TD error of a learnt state value moves that value, and the policy's preferences. Where an
    episode terminates, nothing follows; where it is truncated, the value of the last state does.

    Args:
        policy: ``"TilePolicy"``.
        env: as in `TileAlgorithm`.
        learning_rate: step size of the policy, constant or scheduled, as in `TileAlgorithm`.
        value_step_size: step size of the state values, divided by the number of tilings likewise.
        kwargs: as in `SoftmaxAlgorithm`.
    """

    parameters = {"value_step_size": np.float64}  # noqa: RUF012
    learn_from_step = actor_critic_learning
    values_states = True

    _rebuilt = (*SoftmaxAlgorithm._rebuilt, "_discounts")

    def __init__(
        self,
        policy: str | type[BasePolicy] = "TilePolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = 0.1,
        value_step_size: float = 0.2,
        **kwargs: Unpack[SoftmaxArguments],
    ) -> None:
        self.value_step_size = value_step_size
        self._discounts = np.ones(0)
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_at_least(0, settings_of(self, "value_step_size"))

    def _begin_episodes(self) -> None:
        super()._begin_episodes()
        self._discounts = np.ones(self.n_envs)

    def _memory_record(self) -> Critic:
        return Critic(self.policy.state_weights.numpy(), self._discounts)

    def made_from(self, rng: np.random.Generator) -> tuple[Any, ...]:
        return (*super().made_from(rng), id(self._discounts))
