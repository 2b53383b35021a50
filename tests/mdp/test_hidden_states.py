"""What can be had where states are hidden: with memory, and by the present observation alone."""

from itertools import product

import gymnasium as gym
import numpy as np
import pytest

from rl_yardstick import mdp
from rl_yardstick.envs.known_models import observations_of_states, transition_model
from rl_yardstick.mdp.beliefs import memory_optimum
from rl_yardstick.mdp.memoryless import best_memoryless, observation_groups


def random_world(seed, n_states=4, n_actions=2, n_groups=2):
    """A random world with terminations, whose observations hide the state."""
    rng = np.random.default_rng(seed)
    shape = (n_states, n_actions, 2)
    model = mdp.TransitionModel(
        prob=rng.dirichlet(np.ones(2), shape[:2]),
        next_state=rng.integers(n_states, size=shape),
        reward=rng.integers(-3, 4, size=shape).astype(float),
        terminated=rng.random(shape) < 0.15,
        initial=rng.dirichlet(np.ones(n_states)),
    )
    return model, rng.permutation(np.arange(n_states) % n_groups)


def best_with_memory(model, groups, here, horizon):
    """The best return of the mass in each state, by trying all actions after each observation."""
    total = 0.0
    for group in np.unique(groups):
        seen = np.where(groups == group, here, 0.0)
        if horizon == 0 or not seen.any():
            continue
        found = []
        for action in range(model.n_actions):
            there = np.zeros(model.n_states)
            goes_on = model.prob[:, action] * ~model.terminated[:, action]
            np.add.at(there, model.next_state[:, action], seen[:, None] * goes_on)
            later = best_with_memory(model, groups, there, horizon - 1)
            found.append(seen @ model.expected_reward[:, action] + later)
        total += max(found)
    return total


@pytest.mark.parametrize("n_groups", [1, 2, 4], ids=["blind", "two observations", "all seen"])
def test_the_optimum_with_memory_is_that_of_a_recursion(n_groups):
    for seed, horizon in ((0, 1), (1, 2), (2, 4), (3, 4)):
        model, groups = random_world(seed, n_groups=n_groups)
        found = memory_optimum(model, groups, horizon)
        expected = best_with_memory(model, groups, model.initial, horizon)
        assert found.lower == found.upper == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(3))
def test_brackets_of_trees_that_are_cut_hold_the_optimum(seed, monkeypatch):
    model, groups = random_world(seed, n_states=6, n_actions=3, n_groups=3)
    exact = memory_optimum(model, groups, 7)
    assert exact.lower == exact.upper <= mdp.finite_horizon_optimum(model, 7).start_value + 1e-9
    monkeypatch.setattr(mdp.beliefs, "MOST_BELIEFS", 3)
    monkeypatch.setattr(mdp.beliefs, "MOST_OF_MORE", 3)
    cut = memory_optimum(model, groups, 7)
    assert cut.lower <= exact.upper + 1e-9
    assert exact.upper <= cut.upper + 1e-9
    # And says something: the plans for the beliefs on the way are not far from the best.
    assert cut.upper - cut.lower < 0.5 * max(1.0, abs(exact.upper))


def hidden_of(env_id, **kwargs):
    env = gym.make(f"envs:{env_id}", **kwargs)
    model = transition_model(env)
    return model, observation_groups(observations_of_states(env), model.reachable)


# By hand: opening a door at once returns 0.5 (10 - 100) = -45; after two readings that agree, which
# have the chance .85^2 + .15^2 = .745, it returns .7225 * 10 - .0225 * 100 = 4.975 in all, and else
# the third step listens: -2 + 4.975 - .255 = 2.72. With perfect ears, one reading is enough.
BY_HAND = [(0.85, 1, -1.0), (0.85, 2, -2.0), (0.85, 3, 2.72), (1.0, 10, 45.0), (0.95, 2, 3.5)]


@pytest.mark.parametrize(("accuracy", "horizon", "value"), BY_HAND)
def test_values_of_the_tiger_are_those_worked_out_by_hand(accuracy, horizon, value):
    found = memory_optimum(*hidden_of("Tiger-v0", accuracy=accuracy), horizon)
    assert found.lower == found.upper == pytest.approx(value, abs=1e-12)


def test_the_best_in_the_short_corridor_is_random_and_proved():
    """Sutton and Barto, example 13.1: right with probability 2 - sqrt(2)."""
    model, groups = hidden_of("ShortCorridor-v0")
    found = best_memoryless(model, groups, 1000)
    assert found.lower == found.upper == pytest.approx(-(6 + 4 * np.sqrt(2)), abs=1e-9)
    assert found.policy[0, 1] == pytest.approx(2 - np.sqrt(2), abs=1e-5)
    assert (found.firm, found.is_firm_known, found.needs_chance) == (-1000.0, True, True)
    # Who remembers takes three steps.
    assert memory_optimum(model, groups, 1000) == (-3.0, -3.0)


@pytest.mark.parametrize("seed", range(2))
def test_no_policy_of_a_fine_grid_is_above_the_bound(seed):
    model, groups = random_world(seed)
    found = best_memoryless(model, groups, 6)
    grid = np.linspace(0, 1, 21)

    def value(one, two):
        policy = np.array([[one, 1 - one], [two, 1 - two]])[groups]
        return mdp.policy_return(model, policy, 6).expected_return

    best = max(value(one, two) for one in grid for two in grid)
    assert best <= found.upper + 1e-9
    # The grid comes close to what was found, which is the best.
    assert best == pytest.approx(found.lower, abs=0.05)
    assert found.lower == found.upper


@pytest.mark.parametrize("most_tried", [100_000, 0], ids=["all tried", "hill climbing"])
def test_the_best_deterministic_policy_is_that_of_brute_force(most_tried, monkeypatch):
    monkeypatch.setattr(mdp.memoryless, "MOST_FIRM", most_tried)
    monkeypatch.setattr(mdp.memoryless, "MOST_RETURNS", 1)
    for seed in range(3):
        model, groups = random_world(seed, n_states=6, n_actions=3, n_groups=4)
        found = best_memoryless(model, groups, 6)
        choices = (np.array(each)[groups] for each in product(range(3), repeat=4))
        best = max(mdp.policy_return(model, choice, 6).expected_return for choice in choices)
        assert found.firm == pytest.approx(best)
        assert found.is_firm_known == (most_tried > 0)
    # Of 16,384 policies, as counted by another program; with the goal in the third aisle too.
    for last_row, best in (("#S#G#.#", -47.0667), ("#S#.#G#", -33.9333)):
        desc = [".......", "#.#.#.#", "#.#.#.#", last_row]
        found = best_memoryless(*hidden_of("DarkWarehouse-v0", desc=desc), 100)
        assert found.firm == pytest.approx(best, abs=1e-4)


@pytest.mark.parametrize("seed", range(2))
def test_bounds_without_time_hold_too(seed, monkeypatch):
    model, groups = random_world(seed, n_states=6, n_actions=3, n_groups=3)
    known = best_memoryless(model, groups, 6)
    monkeypatch.setattr(mdp.memoryless, "MOST_RETURNS", 1)
    cut = best_memoryless(model, groups, 6)
    assert cut.lower == known.lower
    assert known.upper <= cut.upper <= mdp.finite_horizon_optimum(model, 6).start_value + 1e-9


def test_groups_are_of_equal_rows_and_none_where_states_are_told_apart():
    everywhere = np.ones(4, bool)
    assert observation_groups(np.arange(4), everywhere) is None
    assert observation_groups(np.array([5, 1, 5, 2]), everywhere).tolist() == [2, 0, 2, 1]
    # States that nobody comes to do not count.
    assert observation_groups(np.array([5, 1, 5, 2]), np.array([True, True, False, True])) is None
