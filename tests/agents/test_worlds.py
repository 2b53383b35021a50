"""Compiled environments are Gymnasium's to the last bit, as they are now, or are refused."""

import operator
from functools import partial, reduce

import numba
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv, MountainCarEnv
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from rl_yardstick.agents.compiled import worlds
from rl_yardstick.agents.compiled.env_states import COMPENSATED_SUM
from rl_yardstick.agents.compiled.loop import add_to_return, begin_episode, step
from rl_yardstick.agents.compiled.references import handles_of, next_uniform
from rl_yardstick.envs.wrappers import DiscretizeObservation
from rl_yardstick.machine_code.compiling import kernel


@numba.njit
def step_each(records, world, terminated):
    for i in range(len(records)):
        step(world, records[i], 0)
        terminated[i] = records[i].terminated


@numba.njit
def bins_of(records, world, indices):
    for i in range(len(records)):
        indices[i] = worlds.bin_index(world, records[i])


def world_of(env):
    return worlds.compile_envs(DummyVecEnv([lambda: env]))


def pole(**kwargs):
    settings = {"bins": [3, 5, 7, 11], "low": -1.0, "high": 1.0, **kwargs}
    return DiscretizeObservation(CartPoleEnv(), **settings)


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
    "pole": pole,
    "semi-implicit pole": lambda: altered(pole(), **SEMI_IMPLICIT),
    "pole on the moon": lambda: altered(pole(), **MOON),
    "car": MountainCarEnv,
    "stopping car": lambda: MountainCarEnv(goal_velocity=0.03),
    "car in hills": lambda: altered(MountainCarEnv(), **HILLS),
}


def random_states(n):
    """States of a pole of every size: those of an episode, and far beyond them."""
    rng = np.random.default_rng(0)
    spread = np.array([2.4, 3.0, 0.21, 3.0]) * 10.0 ** rng.uniform(-6, 1, (n, 1))
    return rng.uniform(-1, 1, (n, 4)) * spread


def records_of(names, states):
    kind = worlds.env_dtype(*((name, np.float64) for name in names))
    records = np.zeros(len(states), dtype=kind)
    for name, column in zip(names, states.T, strict=True):
        records[name] = column
    return records


@pytest.mark.parametrize("case", PHYSICS)
def test_steps_equal_gymnasiums(case):
    env, rng = PHYSICS[case](), np.random.default_rng(0)
    names, states = worlds.STATE, random_states(20_000)
    if "car" in case:
        names = worlds.CAR_STATE
        states = rng.uniform([-1.1, -0.05], [0.5, 0.05], (20_000, 2))
        states[::5, 0] = rng.uniform(-1.1, -1.08, len(states[::5]))  # against the wall
        states[1::5, 0] = rng.uniform(0.35, 0.5, len(states[1::5]))  # before the flag
    records = records_of(names, states)
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


BINNED = [
    {"bins": 50, "low": [-0.41887903, -0.87266463], "high": [0.41887903, 0.87266463]},
    {"bins": [10, 3], "low": -0.1, "high": [0.3, 0.7]},
    {"bins": 1, "low": -1, "high": 1},
]


@pytest.mark.parametrize("dims", [[2, 3], [3, 0]])
@pytest.mark.parametrize("kwargs", BINNED)
def test_bins_equal_the_wrappers(kwargs, dims):
    env = pole(**kwargs, dims=dims)
    uniform = np.random.default_rng(0).uniform(-1, 1, (20_000, 4))
    cuts = zip(env.low, env.high, env.bins, strict=True)
    edges = np.concatenate([np.linspace(low, high, n + 1) for low, high, n in cuts])
    extremes = np.array([*edges, *np.nextafter(edges, 9), 0.0, -0.0, 1e30, -1e30, 5e-324])
    extremes = np.repeat(extremes, 4).reshape(-1, 4)
    states = np.concatenate([random_states(10_000), uniform, extremes])
    indices = np.empty(len(states), dtype=np.int64)
    bins_of(records_of(worlds.STATE, states), world_of(env), indices)
    seen = states.astype(np.float32)
    assert indices.tolist() == [env.observation(state) for state in seen]
    np.testing.assert_array_equal(indices, env.map_observations(seen))
    assert len(np.unique(indices)) > 0.8 * env.observation_space.n


@numba.njit
def running_sums(record, rewards, compensated, sums):
    begin_episode(record)
    for i in range(len(rewards)):
        add_to_return(record, rewards[i], compensated)
        sums[i] = record.episode_return + record.compensation


def compensated_sum(values):
    """Neumaier's sum, which Python's `sum` of floats is from 3.12 on."""
    total, lost = 0.0, 0.0
    for value in values:
        smaller, larger = sorted((total, value), key=abs)
        total += value
        lost += (larger - total) + smaller
    return total + lost if lost else total


plain = partial(reduce, operator.add)


@given(values=st.lists(st.floats(-1e12, 1e12), max_size=40))
def test_sums_by_either_rule_and_as_this_python_does(values):
    for compensated, add_up in ((True, compensated_sum), (False, plain), (COMPENSATED_SUM, sum)):
        sums, record = np.empty(len(values)), np.zeros(1, dtype=worlds.ENV)[0]
        running_sums(record, np.array(values), compensated, sums)
        assert sums.tolist() == [add_up(values[: i + 1]) for i in range(len(values))]


@kernel
def draw(handles, numbers):
    for i in range(len(numbers)):
        numbers[i] = next_uniform(handles[0])


@pytest.mark.parametrize("kind", ["PCG64", "PCG64DXSM", "MT19937", "Philox"])
def test_numbers_are_the_generators_own(kind):
    rng, own = (np.random.Generator(getattr(np.random, kind)(7)) for _ in range(2))
    for generator in (rng, own):
        generator.integers(9, dtype=np.uint32)  # leaves half of a number behind in some of them
    numbers = np.empty(1000)
    draw(handles_of([rng]), numbers)
    assert numbers.tolist() == own.random(1000).tolist()
    assert str(rng.bit_generator.state) == str(own.bit_generator.state)
    assert rng.integers(9, dtype=np.uint32) == own.integers(9, dtype=np.uint32)
