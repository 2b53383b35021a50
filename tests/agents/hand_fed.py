"""Agents that are told of steps one by one, without an environment that takes them."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from hypothesis import strategies as st

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.algorithm import Transitions

N_STATES, N_ACTIONS = 4, 3


class Spaces(gym.Env):
    """Spaces alone, given as such or as numbers; nothing here is ever stepped."""

    def __init__(self, observations=N_STATES, actions=N_ACTIONS):
        is_number = isinstance(observations, int)
        self.observation_space = spaces.Discrete(observations) if is_number else observations
        self.action_space = spaces.Discrete(actions)


def feed(agent, obs, action, reward, next_obs, end=""):
    """Let the agent learn from a step; ``end`` is "terminated", "truncated" or ""."""
    ended = np.array([end == "terminated"]), np.array([end != ""])
    steps = np.array([obs]), np.array([action]), np.array([float(reward)]), *ended
    agent._learn_from(Transitions(*steps, np.array([next_obs])))


class Told:
    """An agent on some spaces, which learns from what it is told to have done."""

    def __init__(self, algorithm, observations, n_actions=2, **settings):
        kind = load_algorithm(algorithm) if isinstance(algorithm, str) else algorithm
        self.agent = kind(env=Spaces(observations, n_actions), **{"seed": 0, **settings})
        self.agent._begin_episodes()

    def step(self, obs, action, reward, next_obs, end=""):
        """As `feed`."""
        feed(self.agent, obs, action, reward, next_obs, end)

    @property
    def committed(self):
        """The action that the agent has committed to, -1 for none."""
        return int(self.agent._next_actions[0])


class Fed(Told):
    """An agent on a table, which explores by a constant epsilon and breaks no ties at random."""

    def __init__(self, name, table, epsilon=0.0, **settings):
        table = np.asarray(table, dtype=float)
        explores = "exploration" in load_algorithm(name).__signature__.parameters
        constant = {"exploration_decay": "constant", "exploration_initial_eps": epsilon}
        constant = {**constant, "tie_breaking": "first"} if explores else {}
        super().__init__(name, *table.shape[-2:], **{"gamma": 0.5, **constant, **settings})
        self.agent.policy.q_tables.numpy()[:] = table
        self.table = self.agent.policy.q_tables.numpy()[0]

    def step(self, obs, action, reward, next_obs, end=""):
        """As above; returns the table."""
        super().step(obs, action, reward, next_obs, end)
        return self.table.copy()

    def episode(self, steps, end):
        """Learn from steps (obs, action, reward), the last of which leads to state 0."""
        following = [*(step[0] for step in steps[1:]), 0]
        ends = [*[""] * (len(steps) - 1), end]
        return [self.step(*step, *to) for step, *to in zip(steps, following, ends, strict=True)]

    def committed_episode(self, steps, end):
        """As `episode`, but after the first step it does what it has committed to.

        Returns:
            The steps as they were taken.
        """
        taken = []
        for k, (obs, action, reward) in enumerate(steps):
            taken.append((obs, action if k == 0 else self.committed, reward))
            is_last = k == len(steps) - 1
            self.step(*taken[-1], 0 if is_last else steps[k + 1][0], end if is_last else "")
        return taken


ENDS = st.sampled_from(["terminated", "truncated"])
SHARES = st.floats(0.0, 1.0, width=16)
REWARDS = st.integers(-3, 3)
STATES, ACTIONS = st.integers(0, N_STATES - 1), st.integers(0, N_ACTIONS - 1)


def tables():
    """Tables of whole numbers, among which ties are common."""
    rows = st.lists(st.integers(-2, 4), min_size=N_ACTIONS, max_size=N_ACTIONS)
    return st.lists(rows, min_size=N_STATES, max_size=N_STATES)


def episodes(max_size=8):
    """Lists of (obs, action, reward)."""
    return st.lists(st.tuples(STATES, ACTIONS, REWARDS), min_size=1, max_size=max_size)


def greedy(table, obs):
    """The first best action."""
    return int(np.argmax(table[obs]))
