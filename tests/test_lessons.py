"""The checks of the lessons: right answers pass, and each common mistake is named."""

import importlib
import math
import sys
from pathlib import Path

import gymnasium as gym
import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy import special

from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.mdp import value_iteration

# A lesson imports them as a script in its folder does.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs" / "lessons"))
checker, exploration, traces, networks, figures = map(
    importlib.import_module,
    ("checker", "exploration_checks", "trace_checks", "network_checks", "verdict_checks"),
)

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


def divergence(p, q):
    return special.rel_entr(p, q) + special.rel_entr(1 - p, 1 - q)


def bonus_target(bonus, *, at_the_end=True):
    """Q-learning's target and a bonus."""

    def target(reward, discount, terminated, next_values, count, scale):
        added = bonus(count, scale)
        if terminated:
            return reward + added * at_the_end
        return reward + added + discount * next_values.max()

    return target


WALK = transition_model(gym.make("RandomWalk-v0", n_states=19, left_reward=-1))
ZEROS = np.zeros(21)


def n_step_return(rewards, discount, value_after, *, first=0):
    n = len(rewards)
    kept = discount ** np.arange(first, n + first)
    return (kept * np.asarray(rewards)).sum() + discount**n * value_after


def lambda_means(values, decay, n=200):
    means = np.zeros(21)
    for chance in (1 - decay) * decay ** np.arange(n):
        values = traces.looked_ahead(WALK, 1.0, values)[:, 0]
        means += chance * values
    return means


def doubled(choosing, judging):
    """Targets that choose by one array of values and judge by another: online 0, lagging 1."""

    def told(rewards, terminated, online, lagging, discount):
        chosen = (online, lagging)[choosing].argmax(axis=1)
        values = (online, lagging)[judging][np.arange(len(chosen)), chosen]
        return rewards + discount * ~terminated * values

    return told


def ahead(values, discount=DISCOUNT, **more):
    return checker.looked_ahead(MODEL, discount, values, **more)


SLIPPERY = transition_model(gym.make("Warehouse-v0", slip=0.1, shelf_reward=-5))


def moves(values, discount, **more):
    return checker.looked_ahead(SLIPPERY, discount, values, **more)


def swept(values, order):
    for state in order:
        values[state] = ahead(values)[state].max()
    return list(values)


CLIFF = transition_model(gym.make("CliffWalking-v1"))


def table_of(epsilon):
    """The best action values of somebody who stumbles."""
    table = np.zeros((48, 4))
    for _ in range(400):
        follows = (1 - epsilon) * table.max(axis=1) + epsilon * table.mean(axis=1)
        table = checker.looked_ahead(CLIFF, 1.0, follows)
    return table


def optimist(n, e):
    """The treasure's chance, and the cost of moves to the right before and after the first left."""
    right = 1 - e / 2
    on_the_way = sum(right**k for k in range(n)) * right
    off = (e / 2) * (n - sum(right**k for k in range(n)))
    return right**n - 0.01 / n * (on_the_way + off)


SEARCHED = np.array([[0.1, 0.3], [0.5, 0.7], [0.2, 0.2]])
# What each check says of an answer.
CASES = {
    checker.check_index: [
        (lambda mean, n, t: mean + np.sqrt(2 * np.log(t) / n), "Right."),
        (lambda mean, n, t: mean + np.log(t) / n, "With four times as many pulls"),
        (lambda mean, n, t: mean + np.sqrt(np.log(t) / n), "The form is right, but a factor"),
    ],
    checker.check_epsilon: [
        (lambda t: 10 / t, "Right."),
        (lambda t: np.log(t) / t, "Right."),
        (lambda t: max(0.01, 1 / t), "It does not fall for ever"),
        (lambda t: t**-0.5, "It falls too slowly: regret grows like the power 0.5 of the pulls."),
        (lambda t: t**-2.0, "It falls too fast"),
        (lambda t: 0.99**t, "From some pull on it never explores"),
    ],
    exploration.check_returns: [
        (optimist, "Right."),
        (lambda n, e: (1 - e / 2) ** n, "For 3 rows and epsilon 0: that is the chance of the"),
        (lambda n, e: (1 - e / 2) ** n - 0.01 * (1 - e / 2), "For 3 rows and epsilon 0.5: out of"),
        (lambda n, e: optimist(n, min(2 * e, 1)), "For 3 rows and epsilon 0.5: a random action"),
    ],
    traces.check_trace_length: [
        (lambda e, n: n / (e * (n - 1)), "Right."),
        (lambda e, n: 1 / e, "A random action can be a best one too"),
        (lambda e, n: n / (e * (n - 1)) - 1, "The step of the visit itself counts"),
        (lambda e, n: 1 / (1 - e * (n - 1) / n), "The wrong way round"),
    ],
    exploration.check_divergence: [
        (divergence, "Right."),
        (lambda p, q: p * math.log(p / q), "It falls below 0. A pull can pay 1"),
        (lambda p, q: divergence(q, p), "The two are the wrong way round"),
    ],
    exploration.check_episodes: [
        (lambda n, e: (2 / e) ** n, "Right."),
        (lambda n, e: (e / 2) ** n, "That is the chance that one episode"),
        (lambda n, e: (2 / e) ** (n - 1), "There is one move too few"),
    ],
    exploration.check_bonus_target: [
        (bonus_target(lambda n, s: s / math.sqrt(n)), "Right."),
        (bonus_target(lambda n, s: s / math.sqrt(n), at_the_end=False), "There is no bonus at the"),
        (bonus_target(lambda n, s: s / n), "The bonus falls too fast"),
    ],
    traces.check_return: [
        (n_step_return, "Right."),
        (lambda r, d, v: sum(r) + d * v, "With 3 steps: the rewards are not discounted"),
        (lambda r, d, v: n_step_return(r, d, v, first=1), "With 3 steps: the first reward is disc"),
    ],
    traces.check_replacing_trace: [
        (lambda trace, s, d, k: np.where(np.arange(len(trace)) == s, 1, d * k * trace), "Right."),
        (lambda trace, s, d, k: d * k * trace + np.eye(len(trace))[s], "That is the accumulating"),
    ],
    networks.check_targets: [
        (lambda r, t, v, d: r + d * ~t * v.max(axis=1), "Right."),
        (lambda r, t, v, d: (r + d * v.T).T, "The shape has to be (12,), one target for each step"),
        (lambda r, t, v, d: r + d * v.max(axis=1), "When the episode has terminated nothing"),
    ],
    networks.check_double_targets: [
        (doubled(0, 1), "Right."),
        (doubled(1, 0), "The roles are the wrong way round"),
    ],
    networks.check_loss: [
        (lambda e: e**2 / 2 if abs(e) < 1 else abs(e) - 0.5, "Right."),
        (lambda e: e**2 / 2 if e < 1 else e - 0.5, "An error above and one below"),
        (lambda e: e**2 / 2, "Beyond 1 it has to be a straight line"),
    ],
    figures.check_score: [
        (lambda x, top, low: (x - low) / (top - low), "Right."),
        (lambda x, top, low: top - x, "The optimum has the score 0"),
        (lambda x, top, low: (x - low) / top, "The optimum has to have the sc"),
    ],
    figures.check_gain: [
        (lambda r, a, e: min(r * a, np.clip(r, 1 - e, 1 + e) * a), "Right."),
        (lambda r, a, e: np.clip(r, 1 - e, 1 + e) * a, "A good action that has become much less"),
    ],
    figures.check_unseen: [
        (lambda n: 1 - 0.05 ** (1 / n), "Right."),
        (lambda n: 1 - 0.95 ** (1 / n), "With that share, 95 % of all sets of runs"),
        (lambda n: 0.05 ** (1 / n), "That is the share of runs that do not fail."),
        (lambda n: 1 / n, "With yours, 10 runs show no failure with a probability of 0.35."),
    ],
    (lambda answer: checker.check_policy_values(MODEL, RANDOM, DISCOUNT, answer)): [
        (np.ones(15), "The shape has to be (16,), one value for each state; it is (15,)."),
        (value_iteration(MODEL, DISCOUNT).values, "They are those of an agent that always takes"),
        (solved(RANDOM, discount=1 - 1e-12), "The discount is missing"),
    ],
    (lambda answer: checker.check_action_values(MODEL, DISCOUNT, answer)): [
        (ahead, "Right."),
        (lambda v: ..., "Not done yet"),
        (lambda v: ahead(v, endless=True), "They go on after the end"),
        (lambda v: ahead(v, 1.0), "The discount is missing."),
        (lambda v: ahead(v) / 4, "The probability of the action counts"),
        (lambda v: ahead(v) - np.eye(16, 4, -12), "The two sides of the equation differ at 2 of 6"),
        (lambda v: ahead(v).max(axis=1), "The shape has to be (16, 4)"),
    ],
    (lambda answer: checker.check_greedy(SLIPPERY, answer)): [
        (lambda v, d: moves(v, d).argmax(axis=1), "Right."),
        (lambda v, d: [row.argmax() for row in moves(v, d)], "Right."),
        (lambda v, d: moves(v, 0.99).argmax(axis=1), "It is greedy for another discount"),
        (lambda v, d: moves(v, d, endless=True).argmax(axis=1), "It goes on after the end"),
        (lambda v, d: moves(v, d).argmin(axis=1), "61 states have a better action"),
        (lambda v, d: moves(v, d).max(axis=1), "Actions are the numbers 0 to 3."),
    ],
    (lambda answer: checker.check_improvable(MODEL, DISCOUNT, solved(RANDOM), answer)): [
        ([14, 0, 1, 2, 3, 4, 6, 8, 9, 10, 13], "Right."),
        ([14, 10, 13], "8 states are missing."),
        ([15], "In some of these states no episode goes on"),
    ],
    (lambda answer: checker.check_sweep(MODEL, DISCOUNT, answer)): [
        (swept, "Right."),
        (lambda v, order: ahead(v).max(axis=1), "Each state sees old values only."),
        (lambda v, order: swept(v, range(16)), "It goes from first to last"),
        (lambda v, order: swept(v, order[::-1]), "A new value is not the best"),
    ],
    (lambda answer: checker.check_threshold(SLIPPERY, 90, answer)): [
        (0.77, "Right."),
        (0.75, "A little above it, the best robot still never"),
        (0.8, "A little below it, the goal is still worth the way."),
        (77, "A discount lies between 0 and 1."),
    ],
    (lambda answer: checker.check_ways(CLIFF, answer)): [
        ([table_of(0.0)] * 5, "Right."),
        ([table_of(0.0)] * 4 + [table_of(0.1)], "On 1 of 5 seeds the way is longer"),
        (np.zeros((5, 48, 4)), "On seed 0 the greedy policy never arrives."),
        ([table_of(0.0)], "One table may be luck"),
    ],
    (lambda answer: figures.check_choice(SEARCHED, answer[0], [0.4, 0.5, 0.3], answer[1])): [
        ((1, 0.2), "Right."),
        ((1, -0.2), "The sign is wrong"),
        ((1, 0.3), "It is not the mean in the search less"),
        ((0, 0.2), "Another setting has the higher mean"),
    ],
    (lambda answer: checker.check_target(answer, "qlearning")): [
        (lambda r, d, t, v: r if t else r + d * v.max(), "Right."),
        (lambda r, d, t, v: r + d * v.max(), "When the episode has terminated"),
        (lambda r, d, t, v: r if t else r + d * v.mean(), "If the best next value"),
    ],
    (lambda answer: checker.check_target(answer, "sarsa")): [
        (lambda r, d, t, v, next_action: r if t else r + d * v[next_action], "Right."),
        (lambda r, d, t, v, next_action: r if t else r + d * v.max(), "The target has to follow"),
    ],
    (lambda answer: checker.check_target(answer, "expected_sarsa")): [
        (
            lambda r, d, t, v, epsilon: (
                r if t else r + d * (epsilon * v.mean() + (1 - epsilon) * v.max())
            ),
            "Right.",
        ),
        (lambda r, d, t, v, epsilon: r if t else r + d * v.mean(), "With epsilon 0 the policy"),
    ],
    (lambda answer: checker.check_regret([0.2, 0.9, 0.5], [0, 1, 2, 0, 1], answer)): [
        (np.cumsum([0.7, 0.0, 0.4, 0.7, 0.0]), "Right."),
        ([0.7, 0.0, 0.4, 0.7, 0.0], "Regret never falls, but yours does at pull 2."),
        (np.cumsum([0.2, 0.0, 0.4, 0.2, 0.0]), "A pull of arm 0 adds the wrong amount"),
    ],
    (lambda answer: traces.check_lambda_targets(WALK, 0.8, ZEROS, answer)): [
        (..., "Not done yet."),
        (traces.looked_ahead(WALK, 1.0, ZEROS)[:, 0], "They look one step ahead only"),
    ],
}


@pytest.mark.parametrize("place", range(len(CASES)))
def test_what_is_said_of_each_answer(place):
    check, rows = [*CASES.items()][place]
    for answer, said in rows:
        assert check(answer).startswith(said), said


@hypothesis.given(st.integers(0, 2**32 - 1), st.floats(0, 0.99))
def test_values_of_any_policy_are_right(seed, discount):
    policy = np.random.default_rng(seed).dirichlet(np.ones(4), size=16)
    values = solved(policy, discount)
    assert checker.check_policy_values(MODEL, policy, discount, values) == "Right."
    state = int(np.random.default_rng(seed).choice(np.flatnonzero(MODEL.reachable)))
    values[state] += 0.01
    said = checker.check_policy_values(MODEL, policy, discount, values)
    assert f"most in state {state}: yours is higher" in said


def test_optimal_values():
    best = value_iteration(MODEL, DISCOUNT).values
    assert checker.check_optimal_values(MODEL, DISCOUNT, best) == "Right."
    few = np.zeros(16)
    for _ in range(25):
        few = checker.looked_ahead(MODEL, DISCOUNT, few).max(axis=1)
    assert "too few sweeps" in checker.check_optimal_values(MODEL, DISCOUNT, few)
    said = checker.check_optimal_values(MODEL, DISCOUNT, solved(RANDOM))
    assert said.startswith("They are those of random actions")


def test_a_reply_does_not_hold_the_answer():
    values = solved(RANDOM)
    wrong = values + 0.5 * np.eye(16)[9]
    assert f"{values[9]:.3f}" not in checker.check_policy_values(MODEL, RANDOM, DISCOUNT, wrong)


def test_means_of_the_lambda_return():
    values = np.random.default_rng(0).normal(size=21)
    for decay, given in ((0.8, ZEROS), (0.3, values)):
        means = lambda_means(given, decay)
        assert traces.check_lambda_targets(WALK, decay, given, means) == "Right."
        means[4] += 0.01
        said = traces.check_lambda_targets(WALK, decay, given, means)
        assert "places, most in state 4: yours is higher" in said
    said = traces.check_lambda_targets(WALK, 0.8, ZEROS, lambda_means(ZEROS, 0.8, n=20))
    assert said.endswith("They are near: perhaps the sum ends too early.")
