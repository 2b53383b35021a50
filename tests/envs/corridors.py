"""Corridors whose word on their dynamics is right or false, and which tell or hide their place."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.toy_text.utils import categorical_sample


def outcomes(wind=0.3, goal_reward=9.0):
    """A corridor of five states: 0 left, 1 right; wind blows back by two; the goal is 4."""
    table = {}
    for state in range(5):
        table[state] = {}
        for action in (0, 1):
            target = min(max(state + 2 * action - 1, 0), 4)
            moved = (target, goal_reward if target == 4 else -1.0, target == 4)
            table[state][action] = [(1 - wind, *moved), (wind, max(state - 2, 0), -1.0, False)]
    return table


class Corridor(gym.Env):
    """Steps by ``true``, and tells ``P``; draws as toy_text does."""

    action_space = spaces.Discrete(2)

    def __init__(self, told=None, true=None, start=(1, 0, 0, 0, 0), render_mode=None):
        self.true = true or outcomes()
        self.P = told or self.true
        self.initial_state_distrib = np.array(start, float)
        self.observation_space = spaces.Discrete(len(self.P))
        self.render_mode = render_mode
        self.s = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = int(categorical_sample([1.0, 0.0, 0.0, 0.0, 0.0], self.np_random))
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        row = self.true[int(self.s)][action]
        _, self.s, reward, terminated = row[self.draw(row)]
        self.steps += 1
        return self.observe(), reward, terminated, False, {}

    def draw(self, row):
        return categorical_sample([outcome[0] for outcome in row], self.np_random)

    def observe(self):
        return self.s


class Backwards(Corridor):
    def draw(self, row):
        return int(self.np_random.random() < row[1][0])


class Deaf(Corridor):
    """Lets ``s`` be set, and goes on from where it was."""

    def reset(self, *, seed=None, options=None):
        self.place, info = super().reset(seed=seed)
        return self.place, info

    def step(self, action):
        self.s = self.place
        result = super().step(action)
        self.place = self.s
        return result
