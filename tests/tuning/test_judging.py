"""What a setting is worth by its runs, worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.results import RunResults
from experiments.run_files import Curve
from pipeline.errors import UserError
from tuning import judging
from tuning.judging import UnjudgedError, judged, outcome_of

FIGURES = [0.0, 1.0, 0.9, 0.8, 0.1]


@pytest.mark.parametrize(
    ("objective", "is_cost", "value"),
    [
        ("mean", False, 0.56),
        ("iqm", False, (0.1 + 0.8 + 0.9) / 3),
        ("lower", False, 0.1),
        ("lower", True, 0.9),
        ("mean", True, 0.56),
    ],
)
def test_by_hand(objective, is_cost, value):
    assert judged(FIGURES, objective, is_cost=is_cost) == pytest.approx(value)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30), st.sampled_from(["mean", "iqm"]))
def test_a_cost_is_a_score_with_its_sign_turned(figures, objective):
    for each in (objective, "lower"):
        turned = judged([-figure for figure in figures], each, is_cost=True)
        assert turned == pytest.approx(-judged(figures, each, is_cost=False), abs=1e-6)
        assert min(figures) - 1e-6 <= -turned <= max(figures) + 1e-6


def outcome(toy, monkeypatch, figure, **row):
    figures = {"step": [10, 20, 30], "seconds": [0.5, 1.0, 1.5], "value": [0.0, 0.6, 0.4]}
    evaluations = Curve({}, {name: np.array(values) for name, values in figures.items()})
    row = {"seconds": 2.0, "n_timesteps": 30, "threshold": 0.5, **row}
    results = RunResults([row], [evaluations])
    monkeypatch.setattr(judging, "read_run", lambda *_: results)
    return outcome_of(toy.tuning(figure=figure), None)


@pytest.mark.parametrize(
    ("figure", "row", "value"),
    [
        ("score", {"score": 0.7, "final": 5.0}, 0.7),
        ("score", {"score": None, "final": 5.0}, 5.0),
        ("final", {"score": 0.7, "final": 5.0}, 5.0),
        ("regret", {"regret": 12.0}, 12.0),
        ("steps", {}, 20.0),
        ("seconds", {}, 1.0),
        ("steps", {"threshold": 0.9}, 60.0),  # never: two whole runs
        ("seconds", {"threshold": 0.9}, 4.0),
    ],
)
def test_the_figure_of_a_run(toy, monkeypatch, figure, row, value):
    found = outcome(toy, monkeypatch, figure, **row)
    assert (found.figure, found.seconds) == (value, 2.0)


@pytest.mark.parametrize("value", [None, np.nan, np.inf])
def test_a_run_without_the_figure_says_nothing(toy, monkeypatch, value):
    with pytest.raises(UnjudgedError, match="no figure for regret"):
        outcome(toy, monkeypatch, "regret", regret=value)


def test_steps_to_a_threshold_that_nobody_knows_are_refused(toy, monkeypatch):
    with pytest.raises(UserError, match="give --threshold"):
        outcome(toy, monkeypatch, "steps", threshold=None)
