"""The least mean is seldom too high, and comes near the mean."""

import math

import numpy as np
import pytest

from verdicts.resampling import least_mean


def test_as_worked_out():
    """Variance 1/3 of 0, 1, 0, 1 is taken with n - 1; log(2 / level) is 2 by choice."""
    level = 2 * math.exp(-2)
    expected = 0.5 - math.sqrt(2 * (1 / 3) * 2 / 4) - 7 * 1 * 2 / (3 * 3)
    assert least_mean(np.array([0.0, 1.0, 0.0, 1.0]), 0.0, 1.0, level) == pytest.approx(expected)


def test_what_is_rare_and_was_not_seen_is_reckoned_with():
    bound = least_mean(np.full(10_000, 500.0), 0.0, 500.0, 0.001)
    assert 499 < bound < 500


def test_it_is_too_high_no_more_often_than_it_may_be():
    """Of values that are mostly 1 and rarely 0, where the mean of few says little."""
    rng = np.random.default_rng(0)
    draws = (rng.random((2000, 100)) < 0.95).astype(float)
    too_high = np.mean([least_mean(values, 0.0, 1.0, 0.1) > 0.95 for values in draws])
    assert too_high <= 0.1
