"""Environments as compiled code sees them, and which ones it knows."""

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

from agents.compiled.generators import next_uniform, skip_uniform
from envs.known_models import (
    model_check,
    observations_of_states,
    one_look,
    success_outcomes,
    time_limit,
    transition_model,
)
from envs.model_claims import is_trusted
from envs.wrappers import (
    ActionMasks,
    DiscretizeObservation,
    FlattenToDiscrete,
    IdleActionMasks,
    OneHotObservation,
    ScaleReward,
    TerminationReward,
)
from machine_code.compiling import inlined
from mdp.transition_model import Floats, Ints, TransitionModel

# What the compiled loop works on, as records in arrays.
#
# Handing on a record costs compiled code nothing, where as many arrays would cost more than the
# learning itself.

SCHEDULE = np.dtype(
    [(name, np.float64) for name in ("kind", "start", "end", "end_fraction")], align=True
)

# One environment and the step that it took last.
_ENV_FIELDS = [
    ("elapsed", np.int64),  # steps of the episode
    ("episode_return", np.float64),  # sum of the rewards that Monitor sees
    ("compensation", np.float64),  # what rounding has taken from it
    ("obs", np.int64),
    ("action", np.int64),
    ("probability", np.float64),  # of the action, where the agent tells
    ("reward", np.float64),
    ("monitor_reward", np.float64),
    ("terminated", np.bool_),
    ("done", np.bool_),
    ("success", np.bool_),
    ("next_obs", np.int64),  # before any reset
    ("new_obs", np.int64),  # after it
    ("next_action", np.int64),  # committed to, or UNDECIDED
    ("uniform", np.float64),  # in [0, 1), for updates that are partly random
    ("target", np.float64),  # of the last update, where the agent tells; else nan
    ("td_error", np.float64),  # likewise
]

UNDECIDED = -1


def env_dtype(*state: tuple[str, type]) -> np.dtype[np.void]:
    """The record of an environment whose own state has these fields."""
    # First: behind the others they would make the record a subtype of `ENV` in Numba's eyes.
    return np.dtype([*state, *_ENV_FIELDS], align=True)


def env_records(n: int, kind: np.dtype[np.void]) -> NDArray[np.void]:
    """Records of n environments that nothing was learnt in yet, of a type from `env_dtype`."""
    records = np.zeros(n, dtype=kind)
    records["target"] = records["td_error"] = np.nan
    return records


# An environment that is stepped outside of compiled code keeps its state to itself.
ENV = env_dtype()

# How far the training is; there is one record of it.
PROGRESS = np.dtype(
    [
        ("num_timesteps", np.int64),
        ("total_timesteps", np.float64),
        ("remaining", np.float64),
        ("exploration", np.float64),  # what its schedule says now
        ("exploration_schedule", SCHEDULE),
        ("learning_rate", np.float64),
        ("learning_rate_schedule", SCHEDULE),
        ("episodes", np.int64),
        ("episode_budget", np.int64),  # episodes to train for; 0 where steps are counted
        ("budget_episodes", np.int64),  # episodes that have counted towards it
        ("logged_episodes", np.int64),  # those in the log
        ("mean_td_error", np.float64),
        ("record_interval", np.int64),  # episodes between two records of the log; 0 for none
        ("next_record", np.int64),  # the number of episodes at which the next one is due
        ("n_records", np.int64),  # of the block
    ],
    align=True,
)

# What a record of the log is made from: a moment of a block, after what was learnt there.
RECORD = np.dtype(
    [
        ("step", np.int64),  # of the block
        ("logged_episodes", np.int64),  # of the block so far
        ("episodes", np.int64),  # of the training
        ("exploration", np.float64),
        ("learning_rate", np.float64),
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
# A `FiniteModel` does what the environment's own `step` and `reset` do, bit for bit, from the same
# generator: each takes one uniform number.

FINITE_ENV = env_dtype(("state", np.int64))

# One outcome of an action: S states, A actions and K outcomes make an array of shape (S, A, K).
OUTCOME = np.dtype(
    [
        ("cumulative", np.float64),  # probability of this outcome or one before it
        ("reward", np.float64),  # as Monitor sees it
        ("agent_reward", np.float32),  # as the agent is given it, rounded to single precision
        ("next_state", np.int32),
        ("terminated", np.bool_),
        ("success", np.bool_),
    ],
    align=True,
)


@inlined
def pick_outcome(outcomes: Any, state: int, action: int, uniform: float) -> int:
    """The first outcome whose cumulative probability exceeds ``uniform``, else 0, as toy_text."""
    for outcome in range(outcomes.shape[2]):
        if outcomes[state, action, outcome].cumulative > uniform:
            return outcome
    return 0


@inlined
def pick_start(starts: Ints, start_cumulative: Floats, uniform: float) -> int:
    """The state that an episode begins in."""
    # Halving what is left; NumPy's search takes longer to compile than the rest of an environment.
    below, above = 0, len(start_cumulative)
    while below < above:
        middle = (below + above) // 2
        if start_cumulative[middle] > uniform:
            above = middle
        else:
            below = middle + 1
    return int(starts[below]) if below < len(starts) else 0


class FiniteModel(NamedTuple):
    """Dynamics, shared by all environments of a training."""

    time_limit: int  # steps after which an episode is truncated, or 0 for never
    outcomes: NDArray[np.void]  # records of type `OUTCOME`, shape (S, A, K)
    starts: Ints  # states where an episode may begin, shape (m,)
    start_cumulative: Floats  # their cumulative probabilities, shape (m,)
    observation: Ints  # what is observed in each state, shape (S,)

    @inlined
    def step(self, env: Any, handle: Any) -> None:
        """Do ``env.action`` in ``env.state``."""
        outcome = 0
        if self.outcomes.shape[2] > 1:
            uniform = next_uniform(handle)
            outcome = pick_outcome(self.outcomes, env.state, env.action, uniform)
        else:
            skip_uniform(handle)
        result = self.outcomes[env.state, env.action, outcome]
        env.state = result.next_state
        env.reward = result.agent_reward
        env.monitor_reward = result.reward
        env.terminated = result.terminated
        env.success = result.success
        env.next_obs = self.observation[env.state]

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw a state to begin in."""
        env.state = pick_start(self.starts, self.start_cumulative, next_uniform(handle))
        env.new_obs = self.observation[env.state]


# CartPole as compiled code, which shows numbers of bins.

STATE = ("x", "x_dot", "theta", "theta_dot")
CART_POLE_ENV = env_dtype(*((name, np.float64) for name in STATE))


@inlined
def swing(world: CartPole, env: Any) -> bool:
    """One step of Gymnasium's CartPole in its order of operations; whether it terminates."""
    x, x_dot, theta, theta_dot = env.x, env.x_dot, env.theta, env.theta_dot
    force = world.force_mag if env.action == 1 else -world.force_mag
    cos_theta = math.cos(theta)
    sin_theta = math.sin(theta)
    temp = (force + world.polemass_length * (theta_dot * theta_dot) * sin_theta) / world.total_mass
    theta_acc = (world.gravity * sin_theta - cos_theta * temp) / (
        world.length * (4.0 / 3.0 - world.masspole * (cos_theta * cos_theta) / world.total_mass)
    )
    x_acc = temp - world.polemass_length * theta_acc * cos_theta / world.total_mass
    if world.semi_implicit:
        x_dot = x_dot + world.tau * x_acc
        x = x + world.tau * x_dot
        theta_dot = theta_dot + world.tau * theta_acc
        theta = theta + world.tau * theta_dot
    else:
        x = x + world.tau * x_dot
        x_dot = x_dot + world.tau * x_acc
        theta = theta + world.tau * theta_dot
        theta_dot = theta_dot + world.tau * theta_acc
    env.x, env.x_dot, env.theta, env.theta_dot = x, x_dot, theta, theta_dot
    return bool(abs(x) > world.x_threshold or abs(theta) > world.theta_threshold_radians)


@inlined
def bin_index(world: CartPole, env: Any) -> int:
    """What `DiscretizeObservation` shows of CartPole's state, rounded to single precision first."""
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
    """CartPole's constants, as Gymnasium names them, and the bins it is seen through, if any."""

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
        """Push the cart as ``env.action`` says; nothing is drawn for that."""
        env.terminated = swing(self, env)
        env.reward = 1.0
        env.monitor_reward = 1.0
        env.success = False
        env.next_obs = bin_index(self, env)

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw a state as ``Generator.uniform(-0.05, 0.05, 4)`` does."""
        width = 0.05 - -0.05
        env.x = -0.05 + width * next_uniform(handle)
        env.x_dot = -0.05 + width * next_uniform(handle)
        env.theta = -0.05 + width * next_uniform(handle)
        env.theta_dot = -0.05 + width * next_uniform(handle)
        env.new_obs = bin_index(self, env)

    @inlined
    def show_state(self, env: Any, vector: Any) -> None:
        """What the agent sees where there are no bins, in single precision, shape (4,)."""
        vector[0] = np.float32(env.x)
        vector[1] = np.float32(env.x_dot)
        vector[2] = np.float32(env.theta)
        vector[3] = np.float32(env.theta_dot)


# MountainCar as compiled code.

CAR_STATE = ("position", "velocity")
MOUNTAIN_CAR_ENV = env_dtype(*((name, np.float64) for name in CAR_STATE))


@inlined
def drive(world: MountainCar, env: Any) -> bool:
    """One step of Gymnasium's MountainCar in its order of operations; whether it terminates."""
    position, velocity = env.position, env.velocity
    push = (env.action - 1) * world.force
    velocity += push + math.cos(3 * position) * (-world.gravity)
    velocity = min(max(velocity, -world.max_speed), world.max_speed)
    position += velocity
    position = min(max(position, world.min_position), world.max_position)
    if position == world.min_position and velocity < 0:
        velocity = 0.0
    env.position, env.velocity = position, velocity
    return bool(position >= world.goal_position and velocity >= world.goal_velocity)


class MountainCar(NamedTuple):
    """MountainCar's constants, as Gymnasium names them."""

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
        """Push the car as ``env.action`` says; nothing is drawn for that."""
        env.terminated = drive(self, env)
        env.reward = -1.0
        env.monitor_reward = -1.0
        env.success = False
        env.next_obs = 0

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw a position as ``Generator.uniform(-0.6, -0.4)`` does; the car stands still."""
        width = -0.4 - -0.6
        env.position = -0.6 + width * next_uniform(handle)
        env.velocity = 0.0
        env.new_obs = 0

    @inlined
    def show_state(self, env: Any, vector: Any) -> None:
        """What the agent sees, in single precision, shape (2,)."""
        vector[0] = np.float32(env.position)
        vector[1] = np.float32(env.velocity)


# From the environments of a training to the compiled ones that stand for them.

Env = gym.Env[Any, Any]
World = FiniteModel | CartPole | MountainCar

# Wrappers whose work the engine does itself, or that have none to do.
COMMON_WRAPPERS = {Monitor, TimeLimit, OrderEnforcing, PassiveEnvChecker}
CART_POLE_WRAPPERS = {DiscretizeObservation, *COMMON_WRAPPERS}
MODEL_WRAPPERS = {
    *COMMON_WRAPPERS,
    *(ActionMasks, IdleActionMasks),
    *(ClipReward, FlattenToDiscrete, OneHotObservation, ScaleReward, TerminationReward),
}


class NotCompilable(ValueError):  # noqa: N818  # no error: the interpreted loop takes over
    """Why there is no compiled counterpart, of environments or of an agent."""


def layers(env: Env) -> list[Env]:
    """The environment and what it wraps, the outermost first."""
    chain = [env]
    while isinstance(env, gym.Wrapper):
        env = env.env
        chain.append(env)
    return chain


def monitor_of(env: Env) -> Monitor | None:
    """The Monitor around the environment, if there is one."""
    return next((layer for layer in layers(env) if isinstance(layer, Monitor)), None)


def compile_envs(vec_env: VecEnv) -> World:
    """The compiled counterpart of environments that are all alike."""
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
    """Whether compiled environments draw the very numbers that these draw, for the same things."""
    own = [env for env in vec_env.envs if not is_trusted(env.unwrapped)]
    return all(check is None or check.bit_for_bit for check in map(model_check, own))


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
    if check is None or model is None or observations is None:
        raise NotCompilable("the environment's transition model is not known")
    if model.reward_variance is not None:
        raise NotCompilable("rewards are drawn, and the environment's model holds their means")
    # A wrapper may leave the dynamics alone and yet have to see every step, to film it say.
    watching = {type(layer) for layer in layers(env)[:-1]} - MODEL_WRAPPERS
    if watching:
        names = ", ".join(sorted(wrapper.__name__ for wrapper in watching))
        raise NotCompilable(f"{names} must see every step")
    if not check.state_can_be_set:
        raise NotCompilable("the environment does not go on from where its attribute s is set")
    monitor = monitor_of(env)
    seen_by_monitor = model if monitor is None else transition_model(monitor.env)
    assert seen_by_monitor is not None
    starts = np.flatnonzero(model.initial)
    return FiniteModel(
        time_limit=time_limit(env) or 0,
        outcomes=_outcomes(env, model, seen_by_monitor),
        starts=starts,
        start_cumulative=np.cumsum(model.initial)[starts],
        observation=_numbers(observations),
    )


def _numbers(observations: NDArray[Any]) -> NDArray[np.int64]:
    """What is observed in each state, as numbers; the states' own where it is something else."""
    if np.issubdtype(observations.dtype, np.integer) and observations.ndim == 1:
        return observations.astype(np.int64)
    return np.arange(len(observations))


def _outcomes(env: Env, model: TransitionModel, seen_by_monitor: TransitionModel) -> NDArray[Any]:
    outcomes = np.zeros(model.prob.shape, dtype=OUTCOME)
    outcomes["cumulative"] = np.cumsum(model.prob, axis=2)
    outcomes["reward"] = seen_by_monitor.reward
    # A VecEnv hands rewards on in single precision.
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
    """An environment's constants that the world has under the same names."""
    return {name: float(getattr(base, name)) for name in world._fields if hasattr(base, name)}


def _mountain_car(env: Env) -> MountainCar:
    *wrappers, base = layers(env)
    assert isinstance(base, MountainCarEnv)
    if type(base) is not MountainCarEnv or {type(layer) for layer in wrappers} - COMMON_WRAPPERS:
        raise NotCompilable("MountainCar compiles as it is, under Monitor alone")
    return MountainCar(time_limit(env) or 0, **_constants(base, MountainCar))
