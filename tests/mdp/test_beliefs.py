"""The optimum with memory against a recursion, and Tiger's values by hand."""

import gymnasium as gym
import numpy as np
import pytest

import mdp.beliefs
from envs.known_models import observations_of_states, transition_model
from mdp import TransitionModel, finite_horizon_optimum
from mdp.beliefs import memory_optimum
from mdp.memoryless import observation_groups


def random_world(seed, n_states=4, n_actions=2, n_groups=2):
    """A random world with terminations, whose observations hide the state."""
    rng = np.random.default_rng(seed)
    shape = (n_states, n_actions, 2)
    model = TransitionModel(
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


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n_groups", [1, 2, 4], ids=["blind", "two observations", "all seen"])
def test_the_optimum_with_memory_is_that_of_a_recursion(seed, n_groups):
    model, groups = random_world(seed, n_groups=n_groups)
    for horizon in (1, 2, 4):
        found = memory_optimum(model, groups, horizon)
        expected = best_with_memory(model, groups, model.initial, horizon)
        assert found.lower == found.upper == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(3))
def test_brackets_of_trees_that_are_cut_hold_the_optimum(seed, monkeypatch):
    model, groups = random_world(seed, n_states=6, n_actions=3, n_groups=3)
    exact = memory_optimum(model, groups, 7)
    assert exact.lower == exact.upper <= finite_horizon_optimum(model, 7).start_value + 1e-9
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
@pytest.mark.parametrize(
    ("accuracy", "horizon", "value"),
    [
        (0.85, 1, -1.0),
        (0.85, 2, -2.0),
        (0.85, 3, 2.72),
        (1.0, 10, 45.0),
        (0.95, 2, -1 + 0.95 * 10 - 0.05 * 100),
    ],
)
def test_values_of_the_tiger_are_those_worked_out_by_hand(accuracy, horizon, value):
    found = memory_optimum(*hidden_of("Tiger-v0", accuracy=accuracy), horizon)
    assert found.lower == found.upper == pytest.approx(value, abs=1e-12)


def test_with_memory_the_short_corridor_takes_three_steps():
    found = memory_optimum(*hidden_of("ShortCorridor-v0"), 1000)
    assert found == (-3.0, -3.0)


def test_worlds_that_are_too_large_have_no_bracket(monkeypatch):
    monkeypatch.setattr(mdp.beliefs, "MOST_NUMBERS", 30)
    assert memory_optimum(*hidden_of("Tiger-v0"), 3) is None
