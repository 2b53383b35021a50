"""An environment of a user's own, whose episodes do what their seed says."""

import os
import signal
import time
from pathlib import Path

import gymnasium as gym

MARK = Path(__file__).with_name("mark")


class Walk(gym.Env):
    """Five places in a row; the goal is the last."""

    observation_space = gym.spaces.Discrete(5)
    action_space = gym.spaces.Discrete(2)
    steps = 0
    seed = None

    def __init__(self, is_slow=False):
        self.is_slow = is_slow

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.seed = 0, self.seed if seed is None else seed
        return 0, {}

    def step(self, action):
        self.steps += 1
        if self.steps == 50 and self.seed == 1 and not self.is_slow:
            raise RuntimeError("thin ice")
        if self.steps == 50 and self.seed == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        if (self.is_slow or self.seed == 3) and not MARK.exists():
            time.sleep(0.02)
        self.place = min(max(self.place + 2 * int(action) - 1, 0), 4)
        return self.place, float(self.place == 4), self.place == 4, False, {}


gym.register("Walk-v0", entry_point=Walk, max_episode_steps=20)
