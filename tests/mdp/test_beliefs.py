"""The optimum with memory against all policy trees, and Tiger's values by hand."""

import itertools

import gymnasium as gym
import numpy as np
import pytest

import mdp.beliefs
from envs.known_models import observations_of_states, transition_model
from mdp import TransitionModel, finite_horizon_optimum
from mdp.beliefs import HiddenModel, memory_optimum
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


def best_of_all_trees(model, groups, horizon):
    """The best return of all ways to choose an action after each sequence of observations."""
    n_groups = int(groups.max()) + 1
    histories = [
        h for n in range(1, horizon + 1) for h in itertools.product(range(n_groups), repeat=n)
    ]
    best = -np.inf
    for choice in itertools.product(range(model.n_actions), repeat=len(histories)):
        action_after, total = dict(zip(histories, choice, strict=True)), 0.0
        masses = {}
        for state, chance in enumerate(model.initial):
            masses[(int(groups[state]),), state] = chance
        for _ in range(horizon):
            after = {}
            for (history, state), mass in masses.items():
                action = action_after[history]
                for k in range(model.n_outcomes):
                    weight = mass * model.prob[state, action, k]
                    total += weight * model.reward[state, action, k]
                    if not model.terminated[state, action, k]:
                        following = int(model.next_state[state, action, k])
                        key = (*history, int(groups[following])), following
                        after[key] = after.get(key, 0.0) + weight
            masses = after
        best = max(best, total)
    return best


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("horizon", [1, 2, 3])
def test_the_optimum_with_memory_is_the_best_of_all_policy_trees(seed, horizon):
    model, groups = random_world(seed)
    found = memory_optimum(model, groups, horizon)
    assert found.lower == found.upper == pytest.approx(best_of_all_trees(model, groups, horizon))


@pytest.mark.parametrize("seed", range(12))
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


@pytest.mark.parametrize("seed", range(6))
def test_where_states_are_seen_memory_adds_nothing(seed):
    model, _ = random_world(seed)
    found = memory_optimum(model, np.arange(model.n_states), 5)
    assert found.lower == found.upper == pytest.approx(finite_horizon_optimum(model, 5).start_value)


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
        (1.0, 2, 9.0),
        (1.0, 10, 45.0),
        (0.95, 2, -1 + 0.95 * 10 - 0.05 * 100),
        (0.5, 4, -4.0),
    ],
)
def test_values_of_the_tiger_are_those_worked_out_by_hand(accuracy, horizon, value):
    found = memory_optimum(*hidden_of("Tiger-v0", accuracy=accuracy), horizon)
    assert found.lower == found.upper == pytest.approx(value, abs=1e-12)


def test_the_tiger_is_hidden_and_what_was_heard_is_not_part_of_it():
    hidden = HiddenModel.of(*hidden_of("Tiger-v0"))
    assert hidden.reward.shape == (3, 2)
    assert hidden.arrive.shape == (3, 2, 3, 2)
    np.testing.assert_allclose(hidden.arrive.sum(axis=(2, 3)), 1)
    np.testing.assert_allclose(hidden.start, [[0.5, 0.5], [0, 0], [0, 0]])


def test_with_memory_the_short_corridor_takes_three_steps():
    found = memory_optimum(*hidden_of("ShortCorridor-v0"), 1000)
    assert found == (-3.0, -3.0)


def test_worlds_that_are_too_large_have_no_bracket(monkeypatch):
    monkeypatch.setattr(mdp.beliefs, "MOST_NUMBERS", 30)
    assert memory_optimum(*hidden_of("Tiger-v0"), 3) is None
