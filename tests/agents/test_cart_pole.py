"""The compiled CartPole is Gymnasium's to the last bit, and Monitor's sums are Python's."""

import sys

import numba
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from agents.compiled.greedy_play import COMPENSATED_SUM
from agents.compiled.loop import add_to_return, begin_episode
from agents.compiled.worlds import CART_POLE_ENV, STATE, bin_index, compile_envs, swing
from envs.wrappers import DiscretizeObservation

INTEGRATORS = ("euler", "semi-implicit euler")


@numba.njit
def step_each(records, world, terminated):
    for i in range(len(records)):
        terminated[i] = swing(world, records[i])


@numba.njit
def bins_of(records, world, indices):
    for i in range(len(records)):
        indices[i] = bin_index(world, records[i])


@numba.njit
def running_sums(record, rewards, compensated, sums):
    begin_episode(record)
    for i in range(len(rewards)):
        add_to_return(record, rewards[i], compensated)
        sums[i] = record.episode_return + record.compensation


def discretized(integrator="euler", **kwargs):
    env = CartPoleEnv()
    env.kinematics_integrator = integrator
    arguments = {"bins": [3, 5, 7, 11], "low": -1.0, "high": 1.0, **kwargs}
    return DiscretizeObservation(env, **arguments)


def world_of(env):
    return compile_envs(DummyVecEnv([lambda: env]))


def random_states(n, seed=0):
    """States of every size: those of an episode, and far beyond them."""
    rng = np.random.default_rng(seed)
    spread = np.array([2.4, 3.0, 0.21, 3.0]) * 10.0 ** rng.uniform(-6, 1, (n, 1))
    return rng.uniform(-1, 1, (n, 4)) * spread, rng.integers(0, 2, n)


def compiled_steps(env, states, actions):
    records = np.zeros(len(states), dtype=CART_POLE_ENV)
    for name, column in zip(STATE, states.T, strict=True):
        records[name] = column
    records["action"] = actions
    terminated = np.empty(len(states), dtype=np.bool_)
    step_each(records, world_of(env), terminated)
    return np.stack([records[name] for name in STATE], axis=1), terminated


def numpy_steps(env, states, actions):
    """Gymnasium's expressions, in its order, on all states at once."""
    x, x_dot, theta, theta_dot = states.T
    force = np.where(actions == 1, env.force_mag, -env.force_mag)
    cos, sin = np.cos(theta), np.sin(theta)
    temp = (force + env.polemass_length * np.square(theta_dot) * sin) / env.total_mass
    theta_acc = (env.gravity * sin - cos * temp) / (
        env.length * (4.0 / 3.0 - env.masspole * np.square(cos) / env.total_mass)
    )
    x_acc = temp - env.polemass_length * theta_acc * cos / env.total_mass
    if env.kinematics_integrator == "euler":
        x, theta = x + env.tau * x_dot, theta + env.tau * theta_dot
        x_dot, theta_dot = x_dot + env.tau * x_acc, theta_dot + env.tau * theta_acc
    else:
        x_dot, theta_dot = x_dot + env.tau * x_acc, theta_dot + env.tau * theta_acc
        x, theta = x + env.tau * x_dot, theta + env.tau * theta_dot
    terminated = (np.abs(x) > env.x_threshold) | (np.abs(theta) > env.theta_threshold_radians)
    return np.stack([x, x_dot, theta, theta_dot], axis=1), terminated


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_step_equals_gymnasiums(integrator):
    states, actions = random_states(30_000)
    env = discretized(integrator)
    base = env.unwrapped
    reached, terminated = compiled_steps(env, states, actions)
    expected = np.empty_like(states)
    ended = []
    for i, (state, action) in enumerate(zip(states, actions, strict=True)):
        base.state, base.steps_beyond_terminated = state, None
        ended.append(base.step(action)[2])
        expected[i] = base.state
    assert reached.tobytes() == expected.tobytes()
    assert terminated.tolist() == ended
    assert 0.05 < terminated.mean() < 0.95


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_million_steps_equal_numpys(integrator):
    states, actions = random_states(1_000_000, seed=1)
    env = discretized(integrator)
    reached, terminated = compiled_steps(env, states, actions)
    expected, ended = numpy_steps(env.unwrapped, states, actions)
    assert reached.tobytes() == expected.tobytes()
    np.testing.assert_array_equal(terminated, ended)


def test_other_constants_are_taken_from_the_environment():
    env = discretized()
    base = env.unwrapped
    base.gravity, base.force_mag, base.tau, base.masspole = 1.62, 3.0, 0.05, 0.3
    base.total_mass, base.polemass_length, base.length = 1.3, 0.21, 0.7
    base.x_threshold, base.theta_threshold_radians = 1.0, 0.1
    states, actions = random_states(10_000)
    reached, terminated = compiled_steps(env, states, actions)
    expected, ended = numpy_steps(base, states, actions)
    assert reached.tobytes() == expected.tobytes()
    np.testing.assert_array_equal(terminated, ended)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"bins": 50, "low": [-0.41887903, -0.87266463], "high": [0.41887903, 0.87266463]},
        {"bins": [10, 3], "low": -0.1, "high": [0.3, 0.7]},
        {"bins": 1, "low": -1, "high": 1},
    ],
)
@pytest.mark.parametrize("dims", [[2, 3], [3, 2], [0, 1]])
def test_bins_equal_the_wrappers(kwargs, dims):
    env = discretized(**kwargs, dims=dims)
    world = world_of(env)
    states = np.concatenate(
        [random_states(10_000)[0], np.random.default_rng(0).uniform(-1, 1, (20_000, 4))]
    )
    cuts = zip(env.low, env.high, env.bins, strict=True)
    edges = np.concatenate([np.linspace(low, high, n + 1) for low, high, n in cuts])
    extremes = np.array([*edges, *np.nextafter(edges, 9), 0.0, -0.0, 1e30, -1e30, 5e-324])
    states = np.concatenate([states, np.repeat(extremes, 4).reshape(-1, 4)])
    records = np.zeros(len(states), dtype=CART_POLE_ENV)
    for name, column in zip(STATE, states.T, strict=True):
        records[name] = column
    indices = np.empty(len(states), dtype=np.int64)
    bins_of(records, world, indices)
    seen = states.astype(np.float32)
    assert indices.tolist() == [env.observation(state) for state in seen]
    np.testing.assert_array_equal(indices, env.map_observations(seen))
    assert len(np.unique(indices)) > 0.8 * env.observation_space.n


# --- sums ----------------------------------------------------------------------------------------

FLOATS = st.floats(-1e12, 1e12)


def compensated_sum(values):
    """Neumaier's sum, which Python's `sum` of floats is from 3.12 on."""
    total, lost = 0.0, 0.0
    for value in values:
        new_total = total + value
        if abs(total) >= abs(value):
            lost += (total - new_total) + value
        else:
            lost += (value - new_total) + total
        total = new_total
    return total + lost if lost else total


def plain_sum(values):
    return float(np.add.accumulate([0.0, *values])[-1])


@pytest.mark.parametrize(("compensated", "add_up"), [(True, compensated_sum), (False, plain_sum)])
@given(values=st.lists(FLOATS, max_size=40))
def test_sums_by_either_rule(compensated, add_up, values):
    sums = np.empty(len(values))
    running_sums(np.zeros(1, dtype=CART_POLE_ENV)[0], np.array(values), compensated, sums)
    assert sums.tolist() == [add_up(values[: i + 1]) for i in range(len(values))]


@given(st.lists(FLOATS, max_size=40))
def test_sums_as_this_python_does(values):
    sums = np.empty(len(values))
    running_sums(np.zeros(1, dtype=CART_POLE_ENV)[0], np.array(values), COMPENSATED_SUM, sums)
    assert sums.tolist() == [sum(values[: i + 1]) for i in range(len(values))]


def test_the_rules_differ():
    assert compensated_sum([0.1] * 10) == 1.0
    assert plain_sum([0.1] * 10) == 0.9999999999999999
    assert (sum([0.1] * 10) == 1.0) == COMPENSATED_SUM == (sys.version_info >= (3, 12))
