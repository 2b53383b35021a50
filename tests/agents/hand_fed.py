"""Agents that are told of steps one by one, without an environment that takes them."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from hypothesis import strategies as st

from agents import load_algorithm
from agents.common.algorithm import Transitions

N_STATES, N_ACTIONS = 4, 3


class Spaces(gym.Env):
    """Spaces alone; nothing here is ever stepped."""

    def __init__(self, n_states=N_STATES, n_actions=N_ACTIONS):
        self.observation_space = spaces.Discrete(n_states)
        self.action_space = spaces.Discrete(n_actions)


class Fed:
    """An agent on a table, which does what it is told and learns from it.

    It commits to the first best action where its rule needs one.
    """

    def __init__(self, name, table, epsilon=0.0, **kwargs):
        table = np.asarray(table, dtype=float)
        constant = {"exploration_decay": "constant", "exploration_initial_eps": epsilon}
        self.agent = load_algorithm(name)(
            env=Spaces(*table.shape), tie_breaking="first", seed=0, **constant, **kwargs
        )
        self.table = self.agent.policy.q_tables.numpy()[0]
        self.table[:] = table
        self.agent._begin_episodes()

    def step(self, obs, action, reward, next_obs, end=""):
        """Learn from a step, and return the table; ``end`` is "terminated", "truncated" or ""."""
        transitions = Transitions(
            np.array([obs]),
            np.array([action]),
            np.array([float(reward)]),
            np.array([end == "terminated"]),
            np.array([end != ""]),
            np.array([next_obs]),
        )
        self.agent._learn_from(transitions)
        return self.table.copy()

    def episode(self, steps, end):
        """Learn from steps (obs, action, reward), the last of which leads to state 0."""
        following = [*(step[0] for step in steps[1:]), 0]
        tables = []
        for k, (step, next_obs) in enumerate(zip(steps, following, strict=True)):
            tables.append(self.step(*step, next_obs, end if k == len(steps) - 1 else ""))
        return tables

    def committed_episode(self, steps, end):
        """As `episode`, but after the first step it does what it has committed to.

        Returns:
            The steps as they were taken.
        """
        taken = []
        for k, (obs, action, reward) in enumerate(steps):
            taken.append((obs, action if k == 0 else int(self.agent._next_actions[0]), reward))
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
