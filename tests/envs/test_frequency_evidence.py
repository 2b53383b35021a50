"""Likelihood ratios of counts: closed forms, and that they are a fair bet."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.checking import frequencies, log_evidence


@pytest.mark.parametrize(
    ("count", "trials", "mixture"),
    [(0, 0, 1.0), (1, 1, 1 / 2), (1, 2, 1 / 8), (2, 2, 3 / 8), (0, 3, 5 / 16)],
)
def test_the_mixture_by_hand(count, trials, mixture):
    """Krichevsky and Trofimov's estimator: (successes + 1/2) / (draws + 1), step by step."""
    for prob in (0.2, 0.5, 0.97):
        ratio = mixture / (prob**count * (1 - prob) ** (trials - count))
        found = log_evidence(np.array(count), np.array(trials), np.array(prob))
        assert math.exp(found) == pytest.approx(ratio)


@given(st.floats(0.001, 0.999), st.integers(1, 9))
def test_under_the_right_probability_it_is_a_fair_bet(prob, n):
    """Its mean is one after any number of draws, which Ville's inequality needs."""
    counts = np.arange(n + 1)
    weights = [math.comb(n, k) * prob**k * (1 - prob) ** (n - k) for k in counts]
    ratios = np.exp(log_evidence(counts, np.array(n), np.array(prob)))
    assert np.sum(weights * ratios) == pytest.approx(1)


def test_it_is_a_fair_bet_whenever_one_stops():
    """After each first success, or eight draws: the mean over all paths."""
    prob, total = 0.3, 0.0
    for path in itertools.product((0, 1), repeat=8):
        stop = path.index(1) + 1 if 1 in path else 8
        count = sum(path[:stop])
        likelihood = prob ** sum(path) * (1 - prob) ** (8 - sum(path))
        ratio = log_evidence(np.array(count), np.array(stop), np.array(prob))
        total += likelihood * math.exp(ratio)
    assert total == pytest.approx(1)


def test_what_is_certain_says_nothing():
    found = log_evidence(np.array([0, 5]), np.array([5, 5]), np.array([0.0, 1.0]))
    np.testing.assert_array_equal(found, [-np.inf, -np.inf])


def test_counts_by_group():
    shared, other = [0.5, 0.5, 0.0], [0.2, 0.3, 0.5]
    probabilities = np.array([shared, shared, other, other])
    drawn = np.array([2, 1, 2, 0, 0, 1])
    groups, counts, evidence = frequencies(np.array([3, 0, 3, 3, 0, 2]), drawn, probabilities)
    np.testing.assert_array_equal(groups, [0, 2, 3])
    np.testing.assert_array_equal(counts, [[1, 1, 0], [0, 1, 0], [1, 0, 2]])
    assert evidence[0, 2] == -np.inf
    expected = log_evidence(np.array([1, 0, 2]), np.array(3), probabilities[3])
    np.testing.assert_allclose(evidence[2], expected)
