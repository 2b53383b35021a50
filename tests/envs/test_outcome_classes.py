"""Outcomes that nobody can tell apart, and what uniform numbers choose among them."""

import numpy as np
import pytest

from envs.checking import OutcomeClasses
from mdp import TransitionModel


@pytest.fixture
def classes():
    """State 0: two equal outcomes around another; state 1: one, in three ways to write it."""
    table = {
        0: {
            0: [(0.25, 1, 0.1, False), (0.5, 0, 0.1, False), (0.25, 1, 0.1, False)],
            1: [(0.5, 0, 2.0, False), (0.0, 1, 2.0, False), (0.5, 1, 2.0, True)],
        },
        1: {
            0: [(0.5, 1, 0.3, False), (0.5, 1, 0.1 + 0.2, False)],
            1: [(0.5, 1, 3.0, False), (0.5, 0, 4.0, False)],
        },
    }
    return OutcomeClasses(TransitionModel.from_gymnasium(table, [1.0, 0.0]))


def test_equal_outcomes_are_one(classes):
    single = [float(np.float32(reward)) for reward in (0.1, 0.3)]
    assert list(classes.ids) == [
        (0, 1, single[0], False),
        (0, 0, single[0], False),
        (1, 0, 2.0, False),
        (1, 1, 2.0, True),
        (2, 1, single[1], False),
        (3, 1, 3.0, False),
        (3, 0, 4.0, False),
    ]
    np.testing.assert_array_equal(classes.row, [0, 0, 1, 1, 2, 3, 3])
    np.testing.assert_array_equal(classes.place, [0, 1, 0, 1, 0, 0, 1])
    np.testing.assert_array_equal(classes.row_prob, [[0.5, 0.5], [0.5, 0.5], [1, 0], [0.5, 0.5]])


def test_rows_with_the_same_probabilities_share_a_pattern(classes):
    pattern = classes.pattern
    assert pattern[0] == pattern[1] == pattern[3] != pattern[2]
    np.testing.assert_array_equal(classes.pattern_prob[pattern], classes.row_prob)


def test_probabilities_of_what_is_seen(classes):
    assert classes.prob_of((1, 1, 2.0, True)) == 0.5
    assert classes.prob_of((1, 1, 2.0, False)) == 0.0
    assert classes.prob_of((2, 1, float(np.float32(0.3)), False)) == 1.0


def test_what_uniform_numbers_choose(classes):
    rows = np.array([0, 0, 0, 0, 1, 1, 2, 2])
    uniforms = np.array([0.0, 0.2499, 0.25, 0.75, 0.4, 0.5, 0.4, 0.5])
    found, rewards = classes.predicted(rows, uniforms)
    np.testing.assert_array_equal(found, [0, 0, 1, 0, 2, 3, 4, 4])
    # In full precision, in which the last two differ.
    np.testing.assert_array_equal(rewards, [0.1, 0.1, 0.1, 0.1, 2.0, 2.0, 0.3, 0.1 + 0.2])


def test_many_numbers_are_looked_up_in_parts(classes, monkeypatch):
    rows, uniforms = np.arange(1000) % 4, np.linspace(0, 0.999, 1000)
    whole = classes.predicted(rows, uniforms)
    monkeypatch.setattr("envs.checking.MAX_TABLE", 21)
    np.testing.assert_array_equal(classes.predicted(rows, uniforms), whole)
