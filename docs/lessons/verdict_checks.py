"""Looks at answers to the exercises on PPO and on figures over seeds; see `checker`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from answer_faults import RIGHT, TOLERANCE, answering, fault_of_array, number_from


@answering
def check_score(score: Callable[..., float]) -> str:
    """Whether a function is the score: a straight line through two points.

    Args:
        score: called with a return, the optimum and the baseline.
    """

    def told(earned: float, optimum: float = 80.0, baseline: float = -20.0) -> float:
        return number_from(score, earned, optimum, baseline)

    best, nothing, between = told(80.0), told(-20.0), told(30.0)
    if abs(best) < TOLERANCE < abs(nothing):
        return "The optimum has the score 0: that is a gap, and the score goes the other way."
    if abs(best - 1) > TOLERANCE:
        return f"The optimum has to have the score 1; with yours it has {best:.4g}."
    if abs(nothing) > TOLERANCE:
        return f"The baseline has to have the score 0; with yours it has {nothing:.4g}."
    if abs(told(-120.0) + 1) > TOLERANCE:
        return "Who is worse than the baseline should be seen to be: its score lies below 0."
    if abs(between - 0.5) > TOLERANCE:
        return "In the middle between baseline and optimum the score has to be 0.5."
    if abs(told(7.0, 10.0, 5.0) - 0.4) > TOLERANCE:
        return "It is right for one optimum and one baseline, and not for others."
    return RIGHT


@answering
def check_gain(gain: Callable[..., float]) -> str:
    """Whether a function is PPO's bounded gain, by where it moves with the ratio.

    Args:
        gain: called with ratio, advantage and epsilon.
    """

    def told(ratio: float, advantage: float, epsilon: float = 0.2) -> float:
        return number_from(gain, ratio, advantage, epsilon)

    if abs(told(1.0, 3.0) - 3) > TOLERANCE or abs(told(1.0, -3.0) + 3) > TOLERANCE:
        return "Where new and old probability are equal the gain is the advantage."
    if any(abs(told(ratio, 2.0) - 2 * ratio) > TOLERANCE for ratio in (0.9, 1.1)):
        return "Within the bounds the gain is the ratio times the advantage."
    if any(abs(told(ratio, -2.0) + 2 * ratio) > TOLERANCE for ratio in (0.9, 1.1)):
        return "Within the bounds the gain is the ratio times the advantage, below 0 as well."
    return fault_of_bounds(told)


def fault_of_bounds(told: Callable[..., float]) -> str:
    """What is wrong with a gain where the ratio is out of bounds."""
    good_high, good_low = (told(ratio, 2.0) for ratio in (1.5, 0.5))
    bad_high, bad_low = (told(ratio, -2.0) for ratio in (1.5, 0.5))
    if np.allclose([good_high, good_low, bad_high, bad_low], [3, 1, -3, -1]):
        return "Nothing is bounded: a ratio far from 1 goes on counting in both directions."
    if abs(good_high - 2.4) > TOLERANCE:
        return "A good action (advantage above 0) must gain no more once the ratio is at its bound."
    if abs(good_low - 1) > TOLERANCE:
        return (
            "A good action that has become much less probable has to come back. With yours there "
            "is nothing to be gained by that: the bound holds where it should not."
        )
    if abs(bad_high + 3) > TOLERANCE:
        return (
            "A bad action (advantage below 0) that has become much more probable has to come back. "
            "With yours there is nothing to be gained by that. Is it the smaller of the two?"
        )
    if abs(bad_low + 1.6) > TOLERANCE:
        return "A bad action must gain no more by becoming still less probable than at the bound."
    return RIGHT if abs(told(1.5, 1.0, 0.1) - 1.1) < TOLERANCE else "Epsilon is not always 0.2."


@answering
def check_unseen(unseen: Callable[..., float]) -> str:
    """Whether a function gives the largest share of failing runs that n runs can miss.

    Args:
        unseen: called with the number of runs.
    """
    counts = (2, 10, 30)
    shares = np.array([number_from(unseen, n) for n in counts])
    if not ((shares > 0) & (shares < 1)).all():
        return "A share of runs lies between 0 and 1."
    if np.allclose(missed := (1 - shares) ** counts, 0.05, atol=TOLERANCE):
        return RIGHT
    if np.allclose(shares**counts, 0.05, atol=TOLERANCE):
        return "That is the share of runs that do not fail."
    if np.allclose(missed, 0.95, atol=TOLERANCE):
        return "With that share, 95 % of all sets of runs show no failure: it can be larger."
    return f"With yours, {counts[1]} runs show no failure with a probability of {missed[1]:.2g}."


@answering
def check_choice(search: Any, choice: Any, retest: Any, loss: Any) -> str:
    """Whether a setting is the best of a search, and loses that much on held-out seeds.

    Args:
        search: scores, a row for each setting and a column for each seed.
        choice: the answer, a row.
        retest: scores of the chosen setting on other seeds, shape (n,).
        loss: the answer, by how much the mean falls.
    """
    shape = np.shape(search) if np.ndim(search) == 2 else (4, 5)
    n_seeds = np.shape(retest) if np.ndim(retest) == 1 else (10,)
    wrong = fault_of_array(search, shape, "a row for each setting")
    wrong = wrong or fault_of_array(retest, n_seeds, "one score for each seed")
    if wrong or choice is Ellipsis or loss is Ellipsis:
        return wrong or "Not done yet."
    row, lost = number_from(lambda: choice), number_from(lambda: loss)
    means, known = np.mean(search, axis=1), np.asarray(retest, dtype=float)
    if row not in range(len(means)):
        return f"The choice is the number of a row, 0 to {len(means) - 1}."
    if means[int(row)] < means.max() - TOLERANCE:
        return "Another setting has the higher mean in the search."
    if np.isin(known, np.asarray(search)[int(row)]).all():
        return "These are the scores of the search. The retest needs seeds that had no part in it."
    if abs(lost + means.max() - known.mean()) < TOLERANCE < abs(lost):
        return "The sign is wrong: a loss is above 0 where the new seeds are worse."
    if abs(lost - (means.max() - known.mean())) > TOLERANCE:
        return "It is not the mean in the search less the mean on the new seeds, of this setting."
    return RIGHT
