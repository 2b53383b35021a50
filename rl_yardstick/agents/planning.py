"""Agents that do not learn from rewards: fixed policies as baselines, and planners.

Planners know the transition model, and are an upper bound for the others: `learn` plans first. It
then plays the policy, so that callbacks, Monitor and logger get the same calls as from any other
agent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from rl_yardstick.agents.common.algorithm import OnlineAlgorithm
from rl_yardstick.agents.common.given_spaces import in_given_spaces
from rl_yardstick.agents.common.masks import numbers_in
from rl_yardstick.agents.common.model_files import TablePolicy
from rl_yardstick.envs.cut_world import cut_world
from rl_yardstick.envs.known_models import (
    action_masks_of_states,
    observations_of_states,
    time_limit,
    transition_model,
    why_unknown,
)
from rl_yardstick.mdp import (
    TransitionModel,
    finite_horizon_optimum,
    policy_iteration,
    value_iteration,
)
from rl_yardstick.mdp.transition_model import Bools, Ints

POLE_ANGLE = 2
LEFT, RIGHT = 0, 1


class RandomPolicy(TablePolicy):
    """Uniformly random actions from the action space's own generator."""

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        first = next(iter(observation.values())) if isinstance(observation, dict) else observation
        return th.from_numpy(np.stack([self.action_space.sample() for _ in range(len(first))]))


class AnglePolicy(TablePolicy):
    """Push the cart towards the side that the pole leans to."""

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return th.where(observation[:, POLE_ANGLE] > 0, RIGHT, LEFT)


class ReferenceAgent(OnlineAlgorithm):
    """Acts by a fixed policy; training it changes nothing but its counters."""

    hidden_arguments = ("learning_rate", "policy_kwargs", "supported_action_spaces")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)

    def _choose_actions(self) -> NDArray[Any]:
        assert self._last_obs is not None
        return super().predict(self._last_obs)[0]

    @in_given_spaces
    def predict(self, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        return super().predict(*args, **kwargs)


class RandomAgent(ReferenceAgent):
    """Uniformly random actions, whatever is observed."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"RandomPolicy": RandomPolicy}


class AngleAgent(ReferenceAgent):
    """CartPole: push the cart towards the side that the pole leans to."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"AnglePolicy": AnglePolicy}


# Actions of shape (m, S), with 1, 2, ... steps left, and the horizon.
Plan = tuple[NDArray[np.integer[Any]], int]


class ActionTablePolicy(TablePolicy):
    """One action for each observation, or for each observation and number of steps left."""

    # Int64 of shape (m, S): with 1, 2, ... steps left; with more than m, the last row.
    actions: th.Tensor
    horizon: th.Tensor  # steps of an episode, int64 of shape (); only used if m is above 1

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        shape = (1, int(self.observation_space.n))  # type: ignore[attr-defined]
        self.register_buffer("actions", th.zeros(shape, dtype=th.int64))
        self.register_buffer("horizon", th.tensor(1))

    @property
    def is_stationary(self) -> bool:
        """Whether the actions are the same however many steps are left."""
        return len(self.actions) == 1

    def actions_after(self, obs: Ints, steps: Ints) -> Ints:
        """The actions in ``obs`` after ``steps`` steps of the episode, all of shape (n,)."""
        steps_left = np.clip(int(self.horizon) - steps, 1, len(self.actions))
        return np.asarray(self.actions.numpy()[steps_left - 1, obs])

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Load a plan of any number of steps."""
        if "actions" in state_dict:
            n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
            plan = state_dict["actions"]
            fits = plan.ndim == 2 and len(plan) and plan.shape[1] == self.actions.shape[1]
            if not (fits and bool(((plan >= 0) & (plan < n_actions)).all())):
                raise ValueError("holds no plan for these observations and actions")
            self.actions = th.zeros_like(state_dict["actions"])
        return super().load_state_dict(state_dict, strict, assign)

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        obs = numbers_in(self.observation_space, observation).reshape(-1)
        return th.from_numpy(self.actions_after(obs, np.zeros(len(obs), dtype=np.int64)))


class PlanningAgent(OnlineAlgorithm):
    """The base of the agents that plan.

    Args:
        policy: ``"ActionTablePolicy"``.
        env: environment whose transition model is known, or its bins' `cut_world`; or its id.
        gamma: discount factor of the planning; by default 1 for the optimum under the time
            limit, and 0.99 for the others.
        mask_actions: plan with only those actions that the environment allows in each state.

    Raises:
        ValueError: if ``gamma`` is outside [0, 1]; by `learn`, if the model is not known, or
            the masks are needed and not known.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"ActionTablePolicy": ActionTablePolicy}
    policy: ActionTablePolicy
    observed = ("Discrete",)
    default_gamma: ClassVar[float] = 0.99
    planner: ClassVar[Callable[..., Any]]
    hidden_arguments = ("learning_rate", "policy_kwargs", "supported_action_spaces")
    cut_world: TransitionModel | None = (
        None  #: what was planned on, if observations are cut into bins
    )
    excluded_from_states = ("cut_world",)
    _rebuilt = (*OnlineAlgorithm._rebuilt, "cut_world")

    def __init__(
        self,
        policy: str | type[BasePolicy] = "ActionTablePolicy",
        env: GymEnv | str | None = None,
        gamma: float | None = None,
        mask_actions: bool = False,
        **kwargs: Any,
    ) -> None:
        self.gamma = self.default_gamma if gamma is None else gamma
        self.mask_actions = mask_actions
        self._steps = np.zeros(0, dtype=np.int64)
        super().__init__(policy, env, supported_action_spaces=(spaces.Discrete,), **kwargs)

    def _setup_model(self) -> None:
        if not 0 <= self.gamma <= 1:
            raise ValueError(f"gamma must lie between 0 and 1, not {self.gamma}")
        super()._setup_model()

    def _begin_episodes(self) -> None:
        self._steps = np.zeros(self.n_envs, dtype=np.int64)

    def _run(self, total_timesteps: int, callback: BaseCallback, log_interval: int | None) -> None:
        self.plan()
        super()._run(total_timesteps, callback, log_interval)

    def plan(self) -> None:
        """Compute the policy from the transition model of the environment."""
        assert self.env is not None
        name, vec_env = type(self).__name__, self.env.unwrapped
        if not isinstance(vec_env, DummyVecEnv):
            raise ValueError(f"{name} needs environments in its own process: --vec-env dummy")
        env = vec_env.envs[0]
        model, observations = transition_model(env), observations_of_states(env)
        if model is None:
            try:
                self.cut_world = cut_world(env)
            except (TypeError, ValueError) as error:  # of copying, and of what does not fit
                where = "where the attribute state can be set, as in Gymnasium's classic control"
                raise ValueError(f"{name} plans on bins {where}: {error}") from error
            if (model := self.cut_world) is not None:
                observations = np.arange(model.n_states)
        if model is None or observations is None:
            reason = "" if (why := why_unknown(env)) is None else f": {why}"
            raise ValueError(f"{name} needs an environment whose transition model is known{reason}")
        if observations.ndim != 1:
            raise ValueError(f"{name} needs observations that are the numbers of the states")
        mask = action_masks_of_states(env) if self.mask_actions else None
        if self.mask_actions and mask is None:
            raise ValueError(f"mask_actions: {name} needs an environment whose masks are known")
        by_state, horizon = self._plan(model, time_limit(env), mask)
        actions = np.zeros((len(by_state), int(self.observation_space.n)), dtype=np.int64)  # type: ignore[attr-defined]
        actions[:, observations] = by_state
        # E.g. in Blackjack a natural looks like any other 21.
        if (actions[:, observations] != by_state)[:, model.reachable].any():
            raise ValueError(f"{name} needs observations that tell the states apart")
        self.policy.actions, self.policy.horizon = th.from_numpy(actions), th.tensor(horizon)

    def _plan(self, model: TransitionModel, limit: int | None, mask: Bools | None) -> Plan:
        """The plan under a time limit, among the actions of ``mask``, bool of shape (S, A)."""
        return type(self).planner(model, self.gamma, mask=mask).policy[None], 1

    def _choose_actions(self) -> Ints:
        actions = self.policy.actions_after(np.asarray(self._last_obs), self._steps)
        self._steps = self._steps + 1
        return actions

    def _learn_from(self, transitions: Any) -> None:
        self._steps[transitions.dones] = 0

    @in_given_spaces
    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The planned actions; ``state`` carries the number of steps of each episode so far.

        Takes one state index or an array of shape (n,), and returns actions of the same shape and
        the new ``state``, which is None at the start. ``episode_start`` of shape (n,) tells whether
        an episode begins; ``deterministic`` is not used, as plans are.
        """
        obs = numbers_in(self.observation_space, observation)
        steps = np.zeros(obs.size, dtype=np.int64) if state is None else state[0].copy()
        if episode_start is not None:
            steps[np.asarray(episode_start, dtype=np.bool_)] = 0
        actions = self.policy.actions_after(obs.reshape(-1), steps)
        return actions.reshape(obs.shape), (steps + 1,)


class ValueIteration(PlanningAgent):
    """Greedy in the optimal values without a time limit (Sutton and Barto, section 4.4).

    Without a discount, shorter and longer ways to the goal may have the same value.
    """

    planner = staticmethod(value_iteration)


class PolicyIteration(PlanningAgent):
    """Policy iteration: evaluate a policy exactly, make it greedy, repeat (section 4.3).

    It takes few rounds, each of which solves a linear system: for up to about 10,000 states.
    """

    planner = staticmethod(policy_iteration)


class Optimal(PlanningAgent):
    """The optimum under the time limit; its actions may depend on the steps left."""

    default_gamma = 1.0

    def _plan(self, model: TransitionModel, limit: int | None, mask: Bools | None) -> Plan:
        if limit is None:
            raise ValueError("Optimal needs a time limit: give the environment max_episode_steps")
        plan = finite_horizon_optimum(model, limit, self.gamma, mask)
        return plan.actions_left, limit
