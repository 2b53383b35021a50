"""From the environments of a training to the compiled ones that stand for them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv, MountainCarEnv
from gymnasium.wrappers import ClipReward, OrderEnforcing, PassiveEnvChecker, TimeLimit
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from agents.compiled.cart_pole import CartPole
from agents.compiled.finite_model import OUTCOME, FiniteModel
from agents.compiled.mountain_car import MountainCar
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
from mdp.transition_model import TransitionModel

Env = gym.Env[Any, Any]
World = FiniteModel | CartPole | MountainCar

# Wrappers whose work the engine does itself, or that have none to do.
COMMON_WRAPPERS = {Monitor, TimeLimit, OrderEnforcing, PassiveEnvChecker}
CART_POLE_WRAPPERS = {DiscretizeObservation, *COMMON_WRAPPERS}
MASK_WRAPPERS = {ActionMasks, IdleActionMasks}
CHANGE_WRAPPERS = {
    ClipReward,
    FlattenToDiscrete,
    OneHotObservation,
    ScaleReward,
    TerminationReward,
}
MODEL_WRAPPERS = {*CHANGE_WRAPPERS, *MASK_WRAPPERS, *COMMON_WRAPPERS}


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
    """The compiled counterpart of environments that are all alike.

    Raises:
        NotCompilable: where there is none; the message says why.
    """
    if type(vec_env) is not DummyVecEnv:
        raise NotCompilable(f"{type(vec_env).__name__} is not DummyVecEnv")
    for env in vec_env.envs:
        if env.render_mode == "human":
            raise NotCompilable("the environment is shown on the screen")
        _check_monitor(env)
    first, *others = vec_env.envs
    world = _world_of(first)
    for other in others:
        _check_alike(world, first, other)
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


def _check_alike(world: World, first: Env, other: Env) -> None:
    kinds = [[type(layer) for layer in layers(env)] for env in (first, other)]
    if kinds[0] != kinds[1] or not _are_equal(world, _world_of(other)):
        raise NotCompilable("the environments are not alike")


def _are_equal(world: World, other: World) -> bool:
    fields: Iterable[tuple[Any, Any]] = zip(world, other, strict=True)
    return all(np.array_equal(ours, theirs) for ours, theirs in fields)


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
        time_limit=time_limit(env) or 0,
        gravity=float(base.gravity),
        masspole=float(base.masspole),
        total_mass=float(base.total_mass),
        length=float(base.length),
        polemass_length=float(base.polemass_length),
        force_mag=float(base.force_mag),
        tau=float(base.tau),
        semi_implicit=base.kinematics_integrator != "euler",
        x_threshold=float(base.x_threshold),
        theta_threshold=float(base.theta_threshold_radians),
        dims=dims,
        bins=bins,
    )


def _mountain_car(env: Env) -> MountainCar:
    *wrappers, base = layers(env)
    assert isinstance(base, MountainCarEnv)
    if type(base) is not MountainCarEnv or {type(layer) for layer in wrappers} - COMMON_WRAPPERS:
        raise NotCompilable("MountainCar compiles as it is, under Monitor alone")
    constants = {name: float(getattr(base, name)) for name in MountainCar._fields[1:]}
    return MountainCar(time_limit(env) or 0, **constants)
