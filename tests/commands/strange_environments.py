"""Environments of others, each with one fault."""

import os
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Line(gym.Env):
    """Five places in a row, without a fault: action 1 goes on, the last place ends the episode."""

    observation_space, action_space = spaces.Discrete(5), spaces.Discrete(2)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.steps = 0
        return self.seen(), {}

    def step(self, action):
        self.place, self.steps = min(self.place + int(action), 4), self.steps + 1
        return self.seen(), -1.0, self.place == 4, self.steps >= 30, {}

    def seen(self):
        return self.place


class Unseeded(Line):
    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, float(np.random.default_rng().random()), *rest


class EpisodeInfo(Line):
    def step(self, action):
        *rest, _ = super().step(action)
        return *rest, {"episode": 3}


class FourValues(Line):
    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or truncated, info


class NoSeed(Line):
    def reset(self):
        return super().reset()


class Leaves(Line):
    def step(self, action):
        return os._exit(0) if self.steps == 20 else super().step(action)


class RudeError(Exception):
    def __str__(self):
        raise RuntimeError("no words")


class Rude(Line):
    def step(self, action):
        if self.spec is not None and Path("now").exists():
            raise RudeError
        return super().step(action)


class Known(Line):
    """With a model, and without a word on where it starts."""

    P = {s: {a: [(1.0, min(s + a, 4), -1.0, s + a >= 4)] for a in (0, 1)} for s in range(5)}  # noqa: RUF012


class GridWorld(Line):
    """As in Gymnasium's tutorial, without a fault: both places are drawn, and both are seen."""

    place, action_space = spaces.Box(0, 4, (2,), dtype=int), spaces.Discrete(4)
    observation_space = spaces.Dict({"agent": place, "target": place})

    def reset(self, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        drawn = self.np_random.choice(25, 2, replace=False)
        self.agent, self.target = (np.array(divmod(one, 5)) for one in drawn)
        return self.seen(), {}

    def step(self, action):
        self.agent = np.clip(self.agent + ([1, 0], [0, 1], [-1, 0], [0, -1])[action], 0, 4)
        arrived = np.array_equal(self.agent, self.target)
        return self.seen(), int(arrived), arrived, False, {}

    def seen(self):
        return {"agent": self.agent.copy(), "target": self.target.copy()}


NUMBERS, VECTORS = Line.observation_space, spaces.Box(0, 4, (2,), np.float32)
PAIR = spaces.Discrete(5), spaces.Discrete(2)
# The space of observations, and what is seen at a place.
SEEN = {
    "Half": (NUMBERS, lambda place: place + 0.5),
    "Seven": (NUMBERS, lambda place: 7 if place else 0),
    "Vector": (VECTORS, lambda place: np.full(2, place, np.float32)),
    "OtherShape": (VECTORS, lambda place: np.full(3 if place else 2, place, np.float32)),
    "OtherType": (VECTORS, lambda place: np.full(2, place, np.float64)),
    "FromOne": (spaces.Discrete(5, start=1), lambda place: place + 1),
    "Pair": (spaces.Tuple(PAIR), lambda place: (place, 0)),
    "Many": (spaces.MultiDiscrete([5, 2]), lambda place: np.array([place, 0])),
    "Named": (spaces.Dict(at=PAIR[0], on=PAIR[1]), lambda place: {"at": place, "on": 0}),
    "Huge": (spaces.Discrete(10**9), lambda place: place),
}
for name, (space, look) in SEEN.items():
    members = {"observation_space": space, "seen": lambda self, look=look: look(self.place)}
    gym.register(f"{name}-v0", type(name, (Line,), members))
for kind in (Line, *Line.__subclasses__()):
    if f"{kind.__name__}-v0" not in gym.registry:
        gym.register(f"{kind.__name__}-v0", kind)
