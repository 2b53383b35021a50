"""Compiled environments are Gymnasium's to the last bit, as they are now, or are refused."""

import numba
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv, MountainCarEnv
from stable_baselines3.common.vec_env import DummyVecEnv

import envs  # noqa: F401  # registers the environments
from agents.compiled.generators import handles_of, next_uniform, skip_uniform
from agents.compiled.worlds import (
    CAR_STATE,
    CART_POLE_ENV,
    MOUNTAIN_CAR_ENV,
    STATE,
    compile_envs,
    drive,
    swing,
)
from envs.wrappers import DiscretizeObservation
from machine_code.compiling import kernel

# --- physics -------------------------------------------------------------------------------------


@numba.njit
def swing_each(records, world, terminated):
    for i in range(len(records)):
        terminated[i] = swing(world, records[i])


@numba.njit
def drive_each(records, world, terminated):
    for i in range(len(records)):
        terminated[i] = drive(world, records[i])


def world_of(env):
    return compile_envs(DummyVecEnv([lambda: env]))


def pole(base=None, **kwargs):
    settings = {"bins": [3, 5, 7, 11], "low": -1.0, "high": 1.0, **kwargs}
    return DiscretizeObservation(base or CartPoleEnv(), **settings)


def altered(env, **attributes):
    """The environment after some of its attributes have been set by hand."""
    vars(env.unwrapped).update(attributes)
    return env


MOON = {"gravity": 1.62, "force_mag": 3.0, "tau": 0.05, "masspole": 0.3, "total_mass": 1.3}
MOON |= {"polemass_length": 0.21, "length": 0.7, "x_threshold": 1.0, "theta_threshold_radians": 0.1}
HILLS = {"force": 0.002, "gravity": 0.003, "max_speed": 0.05, "goal_position": 0.4}
HILLS |= {"min_position": -1.1, "max_position": 0.5}
SEMI_IMPLICIT = {"kinematics_integrator": "semi-implicit euler"}
PHYSICS = {
    "pole": (pole, swing_each, CART_POLE_ENV, STATE),
    "semi-implicit pole": (
        lambda: altered(pole(), **SEMI_IMPLICIT), swing_each, CART_POLE_ENV, STATE),
    "pole on the moon": (lambda: altered(pole(), **MOON), swing_each, CART_POLE_ENV, STATE),
    "car": (MountainCarEnv, drive_each, MOUNTAIN_CAR_ENV, CAR_STATE),
    "stopping car": (
        lambda: MountainCarEnv(goal_velocity=0.03), drive_each, MOUNTAIN_CAR_ENV, CAR_STATE),
    "car in hills": (
        lambda: altered(MountainCarEnv(), **HILLS), drive_each, MOUNTAIN_CAR_ENV, CAR_STATE),
}  # fmt: skip


def random_states(n):
    """States of a pole of every size: those of an episode, and far beyond them."""
    rng = np.random.default_rng(0)
    spread = np.array([2.4, 3.0, 0.21, 3.0]) * 10.0 ** rng.uniform(-6, 1, (n, 1))
    return rng.uniform(-1, 1, (n, 4)) * spread


def records_of(kind, names, states):
    records = np.zeros(len(states), dtype=kind)
    for name, column in zip(names, states.T, strict=True):
        records[name] = column
    return records


@pytest.mark.parametrize("case", PHYSICS)
def test_steps_equal_gymnasiums(case):
    make, step_each, kind, names = PHYSICS[case]
    env, rng = make(), np.random.default_rng(0)
    states = random_states(5_000)
    if kind is MOUNTAIN_CAR_ENV:
        states = rng.uniform([-1.1, -0.05], [0.5, 0.05], (5_000, 2))
        states[::5, 0] = rng.uniform(-1.1, -1.08, len(states[::5]))  # against the wall
        states[1::5, 0] = rng.uniform(0.35, 0.5, len(states[1::5]))  # before the flag
    records = records_of(kind, names, states)
    records["action"] = rng.integers(0, env.action_space.n, len(states))
    terminated, base, ended = np.empty(len(states), dtype=np.bool_), env.unwrapped, []
    expected = np.empty_like(states)
    for i, (state, action) in enumerate(zip(states, records["action"].tolist(), strict=True)):
        base.state, base.steps_beyond_terminated = state, None
        ended.append(base.step(action)[2])
        expected[i] = base.state
    step_each(records, world_of(env), terminated)
    reached = np.stack([records[name] for name in names], axis=1)
    assert reached.tobytes() == expected.tobytes()
    assert terminated.tolist() == ended
    assert 0.005 < terminated.mean() < 0.98


# --- generators ----------------------------------------------------------------------------------

KINDS = (np.random.PCG64, np.random.PCG64DXSM, np.random.MT19937, np.random.Philox)


@kernel
def draw(handles, skipped, numbers):
    for i in range(len(numbers)):
        for _ in range(skipped):
            skip_uniform(handles[0])
        numbers[i] = next_uniform(handles[0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("skipped", [0, 3])
def test_numbers_are_the_generators_own(kind, skipped):
    rng, own = (np.random.Generator(kind(7)) for _ in range(2))
    for generator in (rng, own):
        generator.integers(9, dtype=np.uint32)  # leaves half of a number behind in some of them
    numbers = np.empty(1000)
    draw(handles_of([rng]), skipped, numbers)
    assert numbers.tolist() == own.random((1000, skipped + 1))[:, -1].tolist()
    assert str(rng.bit_generator.state) == str(own.bit_generator.state)
    assert rng.integers(9, dtype=np.uint32) == own.integers(9, dtype=np.uint32)
