"""Compiled counterparts of environments, and the conversion to them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv, MountainCarEnv
from gymnasium.wrappers import ClipReward, OrderEnforcing, PassiveEnvChecker, TimeLimit
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from rl_yardstick.agents.common.schedules import ScheduleRow
from rl_yardstick.agents.compiled.references import next_uniform
from rl_yardstick.envs.known_models import (
    model_check,
    observations_of_states,
    one_look,
    success_outcomes,
    time_limit,
    transition_model,
)
from rl_yardstick.envs.published_models import is_trusted
from rl_yardstick.envs.wrappers import (
    ActionMasks,
    DiscretizeObservation,
    FlattenToDiscrete,
    IdleActionMasks,
    OneHotObservation,
    ScaleReward,
    TerminationReward,
)
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

# The data of the compiled loop, as records in arrays.
#
# Passing a record costs compiled code nothing. Passing as many arrays would cost more than the
# learning itself.

SCHEDULE = np.dtype([(name, np.float64) for name in ScheduleRow._fields], align=True)

# One environment and its last step.
_ENV_FIELDS = [
    ("elapsed", np.int64),  # steps of the episode
    ("episode_return", np.float64),  # sum of the rewards that Monitor sees
    ("compensation", np.float64),  # lost to rounding
    ("obs", np.int64),
    ("action", np.int64),
    ("probability", np.float64),  # of the action, if the agent reports it
    ("reward", np.float64),
    ("monitor_reward", np.float64),
    ("terminated", np.bool_),
    ("done", np.bool_),
    ("success", np.bool_),
    ("next_obs", np.int64),  # before any reset
    ("new_obs", np.int64),  # after it
    ("next_action", np.int64),  # committed to, or UNDECIDED
    ("uniform", np.float64),  # in [0, 1), for partly random updates
    ("target", np.float64),  # of the last update, if the agent reports it; else nan
    ("td_error", np.float64),  # likewise
]

UNDECIDED = -1


def env_dtype(*state: tuple[str, type]) -> np.dtype[np.void]:
    """The record type of an environment whose own state has these fields."""
    # First: after the other fields, they would make the record a subtype of `ENV` for Numba.
    return np.dtype([*state, *_ENV_FIELDS], align=True)


def env_records(n: int, kind: np.dtype[np.void]) -> NDArray[np.void]:
    """New records of n environments, of a type from `env_dtype`."""
    records = np.zeros(n, dtype=kind)
    records["target"] = records["td_error"] = np.nan
    return records


# An environment that Python steps keeps its own state.
ENV = env_dtype()

# The progress of the training; there is one such record.
PROGRESS = np.dtype(
    [
        ("num_timesteps", np.int64),
        ("total_timesteps", np.float64),
        ("remaining", np.float64),
        ("exploration", np.float64),  # current value of its schedule
        ("exploration_schedule", SCHEDULE),
        ("learning_rate", np.float64),
        ("learning_rate_schedule", SCHEDULE),
        ("episodes", np.int64),
        ("episode_budget", np.int64),  # episodes to train for; 0 where steps are counted
        ("budget_episodes", np.int64),  # episodes that have counted towards it
        ("logged_episodes", np.int64),  # those in the log
        ("mean_td_error", np.float64),
    ],
    align=True,
)

# An episode that has ended.
EPISODE = np.dtype(
    [
        ("env", np.int64),
        ("step", np.int64),  # of the block
        ("episode_return", np.float64),
        ("length", np.int64),
        ("success", np.bool_),
    ],
    align=True,
)


# Environments with a known transition model as compiled code.
#
# A `FiniteModel` repeats the environment's own `step` and `reset` bit for bit, with the same
# generator: each call draws one uniform number.

# One outcome of an action: S states, A actions and K outcomes make an array of shape (S, A, K).
OUTCOME = np.dtype(
    [
        ("cumulative", np.float64),  # probability of this outcome or one before it
        ("reward", np.float64),  # as Monitor sees it
        ("agent_reward", np.float32),  # as the agent gets it, in single precision
        ("next_state", np.int32),
        ("terminated", np.bool_),
        ("success", np.bool_),
    ],
    align=True,
)


@inlined
def pick_outcome(outcomes: Any, state: int, action: int, uniform: float) -> int:
    """The first outcome whose cumulative probability exceeds ``uniform``, else 0, like toy_text."""
    for outcome in range(outcomes.shape[2]):
        if outcomes[state, action, outcome].cumulative > uniform:
            return outcome
    return 0


@inlined
def pick_start(starts: Ints, start_cumulative: Floats, uniform: float) -> int:
    """Choose the first state of an episode."""
    # Binary search; NumPy's takes longer to compile than the rest of an environment.
    below, above = 0, len(start_cumulative)
    while below < above:
        middle = (below + above) // 2
        if start_cumulative[middle] > uniform:
            above = middle
        else:
            below = middle + 1
    return int(starts[below]) if below < len(starts) else 0


class FiniteModel(NamedTuple):
    """The dynamics that all environments of a training share."""

    time_limit: int  # steps after which an episode is truncated, 0 for never
    outcomes: NDArray[np.void]  # records of type `OUTCOME`, shape (S, A, K)
    starts: Ints  # states where an episode may begin, shape (m,)
    start_cumulative: Floats  # their cumulative probabilities, shape (m,)
    observation: Ints  # what is observed in each state, shape (S,)

    @inlined
    def step(self, env: Any, handle: Any) -> None:
        """Take ``env.action`` in ``env.state``."""
        outcome, uniform = 0, next_uniform(handle)
        if self.outcomes.shape[2] > 1:
            outcome = pick_outcome(self.outcomes, env.state, env.action, uniform)
        result = self.outcomes[env.state, env.action, outcome]
        env.state = result.next_state
        env.reward = result.agent_reward
        env.monitor_reward = result.reward
        env.terminated = result.terminated
        env.success = result.success
        env.next_obs = self.observation[env.state]

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw the first state of an episode."""
        env.state = pick_start(self.starts, self.start_cumulative, next_uniform(handle))
        env.new_obs = self.observation[env.state]


# CartPole as compiled code; observations may be bin numbers.

STATE = ("x", "x_dot", "theta", "theta_dot")


@inlined
def bin_index(world: CartPole, env: Any) -> int:
    """The observation of `DiscretizeObservation`, computed from the state in single precision."""
    dims, bins = world.dims, world.bins
    index = 0
    for d in range(len(dims)):
        value = env.x
        if dims[d] == 1:
            value = env.x_dot
        elif dims[d] == 2:
            value = env.theta
        elif dims[d] == 3:
            value = env.theta_dot
        n_bins, low, high = bins[d, 0], bins[d, 1], bins[d, 2]
        place = (float(np.float32(value)) - low) / (high - low) * n_bins
        index = index * int(n_bins) + int(min(max(place, 0.0), n_bins - 1.0))
    return index


class CartPole(NamedTuple):
    """CartPole's constants under Gymnasium's names, and the bins of its observations, if any."""

    time_limit: int  # steps after which an episode is truncated, or 0 for never
    gravity: float
    masspole: float
    total_mass: float
    length: float
    polemass_length: float
    force_mag: float
    tau: float
    semi_implicit: bool  # whether velocities move before positions
    x_threshold: float
    theta_threshold_radians: float
    dims: Ints  # the dimensions of the observation that count, shape (d,)
    bins: Floats  # number of bins, lower end and upper end of each, shape (d, 3)

    @inlined
    def step(self, env: Any, handle: Any) -> None:
        """Push the cart by ``env.action``, in Gymnasium's order of operations, without chance."""
        x, x_dot, theta, theta_dot = env.x, env.x_dot, env.theta, env.theta_dot
        force = self.force_mag if env.action == 1 else -self.force_mag
        cos_theta = math.cos(theta)
        sin_theta = math.sin(theta)
        temp = (
            force + self.polemass_length * (theta_dot * theta_dot) * sin_theta
        ) / self.total_mass
        theta_acc = (self.gravity * sin_theta - cos_theta * temp) / (
            self.length * (4.0 / 3.0 - self.masspole * (cos_theta * cos_theta) / self.total_mass)
        )
        x_acc = temp - self.polemass_length * theta_acc * cos_theta / self.total_mass
        if self.semi_implicit:
            x_dot = x_dot + self.tau * x_acc
            x = x + self.tau * x_dot
            theta_dot = theta_dot + self.tau * theta_acc
            theta = theta + self.tau * theta_dot
        else:
            x = x + self.tau * x_dot
            x_dot = x_dot + self.tau * x_acc
            theta = theta + self.tau * theta_dot
            theta_dot = theta_dot + self.tau * theta_acc
        env.x, env.x_dot, env.theta, env.theta_dot = x, x_dot, theta, theta_dot
        env.terminated = bool(
            abs(x) > self.x_threshold or abs(theta) > self.theta_threshold_radians
        )
        env.reward = 1.0
        env.monitor_reward = 1.0
        env.success = False
        env.next_obs = bin_index(self, env)

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw a state like ``Generator.uniform(-0.05, 0.05, 4)``."""
        width = 0.05 - -0.05
        env.x = -0.05 + width * next_uniform(handle)
        env.x_dot = -0.05 + width * next_uniform(handle)
        env.theta = -0.05 + width * next_uniform(handle)
        env.theta_dot = -0.05 + width * next_uniform(handle)
        env.new_obs = bin_index(self, env)

    @inlined
    def show_state(self, env: Any, vector: Any) -> None:
        """The observation without bins, in single precision, shape (4,)."""
        vector[0] = np.float32(env.x)
        vector[1] = np.float32(env.x_dot)
        vector[2] = np.float32(env.theta)
        vector[3] = np.float32(env.theta_dot)


# MountainCar as compiled code.

CAR_STATE = ("position", "velocity")


class MountainCar(NamedTuple):
    """MountainCar's constants under Gymnasium's names."""

    time_limit: int  # steps after which an episode is truncated, or 0 for never
    force: float
    gravity: float
    max_speed: float
    min_position: float
    max_position: float
    goal_position: float
    goal_velocity: float

    @inlined
    def step(self, env: Any, handle: Any) -> None:
        """Push the car by ``env.action``, in Gymnasium's order of operations, without chance."""
        position, velocity = env.position, env.velocity
        push = (env.action - 1) * self.force
        velocity += push + math.cos(3 * position) * (-self.gravity)
        velocity = min(max(velocity, -self.max_speed), self.max_speed)
        position += velocity
        position = min(max(position, self.min_position), self.max_position)
        if position == self.min_position and velocity < 0:
            velocity = 0.0
        env.position, env.velocity = position, velocity
        env.terminated = bool(position >= self.goal_position and velocity >= self.goal_velocity)
        env.reward = -1.0
        env.monitor_reward = -1.0
        env.success = False
        env.next_obs = 0

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw a position like ``Generator.uniform(-0.6, -0.4)``, with velocity 0."""
        width = -0.4 - -0.6
        env.position = -0.6 + width * next_uniform(handle)
        env.velocity = 0.0
        env.new_obs = 0

    @inlined
    def show_state(self, env: Any, vector: Any) -> None:
        """The observation, in single precision, shape (2,)."""
        vector[0] = np.float32(env.position)
        vector[1] = np.float32(env.velocity)


# Conversion of training environments to compiled ones.

Env = gym.Env[Any, Any]
World = FiniteModel | CartPole | MountainCar

# Wrappers whose work the engine does itself, or that do nothing at a step.
COMMON_WRAPPERS = {Monitor, TimeLimit, OrderEnforcing, PassiveEnvChecker}
CART_POLE_WRAPPERS = {DiscretizeObservation, *COMMON_WRAPPERS}
MODEL_WRAPPERS = {
    *COMMON_WRAPPERS,
    *(ActionMasks, IdleActionMasks),
    *(ClipReward, FlattenToDiscrete, OneHotObservation, ScaleReward, TerminationReward),
}


class NotCompilable(ValueError):  # noqa: N818  # no error: the interpreted loop takes over
    """An environment or agent has no compiled counterpart; the message says why."""


def layers(env: Env) -> list[Env]:
    """The environment and all environments inside it, outermost first."""
    chain = [env]
    while isinstance(env, gym.Wrapper):
        env = env.env
        chain.append(env)
    return chain


def monitor_of(env: Env) -> Monitor | None:
    """The outermost Monitor of the environment, or None."""
    return next((layer for layer in layers(env) if isinstance(layer, Monitor)), None)


def compile_envs(vec_env: VecEnv) -> World:
    """The compiled counterpart of identical environments."""
    if type(vec_env) is not DummyVecEnv:
        raise NotCompilable(f"{type(vec_env).__name__} is not DummyVecEnv")
    for env in vec_env.envs:
        if env.render_mode == "human":
            raise NotCompilable("the environment is shown on the screen")
        _check_monitor(env)
    first, *others = vec_env.envs
    world = _world_of(first)
    kinds = [type(layer) for layer in layers(first)]
    for other in others:
        alike = kinds == [type(layer) for layer in layers(other)]
        if not (alike and all(map(cast(Any, np.array_equal), world, _world_of(other)))):
            raise NotCompilable("the environments are not alike")
    return world


def draws_alike(vec_env: DummyVecEnv) -> bool:
    """Whether compiled environments use the same random numbers for the same purposes."""
    checks = [model_check(env) for env in vec_env.envs if not is_trusted(env.unwrapped)]
    return all(check is None or check.bit_for_bit for check in checks)


def _world_of(env: Env) -> World:
    if isinstance(env.unwrapped, CartPoleEnv):
        return _cart_pole(env)
    if isinstance(env.unwrapped, MountainCarEnv):
        return _mountain_car(env)
    with one_look(env):
        return _finite_model(env)


def _check_monitor(env: Env) -> None:
    monitor = monitor_of(env)
    if monitor is None:
        return
    if any(isinstance(layer, Monitor) for layer in layers(monitor.env)):
        raise NotCompilable("there is more than one Monitor")
    if monitor.info_keywords or monitor.reset_keywords:
        raise NotCompilable("Monitor records further keys")
    if time_limit(monitor.env) != time_limit(env):
        raise NotCompilable("a time limit lies outside Monitor")


def _finite_model(env: Env) -> FiniteModel:
    model = transition_model(env)
    observations = observations_of_states(env)
    check = model_check(env)
    if check is not None and check.refusal is not None:
        raise NotCompilable(check.refusal)
    if model is None or observations is None:
        raise NotCompilable("the environment's transition model is not known")
    if model.reward_variance is not None:
        raise NotCompilable("rewards are drawn, and the environment's model holds their means")
    # A wrapper may keep the dynamics but still need every step, for example to film it.
    watching = {type(layer) for layer in layers(env)[:-1]} - MODEL_WRAPPERS
    if watching:
        names = ", ".join(sorted(wrapper.__name__ for wrapper in watching))
        raise NotCompilable(f"{names} must see every step")
    if check is None:
        raise NotCompilable("the model was found by a search, not published")
    if not check.state_can_be_set:
        raise NotCompilable("the environment does not continue from the state that s is set to")
    monitor = monitor_of(env)
    seen_by_monitor = model if monitor is None else transition_model(monitor.env)
    assert seen_by_monitor is not None
    starts, numbers = np.flatnonzero(model.initial), np.arange(len(observations))
    if np.issubdtype(observations.dtype, np.integer) and observations.ndim == 1:
        numbers = observations.astype(np.int64)  # others are replaced by the numbers of the states
    return FiniteModel(
        time_limit=time_limit(env) or 0,
        outcomes=_outcomes(env, model, seen_by_monitor),
        starts=starts,
        start_cumulative=np.cumsum(model.initial)[starts],
        observation=numbers,
    )


def _outcomes(env: Env, model: TransitionModel, seen_by_monitor: TransitionModel) -> NDArray[Any]:
    outcomes = np.zeros(model.prob.shape, dtype=OUTCOME)
    outcomes["cumulative"] = np.cumsum(model.prob, axis=2)
    outcomes["reward"] = seen_by_monitor.reward
    # A VecEnv passes rewards on in single precision.
    outcomes["agent_reward"] = model.reward.astype(np.float32)
    outcomes["next_state"] = model.next_state
    outcomes["terminated"] = model.terminated
    success = success_outcomes(env)
    if success is not None:
        outcomes["success"] = success
    return outcomes


def _cart_pole(env: Env) -> CartPole:
    chain = layers(env)
    wrappers = [layer for layer in chain if isinstance(layer, DiscretizeObservation)]
    base = chain[-1]
    assert isinstance(base, CartPoleEnv)
    if len(wrappers) > 1 or {type(layer) for layer in chain[:-1]} - CART_POLE_WRAPPERS:
        raise NotCompilable("CartPole compiles under DiscretizeObservation and Monitor alone")
    if type(base) is not CartPoleEnv or base._sutton_barto_reward:
        raise NotCompilable("CartPole compiles with its default reward alone")
    dims, bins = np.empty(0, dtype=np.int64), np.empty((0, 3))
    if wrappers:
        wrapper = wrappers[0]
        dims = np.array(wrapper.dims, dtype=np.int64)
        bins = np.stack((wrapper.bins, wrapper.low, wrapper.high), axis=1).astype(np.float64)
    return CartPole(
        time_limit(env) or 0,
        semi_implicit=base.kinematics_integrator != "euler",
        dims=dims,
        bins=bins,
        **_constants(base, CartPole),
    )


def _constants(base: Any, world: Any) -> dict[str, float]:
    """The environment's constants that are fields of the world."""
    return {name: float(getattr(base, name)) for name in world._fields if hasattr(base, name)}


def _mountain_car(env: Env) -> MountainCar:
    *wrappers, base = layers(env)
    assert isinstance(base, MountainCarEnv)
    if type(base) is not MountainCarEnv or {type(layer) for layer in wrappers} - COMMON_WRAPPERS:
        raise NotCompilable("MountainCar compiles as it is, under Monitor alone")
    return MountainCar(time_limit(env) or 0, **_constants(base, MountainCar))
