"""Brackets of optima: claimed for what they were worked out for alone."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import CartPoleEnv, MountainCarEnv, PendulumEnv
from gymnasium.wrappers import ClipReward, FlattenObservation, RescaleAction, TimeLimit

import train
from envs.brackets import OptimumBracket, known_entries, may_have_bracket, optimum_bracket
from envs.wrappers import DiscretizeObservation, ScaleReward

DOCUMENT = Path(train.__file__).parent / "docs" / "continuous.md"
ENTRIES = {
    name: entry
    for limits in known_entries().values()
    for entry in limits.values()
    for name in [entry["id"]]
}


@pytest.mark.parametrize("name", ENTRIES)
def test_a_bracket_is_claimed_of_an_environment_as_it_is(name):
    with gym.make(name) as env:
        found, entry = optimum_bracket(env), ENTRIES[name]
    assert found == OptimumBracket(entry["lower"], entry["upper"], entry["baseline"]["mean"])
    assert found.baseline < found.lower < found.upper
    assert found.lower < entry["played"]["mean"] <= found.upper
    assert may_have_bracket(name)


def test_ends_are_near_to_each_other():
    """By the distance from the baseline to the lower end, which scores go by."""
    widths = {
        name: (entry["upper"] - entry["lower"]) / (entry["lower"] - entry["baseline"]["mean"])
        for name, entry in ENTRIES.items()
    }
    assert set(widths) == {
        "Acrobot-v1",
        "CartPole-v1",
        "MountainCar-v0",
        "MountainCarContinuous-v0",
        "Pendulum-v1",
    }
    assert widths.pop("Acrobot-v1") < 0.06
    assert max(widths.values()) < 0.03


ONE = np.ones(1, np.float32)


def test_the_document_says_what_is_stored():
    text = DOCUMENT.read_text()
    for name, entry in ENTRIES.items():
        low, high, base = entry["lower"], entry["upper"], entry["baseline"]["mean"]
        apart = 100 * (high - low) / (low - base)
        assert f"| `{name}` | {low:.2f} | {high:.2f} | {apart:.1f} % | {base:.1f} |\n" in text


class MyPendulum(PendulumEnv):
    """Of the same name, and easier."""

    def step(self, u):
        obs, reward, *rest = super().step(u)
        return obs, reward / 2, *rest


class Repeat(gym.Wrapper):
    """Does everything twice."""

    def step(self, action):
        self.env.step(action)
        return self.env.step(action)


def _with_gravity(env):
    env.unwrapped.gravity = 5.0
    return env


def _with_own_dynamics(env):
    env.unwrapped._dsdt = lambda state: (0.0,) * 5
    return env


def _with_own_wrapper_step(env):
    env.step = lambda action: env.env.step(2)
    return env


def _with_own_step(env):
    env.unwrapped.step = lambda action: MountainCarEnv.step(env.unwrapped, 2)
    return env


@pytest.mark.parametrize(
    "make",
    {
        "gravity": lambda: gym.make("Pendulum-v1", g=5.0),
        "goal": lambda: gym.make("MountainCar-v0", goal_velocity=0.1),
        "rewards": lambda: gym.make("CartPole-v1", sutton_barto_reward=True),
        "limit": lambda: gym.make("CartPole-v1", max_episode_steps=400),
        "no limit": lambda: gym.make("CartPole-v1", max_episode_steps=-1),
        "two limits": lambda: TimeLimit(gym.make("CartPole-v1"), 300),
        "attribute": lambda: _with_gravity(gym.make("CartPole-v1")),
        "own step": lambda: _with_own_step(gym.make("MountainCar-v0")),
        "own dynamics": lambda: _with_own_dynamics(gym.make("Acrobot-v1")),
        "own step of a wrapper": lambda: _with_own_wrapper_step(gym.make("MountainCar-v0")),
        "own class": lambda: TimeLimit(MyPendulum(), 200),
        "scaled rewards": lambda: ScaleReward(gym.make("CartPole-v1"), 2.0),
        "clipped rewards": lambda: ClipReward(gym.make("MountainCar-v0"), 0, 1),
        "other actions": lambda: RescaleAction(gym.make("Pendulum-v1"), ONE - 2, ONE),
        "frame skip": lambda: Repeat(gym.make("CartPole-v1")),
        "no bracket": lambda: gym.make("FrozenLake-v1"),
    }.items(),
    ids=lambda item: item[0] if isinstance(item, tuple) else None,
)
def test_none_is_claimed_of_anything_else(make):
    with make[1]() as env:
        assert optimum_bracket(env) is None


def test_constants_of_a_class_count(monkeypatch):
    monkeypatch.setattr("gymnasium.envs.classic_control.AcrobotEnv.LINK_MASS_1", 0.5)
    assert optimum_bracket(gym.make("Acrobot-v1")) is None


def test_an_environment_of_ones_own_under_a_known_name_has_none():
    former = gym.registry["Pendulum-v1"]
    try:
        with pytest.warns(UserWarning, match="Overriding"):
            gym.register("Pendulum-v1", entry_point=MyPendulum, max_episode_steps=200)
        assert not may_have_bracket("Pendulum-v1")
        assert optimum_bracket(gym.make("Pendulum-v1")) is None
    finally:
        gym.registry["Pendulum-v1"] = former


def test_what_is_shown_makes_no_difference():
    seen = DiscretizeObservation(gym.make("CartPole-v1"), bins=4, dims=[0, 2])
    assert optimum_bracket(seen) == optimum_bracket(gym.make("CartPole-v1")) is not None
    assert optimum_bracket(FlattenObservation(gym.make("Pendulum-v1"))) is not None
    assert optimum_bracket(TimeLimit(CartPoleEnv(), 500)) is not None


def test_it_may_have_been_played_before():
    env = gym.make("MountainCar-v0")
    env.reset(seed=0)
    env.step(2)
    assert optimum_bracket(env) is not None
