"""The best policies that go by the present observation, against closed forms and fine grids."""

import gymnasium as gym
import numpy as np
import pytest

import mdp.memoryless
from envs.known_models import transition_model
from mdp import finite_horizon_optimum, policy_return
from mdp.memoryless import best_memoryless, observation_groups
from tests.mdp.test_beliefs import hidden_of, random_world


def test_the_best_in_the_short_corridor_is_random_and_proved():
    """Sutton and Barto, example 13.1: right with probability 2 - sqrt(2)."""
    model, groups = hidden_of("ShortCorridor-v0")
    found = best_memoryless(model, groups, 1000)
    assert found.lower == found.upper == pytest.approx(-(6 + 4 * np.sqrt(2)), abs=1e-9)
    assert found.policy[0, 1] == pytest.approx(2 - np.sqrt(2), abs=1e-5)
    assert (found.firm, found.is_firm_known, found.needs_chance) == (-1000.0, True, True)


@pytest.mark.parametrize("seed", range(2))
def test_no_policy_of_a_fine_grid_is_above_the_bound(seed):
    model, groups = random_world(seed)
    found = best_memoryless(model, groups, 6)
    grid = np.linspace(0, 1, 21)

    def value(one, two):
        policy = np.array([[one, 1 - one], [two, 1 - two]])[groups]
        return policy_return(model, policy, 6).expected_return

    best = max(value(one, two) for one in grid for two in grid)
    assert best <= found.upper + 1e-9
    # The grid comes close to what was found, which is the best.
    assert best == pytest.approx(found.lower, abs=0.05)
    assert found.lower == found.upper
    firm = max(value(one, two) for one in (0.0, 1.0) for two in (0.0, 1.0))
    assert found.firm == pytest.approx(firm, abs=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_bounds_without_time_hold_too(seed, monkeypatch):
    model, groups = random_world(seed, n_states=6, n_actions=3, n_groups=3)
    known = best_memoryless(model, groups, 6)
    monkeypatch.setattr(mdp.memoryless, "MOST_RETURNS", 1)
    cut = best_memoryless(model, groups, 6)
    assert cut.lower == known.lower
    assert known.upper <= cut.upper <= finite_horizon_optimum(model, 6).start_value + 1e-9


def test_where_each_state_is_seen_the_best_of_what_is_observed_is_the_best():
    model = transition_model(gym.make("FrozenLake-v1", is_slippery=False))
    found = best_memoryless(model, np.arange(model.n_states), 100, most=1.0)
    assert found.lower == found.upper == pytest.approx(1.0)


def test_groups_are_of_equal_rows_and_none_where_states_are_told_apart():
    everywhere = np.ones(4, bool)
    assert observation_groups(np.arange(4), everywhere) is None
    assert observation_groups(np.array([5, 1, 5, 2]), everywhere).tolist() == [2, 0, 2, 1]
    rows = np.array([[0.5, 1], [0.5, 2], [0.5, 1], [0, 0]], np.float32)
    groups = observation_groups(rows, everywhere)
    assert groups[0] == groups[2]
    assert len(set(groups.tolist())) == 3
    # States that nobody comes to do not count.
    assert observation_groups(np.array([5, 1, 5, 2]), np.array([True, True, False, True])) is None
