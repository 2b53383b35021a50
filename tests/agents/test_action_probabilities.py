"""What an exploring agent would do, row by row, for tables of every shape."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from agents import load_algorithm

# Four states and four actions above all: there, a row mistaken for a column raises no error.
SHAPES = [(4, 4), (2, 2), (3, 5), (5, 3), (1, 3), (3, 1)]


class Shape(gym.Env):
    """As many states and actions as are asked for; nothing happens in it."""

    def __init__(self, n_states, n_actions):
        self.observation_space = spaces.Discrete(n_states)
        self.action_space = spaces.Discrete(n_actions)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, 0.0, True, False, {}


def agent_of(values, **arguments):
    """A Q-learning agent with a table of values."""
    agent = load_algorithm("qlearning")(env=Shape(*values.shape), seed=0, **arguments)
    agent.policy.q_tables.copy_(th.as_tensor(values))
    return agent


def distinct(shape):
    """Values without ties, whose rows have their best in different places and heights."""
    return np.random.default_rng(3).normal(size=shape) + 3 * np.arange(shape[0])[:, None]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_epsilon_greedy_row_by_row(shape, epsilon):
    values = distinct(shape)
    agent = agent_of(values, exploration_initial_eps=epsilon, exploration_final_eps=epsilon)
    n_actions = shape[1]
    expected = np.full(shape, epsilon / n_actions)
    for state, row in enumerate(values.tolist()):
        expected[state, row.index(max(row))] += 1 - epsilon
    np.testing.assert_allclose(agent.action_probabilities(), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("temperature", [0.2, 1.0, 5.0])
def test_boltzmann_row_by_row(shape, temperature):
    values = distinct(shape)
    agent = agent_of(values, exploration="boltzmann", temperature=temperature)
    expected = []
    for row in values.tolist():
        weights = [math.exp((value - row[0]) / temperature) for value in row]
        expected.append([weight / sum(weights) for weight in weights])
    np.testing.assert_allclose(agent.action_probabilities(), expected, rtol=1e-12)


def test_tied_actions_share_or_the_first_has_all():
    values = np.array([[1.0, 2, 2, 0], [3, 3, 3, 3], [5, 4, 5, 5], [0, 0, 0, 9]])
    arguments = {"exploration_initial_eps": 0.4, "exploration_final_eps": 0.4}
    shared = agent_of(values, tie_breaking="random", **arguments).action_probabilities()
    np.testing.assert_allclose(
        shared,
        [
            [0.1, 0.1 + 0.6 / 2, 0.1 + 0.6 / 2, 0.1],
            [0.25, 0.25, 0.25, 0.25],
            [0.1 + 0.6 / 3, 0.1, 0.1 + 0.6 / 3, 0.1 + 0.6 / 3],
            [0.1, 0.1, 0.1, 0.7],
        ],
    )
    alone = agent_of(values, tie_breaking="first", **arguments).action_probabilities()
    np.testing.assert_allclose(
        alone,
        [[0.1, 0.7, 0.1, 0.1], [0.7, 0.1, 0.1, 0.1], [0.7, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, 0.7]],
    )


def test_values_that_are_large_do_not_overflow():
    values = np.array([[1e6, 1e6 + 1], [-1e6, -1e6 - 1]])
    found = agent_of(values, exploration="boltzmann", temperature=1.0).action_probabilities()
    likely = 1 / (1 + math.exp(-1))
    np.testing.assert_allclose(found, [[1 - likely, likely], [likely, 1 - likely]], rtol=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_gaussian_noise_has_no_closed_form(shape):
    agent = agent_of(distinct(shape), exploration="gaussian_noise")
    with pytest.raises(ValueError, match="no closed-form action probabilities"):
        agent.action_probabilities()
