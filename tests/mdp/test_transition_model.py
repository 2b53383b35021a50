"""The transition model: what it accepts, what it refuses, what it derives."""

import pickle

import numpy as np
import pytest

from mdp import TransitionModel


def arrays():
    """Two states, two actions, at most two outcomes; the second state is never entered alive."""
    return {
        "prob": np.array([[[0.25, 0.75], [1.0, 0.0]], [[1.0, 0.0], [0.5, 0.5]]]),
        "next_state": np.array([[[0, 1], [0, 0]], [[1, 0], [0, 1]]]),
        "reward": np.array([[[2.0, 4.0], [-1.0, 99.0]], [[0.0, 0.0], [7.0, 7.0]]]),
        "terminated": np.array([[[False, True], [False, False]], [[False, False], [False, False]]]),
        "initial": np.array([1.0, 0.0]),
    }


def test_sizes_and_derived_arrays():
    model = TransitionModel(**arrays())
    assert (model.n_states, model.n_actions, model.n_outcomes) == (2, 2, 2)
    assert model.expected_reward.tolist() == [[3.5, -1.0], [0.0, 7.0]]
    assert model.reachable.tolist() == [True, False]
    copy = pickle.loads(pickle.dumps(model))
    for name in arrays():
        np.testing.assert_array_equal(getattr(copy, name), getattr(model, name))


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("prob", (1, 0, 0), 0.9, "state 1, action 0 has probabilities that do not sum to one"),
        ("prob", (0, 1), [1.5, -0.5], r"state 0, action 1 has a probability outside \[0, 1\]"),
        ("next_state", (1, 1, 0), 2, r"state 1, action 1 has a next state outside 0..1"),
        ("reward", (0, 0, 1), np.inf, "state 0, action 0 has a reward that is not finite"),
        ("initial", 0, 0.5, "initial sums to 0.5, it must sum to one"),
    ],
)
def test_wrong_arrays_are_refused(name, place, value, message):
    given = arrays()
    given["prob"][1, 1] = [0.5, 0.5 + 5e-10]  # rounding is accepted
    TransitionModel(**given)
    given[name][place] = value
    with pytest.raises(ValueError, match=message):
        TransitionModel(**given)
    with pytest.raises(ValueError, match=r"prob has shape \(2, 4\)"):
        TransitionModel(**{**given, "prob": given["prob"].reshape(2, 4)})


def test_variances_of_rewards_are_checked():
    variance = np.ones((2, 2, 2))
    assert TransitionModel(**arrays(), reward_variance=variance).reward_variance is not None
    variance[1, 0, 1] = -1
    with pytest.raises(ValueError, match="state 1, action 0 has a variance of the reward"):
        TransitionModel(**arrays(), reward_variance=variance)


def test_from_gymnasium_pads_keeps_the_order_and_refuses_gaps():
    outcomes = [(0.25, 1, 1.0, True), (0.5, 0, 2.0, False), (0.25, 1, 1.0, True)]
    P = {  # noqa: N806 (Gymnasium's own name)
        0: {0: outcomes, 1: [(1.0, 1, 3.0, False)]},
        1: {0: [(1.0, 0, 4.0, False)], 1: [(1.0, 1, 5.0, True)]},
    }
    model = TransitionModel.from_gymnasium(P, [1, 0])
    assert model.prob[0].tolist() == [[0.25, 0.5, 0.25], [1.0, 0.0, 0.0]]
    assert model.next_state[0, 0].tolist() == [1, 0, 1]
    assert model.reward[:, 1, 0].tolist() == [3.0, 5.0]
    assert model.terminated[0, 0].tolist() == [True, False, True]
    row = {0: [(1.0, 0, 0.0, True)]}
    for broken, message in (
        ({0: row, 2: {}}, "P has no state 1"),
        ({0: row, 1: {}}, "state 1 must have the actions 0 to 0"),
    ):
        with pytest.raises(ValueError, match=message):
            TransitionModel.from_gymnasium(broken, np.ones(len(broken)) / len(broken))
