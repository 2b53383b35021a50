"""Models of what random play does not meet, so that no test by play could correct the search."""

import json
import random
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from rl_yardstick.envs.model_of import NotFinite, model_of
from tests.envs.test_model_of import optimum


def nothing(env: Any) -> None:
    """Nothing more to do."""


class Chain(gym.Env):
    """Fourteen steps forwards, each by one of three actions; what follows is the case's."""

    def __init__(
        self, finish: Callable[..., Any], begin: Callable[..., Any] = nothing, **held: Any
    ) -> None:
        self.action_space, self.observation_space = spaces.Discrete(3), spaces.Discrete(15)
        self.finish, self.begin = finish, begin
        vars(self).update(held)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = self.time = 0
        self.begin(self)
        return 0, {}

    def step(self, action: int) -> Any:
        self.time += 1
        reward, over = 0.0, False
        if self.x == 14:
            reward, over = self.finish(self, action)
        else:
            self.x = self.x + 1 if action == self.x % 3 else 0
        return self.x, float(reward), over, self.time >= 100, {}


def bet(draw: Callable[[], Any], action: int) -> Any:
    return (10 if draw() < 0.1 * (action + 1) else -1), True


def own_numpy(env: Any) -> None:
    env.rng = np.random.default_rng()


def own_python(env: Any) -> None:
    env.rng = random.Random()  # noqa: S311


def lights_out(env: Any) -> None:
    env.lamp[:] = 0


def parts(env: Any) -> None:
    env.cells = np.zeros(4)
    env.chest = env.cells[2:]


def lamp(env: Any, action: int) -> Any:
    """Pays for the light, which the first action puts on and the others off."""
    reward = 10 if env.lamp[0] else 1
    env.lamp[0] = action == 1
    return reward * (action == 0), action == 0


def summary(env: Any, action: int) -> Any:
    json.dumps({"steps": env.time})
    return 10, True


def whole_number(env: Any, action: int) -> Any:
    if not isinstance(env.time, int):
        raise TypeError
    return 10 if env.time // 49 == 1 and action else 2, True


def pot(env: Any, action: int) -> Any:
    """Rolls until a 6; each 5 raises the pot, so that a second roll is not as the first."""
    found = 1
    while (roll := int(env.np_random.integers(1, 7))) != 6:
        found = min(4, found + (roll == 5))
    return found, True


def band(env: Any, action: int) -> Any:
    return 5.0 if action else 100 * (0.72 < float(env.np_random.random()) < 0.73), True


FAR: dict[str, tuple[Chain, float | str]] = {
    "a generator made in reset": (Chain(lambda env, a: bet(env.rng.random, a), own_numpy), 2.3),
    "one of Python": (Chain(lambda env, a: bet(env.rng.random, a), own_python), 2.3),
    "a method of a generator": (
        Chain(lambda env, a: bet(env.draw, a), draw=np.random.default_rng(3).random),
        2.3,
    ),
    "an array set in place and back": (Chain(lamp, lights_out, lamp=np.zeros(1, int)), 10.0),
    "a number of steps for others": (Chain(summary), 10.0),
    "a whole number of steps": (Chain(whole_number), 10.0),
    "a loop that changes something": (Chain(pot), "no end after 1 seconds"),
    "a narrow band": (Chain(band), "draws a continuous number, which reaches the state"),
    "a view": (Chain(lambda env, a: (env.cells[2], True), parts), "`cells` and `chest` share"),
}


@pytest.mark.parametrize("name", FAR)
def test_behind_a_chain(name: str) -> None:
    env, known = FAR[name]
    if isinstance(known, str):
        with pytest.raises(NotFinite, match=known):
            model_of(env, seconds=1.0)
    else:
        assert optimum(model_of(env, seconds=100.0), 100) == pytest.approx(known, abs=1e-12)


class OfLength(gym.Env):
    """Each episode has its own length; or it ends by itself after 24 steps."""

    def __init__(self, lengths: tuple[int, ...], is_end: bool) -> None:
        self.action_space, self.observation_space = spaces.Discrete(2), spaces.Discrete(30)
        self.lengths, self.is_end = lengths, is_end

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.length, self.time = int(self.np_random.choice(self.lengths)), 0
        return self.length, {}

    def step(self, action: int) -> Any:
        reward = float(action == self.time % 2)
        self.time += 1
        late = self.time >= self.length
        return self.length, reward, late and self.is_end, late and not self.is_end, {}


@pytest.mark.parametrize("is_end", [False, True])
def test_the_limit_of_one_state_is_not_that_of_all(is_end: bool) -> None:
    found = model_of(OfLength((5, 10, 20), is_end), seconds=100.0)
    assert optimum(found, 1000) == pytest.approx(35 / 3, abs=1e-12)


class Rock(gym.Env):
    """Rock, paper, scissors; actions drawn from the environment's own numbers would always tie."""

    action_space, observation_space = spaces.Discrete(3), spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return 0, {}

    def step(self, action: int) -> Any:
        other = int(self.np_random.integers(3))
        return other, float((0, 1, -1)[(action - other) % 3]), other == 0, False, {}


def test_random_play_draws_numbers_of_its_own() -> None:
    assert optimum(model_of(Rock(), seconds=100.0), 10) == pytest.approx(0.0, abs=1e-12)
