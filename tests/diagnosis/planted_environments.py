"""A right environment, and copies of it with one fault each, made by changes of its source."""

import inspect
import random  # noqa: F401  # by faults
import threading  # noqa: F401
import time  # noqa: F401

import gymnasium as gym
import numpy as np
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
    return {
        s: {a: [(1.0, t, float(t == 4), t == 4)] for a in range(3)} for s, t in enumerate(ahead)
    }


LOG = []
# Texts in the source of the ferry.
SPACE, ACTIONS, SEEDED = "spaces.Box(0, 5, (2,), np.float32)", "spaces.Discrete(3)", "(seed=seed)"
DRAW, SEEN = "self.np_random.integers(n)", "self.place.astype(np.float32)"
DONE, PAY, INFO = (
    "bool(self.place[0] == 5)",
    "float(done and self.place[1] > 2)",
    '"time": self.time',
)
TIME = "self.time += 1"
STARTS = "self.initial_state_distrib = np.eye(5)[0]"
OWN = f"{ACTIONS}; self.own = np.random.default_rng"
KEY = "spaces.Dict(at=spaces.Discrete(6))"
FROM_TWO = "spaces.Dict(at=spaces.Discrete(6, start=2))"
LOGGED = "(self, n, log=[]):\n        log.append(n); n -= len(log) % 5 == 0\n"
CLEARING = "(seed=seed); LOG.clear()"
TREASURE = (TIME, f"{TIME}; self.found |= self.time > 4", ACTIONS, f"{ACTIONS}; self.found = False")
ARRAY = (ACTIONS, f"{ACTIONS}; self.array = np.zeros(2, np.float32)")
# What has to be found; the fault; texts in the source, each with another one in its place.
CHANGES = [
    ("seed", "numpy's generator", DRAW, "np.random.randint(n)"),
    ("seed", "Python's generator", DRAW, "random.randrange(n)"),
    ("seed", "the time of day", DRAW, "time.perf_counter_ns() // 64 % n"),
    ("seed", "a generator of its own", DRAW, "self.own.integers(n)", ACTIONS, f"{OWN}()"),
    (
        "state-survives-reset",
        "a seed of its own",
        DRAW,
        "self.own.integers(n)",
        ACTIONS,
        f"{OWN}(3)",
    ),
    ("global-generator", "numpy is seeded", SEEDED, "(seed=seed); np.random.seed(seed)"),
    ("reset-repeats", "the same seed again", SEEDED, "(seed=seed or 5)"),
    ("shared-state", "a global list", PAY, "LOG.append(1) or float(len(LOG))"),
    (
        "shared-state",
        "a dict in the class",
        PAY,
        "self.metadata.update({len(self.metadata): 1}) or len(self.metadata)",
    ),
    ("shared-state", "a default argument", "(self, n):\n", LOGGED),
    ("shared-state", "a cleared list", PAY, "LOG.append(1) or len(LOG)", SEEDED, CLEARING),
    ("state-survives-reset", "a treasure stays found", *TREASURE, PAY, "float(self.found)"),
    ("observation-in-place", "the place", SEEN, "self.place", "np.float32", "np.int64"),
    (
        "observation-in-place",
        "one array",
        SEEN,
        "np.copyto(self.array, self.place) or self.array",
        *ARRAY,
    ),
    ("observation-out-of-bounds", "too far", SEEN, f"2 * {SEEN}"),
    ("observation-not-in-space", "another shape", SEEN, "np.zeros(3 - (self.time < 4), 'f4')"),
    ("observation-not-in-space", "too large", SEEN, "self.place[0]", SPACE, "spaces.Discrete(5)"),
    ("observation-not-in-space", "no key", SEEN, "{'at': 0} if self.time < 3 else {}", SPACE, KEY),
    ("observation-dtype", "double precision", SEEN, "self.place * 1.0"),
    ("observation-dtype", "a list", SEEN, "[float(x) for x in self.place]"),
    ("observation-nan", "nan", SEEN, "np.array([np.nan if self.time == 3 else 1, 1], 'f4')"),
    ("reward-nan", "nan as reward", PAY, "np.nan if self.time == 3 else 0.0"),
    ("reward-nan", "infinity as reward", PAY, "np.inf if self.time > 4 else 0.0"),
    ("outcome-type", "a reward in an array", PAY, "np.ones(1)"),
    ("outcome-type", "no reward", PAY, "None"),
    ("reward-huge", "a million", PAY, "1e6 * done"),
    ("reward-never", "never a reward", PAY, "0.0"),
    ("info-episode", "info['episode']", INFO, "'episode': self.time"),
    ("info-key", "the last observation", INFO, "'terminal_observation': self.seen()"),
    ("info-key", "always a time limit", INFO, "'TimeLimit.truncated': True"),
    ("outcome-type", "no info", f"{{{INFO}}}", "None"),
    ("outcome-type", "an end that is a number", DONE, "int(self.place[0] == 5)"),
    (
        "space-start",
        "actions from 1",
        ACTIONS,
        "spaces.Discrete(3, start=1)",
        "action - 1",
        "action",
    ),
    ("space-start", "a part from 2", SPACE, FROM_TWO, SEEN, "{'at': self.place[0] + 2}"),
    (
        "space-changed",
        "a space that grows",
        SEEDED,
        f"{SEEDED}; self.observation_space = spaces.Box(0, 9, (2,))",
    ),
    ("space-remade", "a new space", SEEDED, f"{SEEDED}; self.action_space = {ACTIONS}"),
    ("no-space", "no action space", ACTIONS, "3"),
    ("old-api", "reset without a seed", "(self, *, seed=None, options=None)", "(self, seed=None)"),
    ("old-api", "four things from step", "done, False, info", "done, info"),
    ("limit-as-terminated", "a limit as an end", DONE, "self.time >= 20"),
    ("step-after-end", "life after an end", DONE, "self.time % 7 == 6", PAY, "1.0"),
    ("goal-unreachable", "a wall", ACTIONS, f"{ACTIONS}; self.P = corridor(3); {STARTS}"),
    ("not-copyable", "a lock", ACTIONS, f"{ACTIONS}; self.lock = threading.Lock()"),
    ("slow", "a slow step", TIME, f"{TIME}; time.sleep(0.005)"),
    ("crash", "it raises", TIME, f"{TIME}; action = action if self.time < 5 else {{}}['key']"),
    ("crash", "it ends the process", TIME, f"{TIME}; raise SystemExit(0)"),
    ("crash", "no model", ACTIONS, f"{ACTIONS}; self.P = {{0: {{0: [(0.5, 0, 0, 1)]}}}}; {STARTS}"),
]

CLOCK = (SPACE, "spaces.Box(0, 1, (1,))", SEEN, "np.array([self.time / 20], np.float32)")


def maker(changes=(), wrap=lambda env: TimeLimit(env, 40)):
    """A function that makes copies of the ferry with changes of its source, in a wrapper."""
    source = inspect.getsource(Ferry)
    for old, new in zip(changes[::2], changes[1::2], strict=True):
        assert old in source
        source = source.replace(old, new)
    inside = dict(globals())
    exec(source, inside)  # noqa: S102  # the source above
    return lambda: wrap(inside["Ferry"]())


WRAPPED = [
    ("wrapper-order", "statistics inside", lambda env: TimeLimit(RecordEpisodeStatistics(env), 9)),
    ("truncation-lost", "truncated swallowed", lambda env: Swallowing(TimeLimit(env, 4))),
]
PLANTED = {fault: (name, maker(changes)) for name, fault, *changes in CHANGES}
PLANTED |= {fault: (name, maker((), wrap)) for name, fault, wrap in WRAPPED}
PLANTED["no end"] = ("no-end", maker((DONE, "False"), lambda env: env))
RIGHT = {
    "ferry": maker(),
    "an open corridor": maker((ACTIONS, f"{ACTIONS}; self.P = corridor(5); {STARTS}")),
    "it shows the time": maker((*CLOCK, DONE, "self.time >= 20")),
    "a right key": maker((INFO, "'TimeLimit.truncated': False")),
}
