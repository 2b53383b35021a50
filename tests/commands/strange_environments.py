"""Environments of others, each with one fault: what commands say of them is in a table."""

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


class ObsOnly(Line):
    def reset(self, seed=None, options=None):
        return super().reset(seed=seed)[0]


class Half(Line):
    def seen(self):
        return self.place + 0.5


class Seven(Line):
    def seen(self):
        return 7 if self.place else 0


class Vector(Line):
    observation_space = spaces.Box(0, 4, (2,), np.float32)

    def seen(self):
        return np.full(2, self.place, np.float32)


class OtherShape(Vector):
    def seen(self):
        return np.full(3 if self.place else 2, self.place, np.float32)


class OtherType(Vector):
    def seen(self):
        return np.full(2, self.place, np.float64)


class OutOfBounds(Vector):
    def seen(self):
        return np.full(2, 2 * self.place, np.float32)


class FromOne(Line):
    observation_space = spaces.Discrete(5, start=1)

    def seen(self):
        return self.place + 1


class Pair(Line):
    observation_space = spaces.Tuple((spaces.Discrete(5), spaces.Discrete(2)))

    def seen(self):
        return self.place, 0


class Many(Pair):
    observation_space = spaces.MultiDiscrete([5, 2])

    def seen(self):
        return np.array([self.place, 0])


class Named(Pair):
    observation_space = spaces.Dict(place=spaces.Discrete(5), lamp=spaces.Discrete(2))

    def seen(self):
        return {"place": self.place, "lamp": 0}


class Huge(Line):
    observation_space = spaces.Discrete(10**9)


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
    """With a model, which is wrong in one way."""

    def __init__(self, fault):
        outcomes = {}
        for s in range(5):
            ends = [(min(s + a, 4), -1.0, s + a >= 4) for a in range(2)]
            outcomes[s] = {a: [(1.0, *end)] for a, end in enumerate(ends)}
            if fault == "triples":
                outcomes[s] = {a: [end] for a, end in enumerate(ends)}
            elif fault == "single":
                third = np.float32(1) / 3
                outcomes[s] = {a: [(third, *end)] * 3 for a, end in enumerate(ends)}
        self.P = {(s, 0): outcomes[s] for s in outcomes} if fault == "keys" else outcomes
        if fault != "start":
            self.initial_state_distrib = np.eye(5)[0]


for kind in [*globals().values()]:
    if isinstance(kind, type) and issubclass(kind, Line):
        gym.register(f"{kind.__name__}-v0", kind)
