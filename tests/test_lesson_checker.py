"""The checker of the lessons: right answers pass, and each common mistake is named."""

import importlib
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.known_models import transition_model
from mdp import TransitionModel, policy_iteration, value_iteration

# A lesson imports it as a script in its folder does.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs" / "lessons"))
checker = importlib.import_module("checker")

MODEL = transition_model(gym.make("FrozenLake-v1"))
RANDOM = np.full((16, 4), 0.25)
DISCOUNT = 0.9


def solved(policy, discount=DISCOUNT):
    """Values by the matrix of the first lesson."""
    chance = checker.probabilities(MODEL, policy)[:, :, None] * MODEL.prob
    matrix = np.zeros((16, 16))
    going_on = chance * ~MODEL.terminated
    for state in range(16):
        np.add.at(matrix[state], MODEL.next_state[state].ravel(), going_on[state].ravel())
    rewards = (chance * MODEL.reward).sum(axis=(1, 2))
    return np.linalg.solve(np.eye(16) - discount * matrix, rewards)


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.99))
def test_values_of_any_policy_are_right(seed, discount):
    policy = np.random.default_rng(seed).dirichlet(np.ones(4), size=16)
    values = solved(policy, discount)
    assert checker.check_policy_values(MODEL, policy, discount, values) == "Right."
    state = int(np.random.default_rng(seed).choice(np.flatnonzero(MODEL.reachable)))
    values[state] += 0.01
    said = checker.check_policy_values(MODEL, policy, discount, values)
    assert said != "Right."


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (..., "Not done yet."),
        (None, "Not done yet."),
        ("many", "It has to be an array of numbers, one value for each state."),
        (np.ones(15), "The shape has to be (16,), one value for each state; it is (15,)."),
        (np.full(16, np.nan), "There are numbers in it that are not finite."),
        (value_iteration(MODEL, DISCOUNT).values, "They are those of an agent that always takes"),
        (solved(RANDOM, discount=1 - 1e-12), "The discount is missing"),
    ],
)
def test_mistakes_in_values_are_named(values, said):
    assert checker.check_policy_values(MODEL, RANDOM, DISCOUNT, values).startswith(said)


def test_the_state_that_disagrees_most_is_named_and_no_answer():
    values = solved(RANDOM)
    values[9] += 0.5
    said = checker.check_policy_values(MODEL, RANDOM, DISCOUNT, values)
    assert "most in state 9: yours is higher" in said
    assert f"{solved(RANDOM)[9]:.3f}" not in said


def test_values_that_go_on_after_the_end_are_named():
    """One state, whose only step earns 1 and ends the episode."""
    model = TransitionModel(
        prob=np.ones((1, 1, 1)),
        next_state=np.zeros((1, 1, 1), dtype=int),
        reward=np.ones((1, 1, 1)),
        terminated=np.ones((1, 1, 1), dtype=bool),
        initial=np.ones(1),
    )
    assert checker.check_policy_values(model, np.zeros(1), 0.5, np.ones(1)) == "Right."
    for check, more in ((checker.check_policy_values, [[0]]), (checker.check_optimal_values, [])):
        assert check(model, *more, 0.5, np.full(1, 2.0)).startswith("They go on after the end")


def test_optimal_values():
    best = value_iteration(MODEL, DISCOUNT).values
    assert checker.check_optimal_values(MODEL, DISCOUNT, best) == "Right."
    assert policy_iteration(MODEL, DISCOUNT).values == pytest.approx(best)
    few = np.zeros(16)
    for _ in range(25):
        few = checker.looked_ahead(MODEL, DISCOUNT, few).max(axis=1)
    assert "too few sweeps" in checker.check_optimal_values(MODEL, DISCOUNT, few)
    said = checker.check_optimal_values(MODEL, DISCOUNT, solved(RANDOM))
    assert said.startswith("They are those of random actions")


def test_action_values():
    values = solved(RANDOM)
    right = checker.looked_ahead(MODEL, DISCOUNT, values)
    assert checker.check_action_values(MODEL, DISCOUNT, values, right) == "Right."
    undiscounted = checker.looked_ahead(MODEL, 1.0, values)
    said = checker.check_action_values(MODEL, DISCOUNT, values, undiscounted)
    assert said == "The discount is missing."
    right[14, 2] -= 1
    said = checker.check_action_values(MODEL, DISCOUNT, values, right)
    assert "at 1 of 64 places, most in state 14, action 2: yours is lower" in said


def test_greedy_policies():
    plan = value_iteration(MODEL, DISCOUNT)
    assert checker.check_greedy(MODEL, DISCOUNT, plan.values, plan.policy) == "Right."
    worse = plan.policy.copy()
    worse[14] = 0
    said = checker.check_greedy(MODEL, DISCOUNT, plan.values, worse)
    assert said.startswith(
        "1 states have a better action by these values. In state 14 the action 0"
    )
    said = checker.check_greedy(MODEL, DISCOUNT, plan.values, np.full(16, 4))
    assert said == "Actions are the numbers 0 to 3."


def q_target(reward, discount, terminated, next_values):
    return reward if terminated else reward + discount * next_values.max()


def sarsa_target(reward, discount, terminated, next_values, next_action):
    return reward if terminated else reward + discount * next_values[next_action]


def expected_target(reward, discount, terminated, next_values, epsilon):
    mean = epsilon * next_values.mean() + (1 - epsilon) * next_values.max()
    return reward if terminated else reward + discount * mean


def best_left_out(reward, discount, terminated, next_values, epsilon):
    others = (next_values.sum() - next_values.max()) / 3
    mean = epsilon * others + (1 - epsilon) * next_values.max()
    return reward if terminated else reward + discount * mean


@pytest.mark.parametrize(
    ("target", "kind", "said"),
    [
        (q_target, "qlearning", "Right."),
        (sarsa_target, "sarsa", "Right."),
        (expected_target, "expected_sarsa", "Right."),
        (lambda *_: None, "qlearning", "It cannot be called or gives no number"),
        (lambda *_: "one", "qlearning", "It cannot be called or gives no number: could not"),
        (lambda r, d, t, v: v[9], "qlearning", "It cannot be called or gives no number: index 9"),
        (lambda *_: float("nan"), "qlearning", "It gives a number that is not finite."),
        (lambda *_, **__: float("nan"), "expected_sarsa", "It gives a number that is not finite."),
        (lambda r, d, t, v: r + d * v.max(), "qlearning", "When the episode has terminated"),
        (lambda r, d, t, v: r if t else r + v.max(), "qlearning", "With a discount of 0"),
        (lambda r, d, t, v: r, "qlearning", "If all next values rise by 1"),
        (lambda r, d, t, v: r if t else r + d * v.mean(), "qlearning", "If the best next value"),
        (
            lambda r, d, t, v, next_action: r if t else r + d * v.max(),
            "sarsa",
            "The target has to follow the value of the next action",
        ),
        (best_left_out, "expected_sarsa", "With epsilon 1 all actions are equally probable"),
        (
            lambda r, d, t, v, epsilon: r if t else r + d * v.mean(),
            "expected_sarsa",
            "With epsilon 0 the policy is greedy",
        ),
    ],
)
def test_targets(target, kind, said):
    assert checker.check_target(target, kind).startswith(said)


MEANS = [0.2, 0.9, 0.5]
ARMS = [0, 1, 2, 0, 1]


@pytest.mark.parametrize(
    ("regret", "said"),
    [
        (np.cumsum([0.7, 0.0, 0.4, 0.7, 0.0]), "Right."),
        (..., "Not done yet."),
        (np.ones(3), "The shape has to be (5,)"),
        ([0.7, 0.0, 0.4, 0.7, 0.0], "Regret never falls, but yours does at pull 2."),
        (np.cumsum([0.7, 0.1, 0.4, 0.7, 0.1]), "A pull of the best arm loses nothing"),
        (np.cumsum([1.0, 0.0, 0.4, 0.0, 0.0]), "Pulls of arm 0 add different amounts."),
        (np.cumsum([0.2, 0.0, 0.4, 0.2, 0.0]), "A pull of arm 0 adds the wrong amount"),
    ],
)
def test_regret(regret, said):
    assert checker.check_regret(MEANS, ARMS, regret).startswith(said)


@pytest.mark.parametrize(
    ("index", "said"),
    [
        (lambda mean, n, t: mean + np.sqrt(2 * np.log(t) / n), "Right."),
        (lambda mean, n, t: None, "It cannot be called or gives no number"),
        (lambda mean, n, t: np.sqrt(2 * np.log(t) / n), "If the mean rises by 0.1"),
        (lambda mean, n, t: mean, "The index has to lie above the mean"),
        (lambda mean, n, t: mean + np.log(t) / n, "With four times as many pulls"),
        (lambda mean, n, t: mean + np.sqrt(2 * t / n), "The bonus has to grow with all pulls"),
        (lambda mean, n, t: mean + np.sqrt(np.log(t) / n), "The form is right, but a factor"),
    ],
)
def test_indices(index, said):
    assert checker.check_index(index).startswith(said)
