"""A right environment, and copies of it with one fault each, made by changes of its source."""

import inspect
import random  # noqa: F401  # by faults
import threading  # noqa: F401
import time  # noqa: F401
from pathlib import Path
from string import Template

import gymnasium as gym
import numpy as np
import yaml
from gymnasium import spaces
from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit


class Ferry(gym.Env):
    """Crosses a windy river of 6 by 6 places, and is paid if it lands high on the other shore."""

    metadata = {}  # noqa: RUF012  # as Gymnasium's

    def __init__(self):
        self.observation_space = spaces.Box(0, 5, (2,), np.float32)
        self.action_space = spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.time = np.array([0, self.drawn(6)]), 0
        return self.seen(), {}

    def step(self, action):
        self.time += 1
        self.place[1] = np.clip(self.place[1] + action - 1 + self.drawn(3) - 1, 0, 5)
        self.place[0] = min(self.place[0] + (self.drawn(4) > 0), 5)
        done, info = bool(self.place[0] == 5), {"time": self.time}
        reward = float(done and self.place[1] > 2)
        return self.seen(), reward, done, False, info

    def drawn(self, n):
        return int(self.np_random.integers(n))

    def seen(self):
        return self.place.astype(np.float32)


class Swallowing(gym.Wrapper):
    def step(self, action):
        obs, reward, terminated, _, info = super().step(action)
        return obs, reward, terminated, False, info


def corridor(n_open):
    """A model of five places in a row, of which only the first ones can be reached."""
    ahead = [min(s + 1, n_open - 1 if s < n_open else 4) for s in range(5)]
    rows = [[(1.0, t, float(t == 4), t == 4)] for t in ahead]
    return {s: dict.fromkeys(range(3), row) for s, row in enumerate(rows)}


LOG = []
ASKED = yaml.safe_load(Path(__file__).with_suffix(".yml").read_text(encoding="utf-8"))


def maker(changes=(), wrap=lambda env: TimeLimit(env, 40)):
    """A function that makes copies of the ferry with changes of its source, in a wrapper."""
    source = inspect.getsource(Ferry)
    texts = [Template(text).substitute(ASKED["texts"]) for text in changes]
    for old, new in zip(texts[::2], texts[1::2], strict=True):
        assert old in source
        source = source.replace(old, new)
    inside = dict(globals())
    exec(source, inside)  # noqa: S102  # the source above
    return lambda: wrap(inside["Ferry"]())


WRAPPED = [
    ("wrapper-order", "statistics inside", lambda env: TimeLimit(RecordEpisodeStatistics(env), 9)),
    ("truncation-lost", "truncated swallowed", lambda env: Swallowing(TimeLimit(env, 4))),
]
PLANTED = {fault: (name, maker(changes)) for name, fault, *changes in ASKED["changes"]}
PLANTED |= {fault: (name, maker((), wrap)) for name, fault, wrap in WRAPPED}
PLANTED["no end"] = ("no-end", maker(("$DONE", "False"), lambda env: env))
RIGHT = {name: maker(changes) for name, changes in ASKED["right"].items()}
