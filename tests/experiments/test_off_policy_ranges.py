"""Where a log stops being one: each limit from both of its sides."""

import numpy as np
import pytest

from experiments.off_policy.estimators import (
    check_rewards,
    check_support,
    cross_fit,
    effective_sample_size,
    importance_weights,
)

TINY = 5e-324  # the smallest number above 0
JUST_ABOVE_1 = np.nextafter(1, 2)
HALF = np.full((3, 2), 0.5)


def weights_of(policy=HALF, arms=(0, 1, 0), propensities=(0.5, 0.5, 0.5)):
    return importance_weights(np.array(policy), np.array(arms), np.array(propensities))


# --- what is handed over --------------------------------------------------------------------------


@pytest.mark.parametrize("arms", [(0, 0, 0), (1, 1, 1), (0, 1, 1)])
def test_arms_from_the_first_to_the_last(arms):
    assert weights_of(arms=arms).tolist() == [1, 1, 1]


@pytest.mark.parametrize("arms", [(0, 1, -1), (-1, 0, 0), (-2, 0, 0), (0, 1, 2), (7, 0, 0)])
def test_codes_that_are_no_arms(arms):
    """Python would take -1 for the last arm."""
    with pytest.raises(ValueError, match="arms must lie between 0 and 1, as the policy's columns"):
        weights_of(arms=arms)


@pytest.mark.parametrize("propensity", [1e-300, 0.5, np.nextafter(1, 0), 1.0])
def test_propensities_above_0_and_up_to_1(propensity):
    assert weights_of(propensities=(0.5, propensity, 0.5))[1] == 0.5 / propensity


@pytest.mark.parametrize("propensity", [0.0, -TINY, -0.5, JUST_ABOVE_1, 1.5, np.nan, np.inf])
def test_numbers_that_are_no_propensities(propensity):
    with pytest.raises(ValueError, match=r"propensity of pull 2 is .*, it must be above 0 and at"):
        weights_of(propensities=(0.5, propensity, 0.5))


@pytest.mark.parametrize("row", [(0, 1), (1, 0), (0.3, 0.7), (0.5, 0.5 + 9e-7), (0.5, 0.5 - 9e-7)])
def test_rows_that_sum_to_1_but_for_rounding(row):
    assert weights_of(policy=[row, *HALF[1:]])[0] == row[0] / 0.5


@pytest.mark.parametrize(
    "row", [(0.5, 0.5 + 2e-6), (0.5, 0.5 - 2e-6), (-TINY, 1), (1.5, -0.5), (0.5, np.nan), (0, 0)]
)
def test_rows_that_are_no_distributions(row):
    with pytest.raises(ValueError, match=r"sum of the policy's probabilities of pull 2 is .*be 1$"):
        weights_of(policy=[HALF[0], row, HALF[2]])


@pytest.mark.parametrize(
    ("arms", "propensities"),
    [
        ((0, 1), (0.5, 0.5, 0.5)),
        ((0, 1, 0, 1), (0.5, 0.5, 0.5)),
        ((0, 1, 0), (0.5, 0.5)),
        ((0, 1, 0), (0.5, 0.5, 0.5, 0.5)),
        ([[0], [1], [0]], (0.5, 0.5, 0.5)),
    ],
)
def test_one_arm_and_one_propensity_for_each_pull(arms, propensities):
    with pytest.raises(ValueError, match=r"a policy of shape \(3, 2\) needs 3 arms and propens"):
        weights_of(arms=arms, propensities=propensities)


def test_no_pulls_have_no_weights():
    nothing = np.zeros(0)
    assert importance_weights(np.zeros((0, 2)), nothing.astype(np.int64), nothing).shape == (0,)


@pytest.mark.parametrize("reward", [0.0, -1e308, 1e308, TINY])
def test_rewards_of_any_size(reward):
    check_rewards(np.array([1.0, reward]), 2)


@pytest.mark.parametrize("reward", [np.nan, np.inf, -np.inf])
def test_rewards_that_are_no_numbers(reward):
    with pytest.raises(ValueError, match=r"reward of pull 2 is .*, it must be finite"):
        check_rewards(np.array([1.0, reward]), 2)


@pytest.mark.parametrize("shape", [(1,), (3,), (2, 1), ()])
def test_one_reward_for_each_pull(shape):
    with pytest.raises(ValueError, match="2 pulls need as many rewards"):
        check_rewards(np.ones(shape), 2)


# --- what a log can tell --------------------------------------------------------------------------


def supported(weights):
    """Whether a log with these weights is accepted, for a policy that it shows every arm of."""
    arms = np.arange(len(weights)) % 2
    try:
        check_support(np.full((len(weights), 2), 0.5), arms, np.asarray(weights))
    except ValueError as error:
        return str(error)
    return "supported"


@pytest.mark.parametrize(
    ("share", "outcome"), [(0.0, None), (TINY, "arm 1 was never logged"), (0.5, "arm 1 was never")]
)
def test_an_arm_that_was_never_logged_matters_where_the_policy_chooses_it(share, outcome):
    policy = np.array([[1 - share, share]] * 2)
    if outcome is None:
        check_support(policy, np.zeros(2, int), np.ones(2))
    else:
        with pytest.raises(ValueError, match=outcome):
            check_support(policy, np.zeros(2, int), np.ones(2))


@pytest.mark.parametrize(
    ("weight", "n", "outcome"),
    [
        # Equal weights below 1 have no spread: what files round remains, 0.02.
        (0.981, 100, "supported"),
        (0.979, 100, "the log holds too little of what the policy does: its weights are 0.979"),
        # Above 1 by x, the variance for a mean of 1 is x: x = 5 sqrt(x / n) + 0.02.
        (1.288, 100, "supported"),
        (1.289, 100, "the propensities are too small: the weights are 1.29 on average"),
        (1.0206, 1_000_000, "supported"),
        (1.0209, 1_000_000, "the propensities are too small: the weights are 1.02 on average"),
    ],
)
def test_equal_weights(weight, n, outcome):
    assert supported(np.full(n, weight)).startswith(outcome)


@pytest.mark.parametrize(
    ("n_twos", "outcome"),
    [
        # Of weights 0 and 2 the variance for a mean of 1 is 1: 100 may miss it by 5 / 10 + 0.02.
        (25, "supported"),
        (23, "the log holds too little of what the policy does: its weights are 0.46"),
        (0, "the policy would have made none of the logged pulls"),
    ],
)
def test_weights_of_which_some_are_0(n_twos, outcome):
    assert supported([2.0] * n_twos + [0.0] * (100 - n_twos)).startswith(outcome)


def test_what_weights_are_worth():
    assert effective_sample_size(np.zeros(3)) == 0
    assert effective_sample_size(np.array([0, 0, 5.0])) == 1
    assert effective_sample_size(np.array([1.0, 3.0])) == 16 / 10


@pytest.mark.parametrize(("n_pulls", "n_folds"), [(2, 2), (2, 5), (3, 2), (7, 3)])
def test_two_pulls_and_two_folds_are_enough(n_pulls, n_folds):
    zeros = np.zeros(n_pulls, np.int64)
    fitted = cross_fit(zeros, zeros, np.ones(n_pulls), 1, n_folds=n_folds)
    assert len(fitted.models) == min(n_folds, n_pulls)
    # No fold is empty, and none is larger than another by more than one pull.
    sizes = np.bincount(fitted.fold, minlength=len(fitted.models))
    assert sizes.max() - sizes.min() <= 1
    assert fitted.predicted.tolist() == [[1.0]] * n_pulls


@pytest.mark.parametrize(("n_pulls", "n_folds"), [(1, 2), (0, 2), (2, 1), (5, 1), (5, 0)])
def test_fewer_are_not(n_pulls, n_folds):
    zeros = np.zeros(n_pulls, np.int64)
    with pytest.raises(ValueError, match=f"or more: there are {n_pulls} and {n_folds}"):
        cross_fit(zeros, zeros, np.ones(n_pulls), 1, n_folds=n_folds)
