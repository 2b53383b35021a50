"""A right environment, and copies of it with one fault each."""

import random
import threading
import time

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit

LIMIT = 40


class Ferry(gym.Env):
    """Crosses a windy river of 6 by 6 places; a landing on the other shore pays 1, and ends."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012  # as Gymnasium's
    limit = LIMIT

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 5, (2,), np.float32)
        self.action_space = spaces.Discrete(3)
        self.time = 0
        self.prepare()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=self.seed_of(seed))
        self.place, self.time = np.array([0, self.drawn(6)]), 0
        return self.seen(), {}

    def step(self, action):
        self.time += 1
        self.act(action)
        return self.seen(), self.pay(), self.over(), self.cut(), self.told()

    def act(self, action):
        self.place[1] = np.clip(self.place[1] + int(action) - 1 + self.drawn(3) - 1, 0, 5)
        self.place[0] = min(self.place[0] + (self.drawn(4) > 0), 5)

    def prepare(self):
        pass

    def seed_of(self, seed):
        return seed

    def drawn(self, n):
        return int(self.np_random.integers(n))

    def seen(self):
        return self.place.astype(np.float32)

    def pay(self):
        return float(self.place[0] == 5 and self.place[1] > 2)

    def over(self):
        return bool(self.place[0] == 5)

    def cut(self):
        return False

    def told(self):
        return {}

    def render(self):
        return np.full((8, 8, 3), self.place[0], np.uint8)


def with_own(**makers):
    """A last step of the constructor, which sets attributes, each made by its function."""
    return {"prepare": lambda s: vars(s).update({name: make() for name, make in makers.items()})}


def corridor(n_open):
    """A model of five places in a row, of which only the first ones can be reached."""
    ahead = [min(s + 1, n_open - 1 if s < n_open else 4) for s in range(5)]
    rows = {
        s: {a: [(1.0, t, float(t == 4), t == 4)] for a in range(3)} for s, t in enumerate(ahead)
    }
    return with_own(P=lambda: rows, initial_state_distrib=lambda: np.eye(5)[0])


def filled(array, value):
    array[:] = value
    return array


class Old(Ferry):
    def reset(self):
        return super().reset()


class OldStep(Ferry):
    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or truncated, info


class Remade(Ferry):
    size = 0

    def reset(self, **kwargs):
        self.observation_space = spaces.Box(0, 5 + self.size, (2,), np.float32)
        return super().reset(**kwargs)


class Growing(Remade):
    size = 1


class Treasure(Ferry):
    found = False

    def pay(self):
        self.found |= self.time > 4
        return float(self.found)


class Swallowing(gym.Wrapper):
    def step(self, action):
        obs, reward, _, _, info = super().step(action)
        return obs, reward, self.unwrapped.over(), False, info


nan, rng, CLASSICAL, LOG, CLEARED = float("nan"), np.random.default_rng, np.random, [], []
OWN_GENERATOR = {"drawn": lambda s, n: s.own.integers(n)}
OWN_LOG = {"log": [], "pay": lambda s: s.log.append(1) or float(len(s.log))}
CLEARS = {"seed_of": lambda s, seed: CLEARED.clear() or seed}
CLEARS |= {"pay": lambda s: CLEARED.append(1) or float(len(CLEARED))}
WHOLE = with_own(observation_space=lambda: spaces.Box(0, 5, (2,), np.int64))
ONE_ARRAY = with_own(array=lambda: np.zeros(2, np.float32))
FIVE = with_own(observation_space=lambda: spaces.Discrete(5))
KEYS = with_own(observation_space=lambda: spaces.Dict(at=spaces.Discrete(6)))
OTHER_SHAPE = {"seen": lambda s: np.zeros(3 if s.time == 4 else 2, np.float32)}
HOLE = {"seen": lambda s: np.array([nan if s.time == 3 else 1, s.place[0]], "f4")}
FROM_ONE = with_own(action_space=lambda: spaces.Discrete(3, start=1))
FROM_ONE |= {"act": lambda s, action: Ferry.act(s, action - 1)}
NESTED = with_own(observation_space=lambda: spaces.Dict(at=spaces.Discrete(6, start=2)))
NESTED |= {"seen": lambda s: {"at": int(s.place[0]) + 2}}
UNBOUNDED = with_own(action_space=lambda: spaces.Box(-np.inf, np.inf, (1,)))
UNBOUNDED |= {"act": lambda s, action: Ferry.act(s, np.sign(action[0]) + 1)}
CLIPPING = with_own(action_space=lambda: spaces.Box(-1, 1, (1,), np.float32))
CLIPPING |= {"act": lambda s, a: Ferry.act(s, np.clip(a, -0.5, 0.5, out=a)[0] + 1)}
HALF = with_own(P=lambda: {0: {0: [(0.5, 0, 0.0, True)]}}, initial_state_distrib=lambda: [1.0])
DRAWS = {"render": lambda s: np.full((8, 8, 3), s.drawn(9), np.uint8)}
OVER = {"TimeLimit.truncated": True}
# What has to be found; the fault; the members of the class that have it, or class, or wrapper.
FAULTS = [
    ("seed", "numpy's generator", {"drawn": lambda s, n: CLASSICAL.randint(n)}),
    ("seed", "Python's generator", {"drawn": lambda s, n: random.randrange(n)}),  # noqa: S311
    ("seed", "a generator at every step", {"drawn": lambda s, n: rng().integers(n)}),
    ("seed", "the time of day", {"drawn": lambda s, n: time.perf_counter_ns() // 64 % n}),
    ("seed", "a generator of its own", OWN_GENERATOR | with_own(own=rng)),
    ("seed", "a seed of its own", OWN_GENERATOR | with_own(own=lambda: rng(3))),
    ("global-generator", "numpy is seeded", {"seed_of": lambda s, n: CLASSICAL.seed(n) or n}),
    ("reset-repeats", "the same seed again", {"seed_of": lambda s, seed: seed or 5}),
    ("shared-state", "a global list", {"pay": lambda s: LOG.append(1) or float(len(LOG))}),
    ("shared-state", "a list in the class", OWN_LOG),
    ("shared-state", "a list that reset clears", CLEARS),
    ("state-survives-reset", "a treasure stays found", Treasure),
    ("observation-in-place", "the place itself", WHOLE | {"seen": lambda s: s.place}),
    ("observation-in-place", "one array", ONE_ARRAY | {"seen": lambda s: filled(s.array, s.place)}),
    ("observation-out-of-bounds", "too far", {"seen": lambda s: s.place.astype("f4") * 2}),
    ("observation-not-in-space", "another shape", OTHER_SHAPE),
    ("observation-not-in-space", "too large", FIVE | {"seen": lambda s: int(s.place[0])}),
    ("observation-not-in-space", "no key", KEYS | {"seen": lambda s: {"at": 0} if s.time else {}}),
    ("observation-dtype", "double precision", {"seen": lambda s: s.place * 1.0}),
    ("observation-dtype", "a list", {"seen": lambda s: [float(x) for x in s.place]}),
    ("observation-nan", "nan in an observation", HOLE),
    ("observation-constant", "nothing to see", {"seen": lambda s: np.ones(2, np.float32)}),
    ("reward-nan", "nan as reward", {"pay": lambda s: nan if s.time == 3 else 0.0}),
    ("reward-nan", "infinity as reward", {"pay": lambda s: np.inf if s.time > 4 else 0.0}),
    ("reward-type", "a reward in an array", {"pay": lambda s: np.ones(1)}),
    ("reward-type", "no reward", {"pay": lambda s: None}),
    ("reward-huge", "a million", {"pay": lambda s: 1e6 * s.over()}),
    ("reward-never", "never a reward", {"pay": lambda s: 0.0}),
    ("info-episode", "info['episode']", {"told": lambda s: {"episode": s.time}}),
    ("info-key", "the last observation", {"told": lambda s: {"terminal_observation": s.place}}),
    ("info-key", "always a time limit", {"told": lambda s: OVER}),
    ("info-type", "no info", {"told": lambda s: None}),
    ("end-type", "an end that is a number", {"over": lambda s: int(s.place[0] == 5)}),
    ("space-start", "actions from 1", FROM_ONE),
    ("space-start", "a part that counts from 2", NESTED),
    ("space-changed", "a space that grows", Growing),
    ("space-remade", "a space made in reset", Remade),
    ("action-bounds", "actions without bounds", UNBOUNDED),
    ("action-changed", "an action clipped in place", CLIPPING),
    ("no-space", "no action space", with_own(action_space=lambda: 3)),
    ("old-api", "reset without a seed", Old),
    ("old-api", "four things from step", OldStep),
    ("no-end", "no end", {"over": lambda s: False, "limit": None}),
    ("limit-as-terminated", "a limit as an end", {"over": lambda s: s.time >= 20}),
    ("step-after-end", "life after an end", {"over": lambda s: s.time % 7 == 6}),
    ("goal-unreachable", "a goal behind a wall", corridor(3)),
    ("model", "half a probability", HALF),
    ("render", "a frame of fractions", {"render": lambda s: np.zeros((8, 8, 3))}),
    ("render", "a forgotten mode", with_own(render_mode=lambda: None)),
    ("render-changes", "drawing draws", DRAWS),
    ("not-copyable", "a lock", with_own(lock=threading.Lock)),
    ("slow", "a slow step", {"told": lambda s: time.sleep(0.005) or {}}),
    ("prints", "it prints", {"told": lambda s: print("at", s.place) or {}}),
    ("crash", "it raises", {"told": lambda s: {} if s.time < 5 else {}["key"]}),
    ("wrapper-order", "a limit around it", lambda env: TimeLimit(RecordEpisodeStatistics(env), 9)),
    ("truncation-lost", "truncated swallowed", lambda env: Swallowing(TimeLimit(env, 4))),
]
CLOCK = with_own(observation_space=lambda: spaces.Box(0, 1, (1,)))
CLOCK |= {"seen": lambda s: np.array([s.time / 20], "f4"), "over": lambda s: s.time >= 20}
RIGHT_KEY = {"told": lambda s: {"TimeLimit.truncated": False}}
RIGHT = {"ferry": {}, "shows the time": CLOCK, "open corridor": corridor(5), "key": RIGHT_KEY}


def maker(change):
    """A function that makes copies of a class, or of one with members, or in a wrapper."""
    kind = type("Faulty", (Ferry,), change) if isinstance(change, dict) else change
    if not isinstance(kind, type):
        return lambda **kwargs: change(Ferry(**kwargs))
    is_limited = kind.limit is not None
    return lambda **kwargs: TimeLimit(kind(**kwargs), LIMIT) if is_limited else kind(**kwargs)
