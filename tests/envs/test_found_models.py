"""Models found in the code of environments: in wrappers, under limits, and kept on disk."""

from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import rl_yardstick as ys
from rl_yardstick.envs import found_models
from rl_yardstick.envs import known_models as known
from rl_yardstick.mdp import finite_horizon_optimum, policy_return


@pytest.fixture(autouse=True)
def nothing_is_known(monkeypatch, tmp_path):
    """Each test begins without models, and with the usual limits."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(found_models, "_of_name", {})
    found_models.limit("auto")
    yield
    found_models.limit("auto")


class Walk(gym.Env):
    """Cells 0 to ``n - 1``; each step costs 1 and moves by one, or is repeated by chance."""

    def __init__(self, n=5, slip=0.25, limit=None, walls=False, render_mode=None):
        self.n, self.slip, self.limit, self.walls = n, slip, limit, walls
        self.observation_space = spaces.Box(0, n, (1,), np.float32)
        self.action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell, self.time = 0, 0
        return self.observe(), {}

    def step(self, action):
        if self.walls and action == 0 and self.cell == 0:
            raise ValueError("a wall")
        moves = 2 if self.np_random.random() < self.slip else 1
        self.cell = min(max(self.cell + moves * (2 * int(action) - 1), 0), self.n - 1)
        self.time += 1
        is_over = self.limit is not None and self.time >= self.limit
        return self.observe(), -1.0, self.cell == self.n - 1, is_over, {}

    def observe(self):
        return np.array([self.cell], np.float32)


class Doubled(gym.RewardWrapper):
    def reward(self, reward):
        return 2 * reward


class LateFee(gym.Wrapper):
    """The step that runs out of time costs 10 more."""

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward - 10 * truncated, terminated, truncated, info


gym.register("Paces-v0", entry_point=Walk, max_episode_steps=30)


def by_hand(n=5, slip=0.25, steps=30, fee=0.0):
    """The return of always going right, by backward induction written out."""
    values = [fee] * n
    for _ in range(steps):
        near, far = ([values[min(s + k, n - 1)] for s in range(n - 1)] for k in (1, 2))
        values = [-1 + (1 - slip) * a + slip * b for a, b in zip(near, far, strict=True)] + [0.0]
    return values[0]


WORLDS = {
    "a time limit around": (lambda: gym.make("Paces-v0"), by_hand()),
    "its own time": (lambda: Walk(limit=4), by_hand(steps=4)),
    "the shorter of both": (lambda: gym.make("Paces-v0", limit=4), by_hand(steps=4)),
    "a known wrapper": (lambda: gym.wrappers.ClipReward(gym.make("Paces-v0"), -0.5, 1),
        by_hand() / 2),
    "an unknown wrapper": (lambda: Doubled(gym.make("Paces-v0")), 2 * by_hand()),
    "a wrapper that sees the end of time": (
        lambda: LateFee(gym.make("Paces-v0", max_episode_steps=4)), by_hand(steps=4, fee=-10.0)),
    "an unknown wrapper of a published model": (lambda: Doubled(gym.make("FrozenLake-v1")),
        2 * 0.7441903),
    "an action that raises": (lambda: gym.make("Paces-v0", walls=True), by_hand()),
}  # fmt: skip


@pytest.mark.parametrize("name", WORLDS)
def test_the_optimum_is_that_of_the_environment_in_its_wrappers(name):
    make, best = WORLDS[name]
    env = make()
    plan = finite_horizon_optimum(known.transition_model(env), known.time_limit(env))
    assert plan.start_value == pytest.approx(best, abs=1e-7)


def test_an_action_that_raises_is_masked_and_never_better():
    env = gym.make("Paces-v0", walls=True)
    model, masks = known.transition_model(env), known.action_masks_of_states(env)
    assert masks.sum() == masks.size - 1
    stays = policy_return(model, np.zeros(model.n_states, np.int64), 30)
    assert stays.expected_return <= by_hand() + 1e-9


def forget():
    found_models._of_name.clear()


def test_a_search_is_kept_for_the_same_code_and_arguments(monkeypatch, tmp_path):
    search = Mock(wraps=found_models.model_of)
    monkeypatch.setattr(found_models, "model_of", search)
    first = ys.optimum("Paces-v0")
    forget()
    assert ys.optimum("Paces-v0")["optimum"] == first["optimum"]
    assert search.call_count == 1
    forget()
    assert ys.optimum("Paces-v0", slip=0.5)["optimum"] == pytest.approx(by_hand(slip=0.5))
    assert search.call_count == 2
    for file in (tmp_path / "yardstick" / "models").iterdir():
        file.write_bytes(b"broken")
    forget()
    assert ys.optimum("Paces-v0")["optimum"] == first["optimum"]
    assert search.call_count == 3


def test_other_code_of_the_same_name_is_searched_anew(monkeypatch, tmp_path):
    program = tmp_path / "world" / "walk.py"
    program.parent.mkdir()
    monkeypatch.syspath_prepend(str(program.parent))
    text = "from tests.envs.test_found_models import Walk\nclass Mine(Walk):\n    fee = {fee}\n"
    text += "    def step(self, action):\n        seen, _, *rest = super().step(action)\n"
    text += "        return seen, self.fee if self.cell == 4 else 0.0, *rest\n"
    for fee in (3.0, 7.0):
        program.write_text(text.format(fee=fee))
        gym.register("Mine-v0", entry_point="walk:Mine", max_episode_steps=30)
        assert ys.optimum("Mine-v0")["optimum"] == pytest.approx(fee)
        gym.registry.pop("Mine-v0")
        monkeypatch.delitem(__import__("sys").modules, "walk")
        forget()


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("none", "the model of Paces-v0 is not known$"),
        ("3", "more than 3 states.*; --model 30 to continue$"),
    ],
)
def test_limits(kind, words):
    found_models.limit(kind)
    with pytest.raises(ys.UserError, match=words):
        ys.optimum("Paces-v0")


def test_a_run_is_judged_exactly():
    settings = {"n_timesteps": 64, "n_steps": 32, "batch_size": 32, "seed": 0, "folder": None}
    run = ys.train("Paces-v0", "ppo", **settings)
    assert run.result["optimum"] == pytest.approx(by_hand())
    assert "optimum" not in ys.train("Paces-v0", "ppo", model="none", **settings).result
