"""Agents that are told of steps one by one, without an environment that takes them."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

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

    def step(self, *step):
        """As `feed`."""
        feed(self.agent, *step)

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

    def step(self, *step):
        """As above; returns the table."""
        super().step(*step)
        return self.table.copy()

    def episode(self, steps, end, commits=False):
        """Learn from steps (obs, action, reward), the last of which leads to state 0.

        Returns them as taken: after the first one it may do what it has committed to.
        """
        taken, following = [], [*(step[0] for step in steps[1:]), 0]
        for k, (obs, action, reward) in enumerate(steps):
            taken.append((obs, self.committed if k and commits else action, reward))
            self.step(*taken[-1], following[k], end if k == len(steps) - 1 else "")
        return taken


ENDS = st.sampled_from(["terminated", "truncated"])
SHARES = st.floats(0.0, 1.0, width=16)
# Tables of whole numbers, among which ties are common; and lists of (obs, action, reward).
TABLES = hnp.arrays(int, (N_STATES, N_ACTIONS), elements=st.integers(-2, 4))
STATES, ACTIONS = st.integers(0, N_STATES - 1), st.integers(0, N_ACTIONS - 1)
EPISODES = st.lists(st.tuples(STATES, ACTIONS, st.integers(-3, 3)), min_size=1, max_size=8)
