"""The compiled MountainCar is Gymnasium's to the last bit."""

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.envs.classic_control import MountainCarEnv
from gymnasium.wrappers import TimeAwareObservation
from stable_baselines3.common.vec_env import DummyVecEnv

from agents.compiled.worlds import CAR_STATE, MOUNTAIN_CAR_ENV, NotCompilable, compile_envs, drive


@numba.njit
def drive_each(records, world, terminated):
    for i in range(len(records)):
        terminated[i] = drive(world, records[i])


def compiled_steps(env, states, actions):
    records = np.zeros(len(states), dtype=MOUNTAIN_CAR_ENV)
    records["position"], records["velocity"] = states.T
    records["action"] = actions
    terminated = np.empty(len(states), dtype=np.bool_)
    drive_each(records, compile_envs(DummyVecEnv([lambda: env])), terminated)
    return np.stack([records[name] for name in CAR_STATE], axis=1), terminated


@pytest.mark.parametrize("goal_velocity", [0, 0.03])
def test_step_equals_gymnasiums(goal_velocity):
    rng = np.random.default_rng(0)
    env = MountainCarEnv(goal_velocity=goal_velocity)
    states = rng.uniform([-1.2, -0.07], [0.6, 0.07], (20_000, 2))
    states[::5, 0] = rng.uniform(-1.2, -1.13, len(states[::5]))  # against the wall
    states[1::5, 0] = rng.uniform(0.45, 0.5, len(states[1::5]))  # before the flag
    actions = rng.integers(0, 3, len(states))
    reached, terminated = compiled_steps(env, states, actions)
    expected, ended = np.empty_like(states), []
    for i, (state, action) in enumerate(zip(states, actions, strict=True)):
        env.state = state
        ended.append(env.step(action)[2])
        expected[i] = env.state
    assert reached.tobytes() == expected.tobytes()
    assert terminated.tolist() == ended
    assert 0.02 < terminated.mean() < 0.3
    assert (reached[:, 0] == -1.2).any()


def test_other_constants_are_taken_from_the_environment():
    env = MountainCarEnv()
    env.force, env.gravity, env.max_speed, env.goal_position = 0.002, 0.003, 0.05, 0.4
    env.min_position, env.max_position = -1.1, 0.5
    states = np.random.default_rng(1).uniform([-1.1, -0.05], [0.5, 0.05], (2_000, 2))
    reached, terminated = compiled_steps(env, states, np.full(len(states), 2))
    for state, found, ended in zip(states, reached, terminated, strict=True):
        env.state = state
        assert env.step(2)[2] == ended
        assert tuple(env.state) == tuple(found)


def test_a_wrapper_that_changes_what_is_seen_is_refused():
    env = TimeAwareObservation(gym.make("MountainCar-v0"))
    with pytest.raises(NotCompilable, match="MountainCar compiles as it is, under Monitor alone"):
        compile_envs(DummyVecEnv([lambda: env]))


def test_a_class_of_ones_own_is_refused():
    class Steeper(MountainCarEnv):
        pass

    with pytest.raises(NotCompilable, match="MountainCar compiles as it is"):
        compile_envs(DummyVecEnv([Steeper]))
