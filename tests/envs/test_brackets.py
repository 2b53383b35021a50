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
ENTRIES = {entry["id"]: entry for limits in known_entries().values() for entry in limits.values()}


@pytest.mark.parametrize("name", ENTRIES)
def test_a_bracket_is_claimed_of_an_environment_as_it_is(name):
    entry = ENTRIES[name]
    low, high, base = entry["lower"], entry["upper"], entry["baseline"]["mean"]
    with gym.make(name) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())  # it may have been played before
        assert optimum_bracket(env) == OptimumBracket(low, high, base)
    assert may_have_bracket(name)
    assert base < low < entry["played"]["mean"] <= high
    apart = (high - low) / (low - base)
    assert apart < (0.06 if name == "Acrobot-v1" else 0.03)
    line = f"| `{name}` | {low:.2f} | {high:.2f} | {100 * apart:.1f} % | {base:.1f} |\n"
    assert line in DOCUMENT.read_text()


def test_these_have_brackets():
    names = ["Acrobot-v1", "CartPole-v1", "MountainCar-v0", "MountainCarContinuous-v0"]
    assert sorted(ENTRIES) == [*names, "Pendulum-v1"]


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


def changed(env_id, **attributes):
    env = gym.make(env_id)
    vars(env.unwrapped).update(attributes)
    return env


def own_wrapper_step():
    env = gym.make("MountainCar-v0")
    env.step = lambda action: env.env.step(2)
    return env


ONE = np.ones(1, np.float32)
OTHERS = {
    "gravity": lambda: gym.make("Pendulum-v1", g=5.0),
    "goal": lambda: gym.make("MountainCar-v0", goal_velocity=0.1),
    "rewards": lambda: gym.make("CartPole-v1", sutton_barto_reward=True),
    "limit": lambda: gym.make("CartPole-v1", max_episode_steps=400),
    "no limit": lambda: gym.make("CartPole-v1", max_episode_steps=-1),
    "two limits": lambda: TimeLimit(gym.make("CartPole-v1"), 300),
    "attribute": lambda: changed("CartPole-v1", gravity=5.0),
    "own step": lambda: changed("MountainCar-v0", step=MountainCarEnv().step),
    "own dynamics": lambda: changed("Acrobot-v1", _dsdt=lambda state: (0.0,) * 5),
    "own step of a wrapper": own_wrapper_step,
    "own class": lambda: TimeLimit(MyPendulum(), 200),
    "scaled rewards": lambda: ScaleReward(gym.make("CartPole-v1"), 2.0),
    "clipped rewards": lambda: ClipReward(gym.make("MountainCar-v0"), 0, 1),
    "other actions": lambda: RescaleAction(gym.make("Pendulum-v1"), ONE - 2, ONE),
    "frame skip": lambda: Repeat(gym.make("CartPole-v1")),
    "no bracket": lambda: gym.make("FrozenLake-v1"),
}


@pytest.mark.parametrize("what", OTHERS)
def test_none_is_claimed_of_anything_else(what):
    with OTHERS[what]() as env:
        assert optimum_bracket(env) is None


def test_constants_of_a_class_count(monkeypatch):
    # A user may have changed the library's class.
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
