"""Action choice: exact where the random numbers are given, counted where they are not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from agents.common.exploration import (
    BOLTZMANN,
    EPSILON_GREEDY,
    GAUSSIAN_NOISE,
    action_probabilities,
    action_probability,
    boltzmann_action,
    choose_action,
    draws_per_choice,
    epsilon_greedy_action,
    expected_value,
    greedy_action,
    noisy_greedy_action,
)

N_DRAWS = 20_000
VALUES = np.array([1.0, 3.0, 3.0, 2.0])

finite_values = arrays(
    np.float64, st.integers(1, 6), elements=st.floats(-50, 50, allow_subnormal=False)
)


@pytest.mark.parametrize(("uniform", "action"), [(0.0, 1), (0.49, 1), (0.5, 2), (0.99, 2)])
def test_ties_share_the_unit_interval(uniform, action):
    assert greedy_action(VALUES, uniform) == action


@given(finite_values)
def test_uniform_zero_is_argmax(values):
    assert greedy_action(values, 0.0) == values.argmax()


@given(finite_values, st.floats(0, 1, exclude_max=True))
def test_greedy_action_is_a_best_one(values, uniform):
    assert values[greedy_action(values, uniform)] == values.max()


@pytest.mark.parametrize(
    ("draws", "action"),
    [
        ([0.29, 0.0], 0),
        ([0.29, 0.99], 3),
        ([0.3, 0.0], 1),
        ([0.3, 0.99], 2),
    ],
)
def test_epsilon_greedy_explores_below_epsilon(draws, action):
    assert epsilon_greedy_action(VALUES, 0.3, 1.0, np.array(draws)) == action


def test_tie_scale_zero_takes_the_first():
    assert epsilon_greedy_action(VALUES, 0.3, 0.0, np.array([0.9, 0.99])) == 1


def test_boltzmann_inverts_the_cumulative_probabilities():
    values = np.log([1.0, 2.0, 5.0])
    chosen = [boltzmann_action(values, 1.0, np.array([u])) for u in (0.0, 0.12, 0.13, 0.37, 0.38)]
    assert chosen == [0, 0, 1, 1, 2]


def test_boltzmann_does_not_overflow():
    assert boltzmann_action(np.array([1e6, 0.0]), 1e-3, np.array([0.999])) == 0


def test_a_temperature_that_has_fallen_to_0_is_the_limit():
    values = np.array([1.0, 3.0, 3.0, 0.0])
    chosen = [boltzmann_action(values, 0.0, np.array([u])) for u in (0.0, 0.49, 0.51, 0.99)]
    assert chosen == [1, 1, 2, 2]
    expected = [0.0, 0.5, 0.5, 0.0]
    found = [action_probability(BOLTZMANN, values, 0.0, 1.0, action) for action in range(4)]
    assert found == expected
    matrix = action_probabilities(BOLTZMANN, values[None], 0.0, random_ties=True)
    assert matrix.tolist() == [expected]
    assert expected_value(BOLTZMANN, values, 0.0) == 3.0


def test_noise_is_added_to_the_values():
    draws = np.array([0.0, -1.0, 0.0, 1.5])
    assert noisy_greedy_action(VALUES, 1.0, draws) == 3
    assert noisy_greedy_action(VALUES, 0.1, draws) == 2


@pytest.mark.parametrize(("strategy", "rate"), [(EPSILON_GREEDY, 0.2), (BOLTZMANN, 0.7)])
def test_frequencies_match_the_probabilities(strategy, rate):
    rng = np.random.default_rng(0)
    draws = rng.random((N_DRAWS, draws_per_choice(strategy, len(VALUES))))
    chosen = [choose_action(strategy, VALUES, rate, 1.0, row) for row in draws]
    frequencies = np.bincount(chosen, minlength=len(VALUES)) / N_DRAWS
    expected = action_probabilities(strategy, VALUES[None], rate, random_ties=True)[0]
    # Four standard errors of a frequency are at most 4 * 0.5 / sqrt(20,000).
    np.testing.assert_allclose(frequencies, expected, atol=0.0142)


@given(finite_values, st.floats(0.05, 1))
def test_expected_value_is_the_mean_under_the_probabilities(values, rate):
    for strategy in (EPSILON_GREEDY, BOLTZMANN):
        for random_ties in (True, False):
            probabilities = action_probabilities(
                strategy, values[None], rate, random_ties=random_ties
            )
            assert probabilities.sum() == pytest.approx(1)
            assert expected_value(strategy, values, rate) == pytest.approx(
                float(probabilities[0] @ values), rel=1e-9, abs=1e-9
            )


def test_noise_has_no_probabilities():
    with pytest.raises(ValueError, match="closed-form"):
        action_probabilities(GAUSSIAN_NOISE, VALUES[None], 1.0, random_ties=True)


@pytest.mark.parametrize("random_ties", [True, False])
@pytest.mark.parametrize(("strategy", "rate"), [(EPSILON_GREEDY, 0.3), (BOLTZMANN, 0.7)])
def test_one_probability_is_that_of_the_matrix(strategy, rate, random_ties):
    # Ties between the best, between others, and between all.
    for row in ([1.0, 3.0, 3.0, 0.0], [5.0, 2.0, 2.0, 1.0], [4.0] * 4, [0.0, 1.0, 2.0, 9.0]):
        values = np.array(row)
        expected = action_probabilities(strategy, values[None], rate, random_ties=random_ties)[0]
        found = [
            action_probability(strategy, values, rate, float(random_ties), action)
            for action in range(4)
        ]
        np.testing.assert_allclose(found, expected, rtol=1e-14)
