"""The checks of the lesson on n steps and traces: right answers pass, mistakes are named."""

import importlib
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from envs.known_models import transition_model

# A lesson imports it as a script in its folder does.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs" / "lessons"))
checks = importlib.import_module("trace_checks")

WALK = transition_model(gym.make("RandomWalk-v0", n_states=19, left_reward=-1))
ZEROS = np.zeros(21)


def n_step_return(rewards, discount, value_after, *, first=0, powers=None):
    n = len(rewards)
    kept = discount ** np.arange(first, n + first)
    return (kept * np.asarray(rewards)).sum() + discount ** (
        n if powers is None else powers(n)
    ) * value_after


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (n_step_return, "Right."),
        (lambda r, d, v: None, "Not done yet"),
        (lambda r: r, "It fails when it is called"),
        (lambda r, d, v: 1.0, "Where all rewards and the value are 0"),
        (lambda r, d, v: sum(r) + d * v, "With 3 steps: the rewards are not discounted"),
        (lambda r, d, v: n_step_return(r, d, v, first=1), "With 3 steps: the first reward is disc"),
        (lambda r, d, v: n_step_return(r[::-1], d, v), "With 3 steps: the last reward counts most"),
        (lambda r, d, v: np.mean(r), "With 3 steps: that is the mean"),
        (lambda r, d, v: max(r) + d * v, "What one reward counts depends on the others"),
        (lambda r, d, v: n_step_return(r, d, 0) * v, "What one reward counts"),
        (lambda r, d, v: r[0] + d**3 * v, "With 3 steps: reward 1 (the first is 0) counts 0 times"),
        (lambda r, d, v: n_step_return(r, d, 0), "With 3 steps: the value of the state after"),
        (
            lambda r, d, v: n_step_return(r, d, v, powers=lambda n: n - 1),
            "With 3 steps: the value after the last step is discounted too little",
        ),
        (
            lambda r, d, v: n_step_return(r, d, v, powers=lambda n: n + 1),
            "With 3 steps: the value after the last step is discounted too much",
        ),
        (
            lambda r, d, v: n_step_return(r, d, v, powers=lambda n: 3),
            "With 1 step: the value after the last step is discounted too much",
        ),
        (lambda r, d, v: n_step_return(r[:3], d, v, powers=lambda n: len(r)), "With 5 steps: rew"),
    ],
)
def test_returns(answer, said):
    assert checks.check_return(answer).startswith(said)


def n_step_means(values, n):
    """Means of the n-step returns."""
    for _ in range(n):
        values = checks.looked_ahead(WALK, 1.0, values)[:, 0]
    return values


def lambda_means(values, decay, weights=None, n=200):
    chances = (1 - decay) * decay ** np.arange(n) if weights is None else weights(np.arange(n))
    means = np.zeros(21)
    for chance in chances:
        values = n_step_means(values, 1)
        means += chance * values
    return means


def test_means_of_the_lambda_return():
    values = np.random.default_rng(0).normal(size=21)
    for decay, given in ((0.8, ZEROS), (0.3, values), (0.8, values)):
        means = lambda_means(given, decay)
        assert checks.check_lambda_targets(WALK, decay, given, means) == "Right."
        means[4] += 0.01
        said = checks.check_lambda_targets(WALK, decay, given, means)
        assert "places, most in state 4: yours is higher" in said


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (..., "Not done yet."),
        (np.zeros(19), "The shape has to be (21,)"),
        (n_step_means(ZEROS, 1), "They look one step ahead only"),
        ((np.arange(21) - 10) / 10, "No estimate is in them any more"),
        (lambda_means(ZEROS, 0.8, lambda k: 0.8**k), "The weights have to sum up to 1"),
        (lambda_means(ZEROS, 0.8, lambda k: 0.2 * 0.8 ** (k + 1)), "All weights are too small"),
        (n_step_means(ZEROS, 5), "The two sides"),
    ],
)
def test_mistakes_in_means_are_named(answer, said):
    assert checks.check_lambda_targets(WALK, 0.8, ZEROS, answer).startswith(said)


def test_a_sum_that_ends_too_early_is_near():
    said = checks.check_lambda_targets(WALK, 0.8, ZEROS, lambda_means(ZEROS, 0.8, n=20))
    assert said.endswith("They are near: perhaps the sum ends too early.")


def replacing(trace, state, discount, decay):
    trace = discount * decay * trace
    trace[state] = 1
    return trace


def changed(visited, faded=lambda trace, discount, decay: discount * decay * trace):
    """A step that differs from the right one in what is given."""

    def step(trace, state, discount, decay):
        after = faded(trace, discount, decay)
        after[state] = visited(after[state], discount * decay)
        return after

    return step


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (replacing, "Right."),
        (lambda *_: None, "Not done yet: the function gives nothing back."),
        (lambda trace: trace, "It fails when it is called"),
        (lambda *_: np.ones(3), "The shape has to be (4,)"),
        (changed(lambda own, _: own + 1), "That is the accumulating trace"),
        (changed(lambda own, rate: rate), "The state that is visited now"),
        (changed(lambda own, _: max(own, 1)), "The visited state's trace is not"),
        (changed(lambda own, _: own), "The visited state's trace is not 1."),
        (changed(lambda *_: 1, lambda trace, *_: 0 * trace), "The other states are forgotten"),
        (changed(lambda *_: 1, lambda trace, *_: trace), "The traces of the other states have to"),
        (changed(lambda *_: 1, lambda trace, d, _: d * trace + 0.1), "A state that was never"),
        (
            changed(lambda *_: 1, lambda trace, d, _: d * trace),
            "The traces of the other states do not fade enough: lambda",
        ),
        (
            changed(lambda *_: 1, lambda trace, _, decay: decay * trace),
            "The traces of the other states do not fade enough: the discount",
        ),
        (
            changed(lambda *_: 1, lambda trace, *_: 0.1 * trace),
            "The traces of the other states do not fade by the right",
        ),
    ],
)
def test_replacing_traces(answer, said):
    assert checks.check_replacing_trace(answer).startswith(said)
