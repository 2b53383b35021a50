"""The page of a tuning: what its figures and tables say, worked out by hand."""

import json
import re

import optuna
import pytest

from rl_yardstick.report.page.frame import as_json
from rl_yardstick.report.page.tuning import (
    Trials,
    changes,
    cost,
    history,
    importances,
    write_tuning_page,
)
from tests.report import made_up


def shown_of(record):
    """The history as the page has it."""
    return json.loads(as_json(history(Trials(record))))


def test_the_history_has_the_best_of_those_with_all_seeds():
    shown = shown_of(made_up.tuning())
    assert shown["numbers"] == [0, 1, 2, 3, 4, 6]
    assert shown["best"] == [0.6, 0.6, 0.8, 0.8, 0.8, 0.8]
    assert shown["values"]["judged on all seeds"] == [0.6, None, 0.8, 0.7, None, None]
    assert shown["values"]["ended early"] == [None, -30.0, None, None, None, 0.75]
    assert (shown["failed"], shown["shipped"]) == ([4], 0.6)
    assert shown["texts"][1] == "trial 1: -30 on 1 seed"
    # The one far off lies beyond the edge of the axis, and all others inside.
    assert -30.0 < shown["edge"] < 0.6
    assert shown_of({**made_up.tuning(), "lower_is_better": True})["best"] == [0.6] * 6


def test_trials_are_ranked_by_value_and_those_with_the_optimum_by_their_steps():
    trials = [made_up.trial(n, 1.0, {"1": 1.0, "0": 1.0}) for n in range(4)]
    for number, steps in ((1, (30, 50)), (3, (20, 40)), (2, (1,))):
        trials[number]["at_optimum"] = dict(zip(("1", "0"), steps, strict=False))
    for fields, ranked in (
        ({}, [2, 3, 0, 1, 4, 6]),
        ({"lower_is_better": True}, [0, 3, 2, 1, 4, 6]),
        ({"trials": trials}, [3, 1, 0, 2]),
    ):
        found = Trials({**made_up.tuning(), **fields}).best_first
        assert [trial["number"] for trial in found] == ranked


def test_the_parameter_that_decides_matters_most():
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(0))
    space = Trials(made_up.tuning()).distributions
    drawn = enumerate(study.ask(space).params for _ in range(60))
    trials = [made_up.trial(n, -abs(each["steps"] - 3), {"1": 0.0}, **each) for n, each in drawn]
    shares = importances(Trials({**made_up.tuning(), "trials": trials}))
    assert next(iter(shares)) == "steps"
    assert shares["steps"] > 0.7
    assert sum(shares.values()) == pytest.approx(1.0)


def test_tables_have_the_cost_and_what_changed():
    trials = Trials(made_up.tuning())
    assert cost(trials) == [
        ("Trials", "6 of 10"),
        ("Ended early", "2"),
        ("Failed", "1"),
        ("Judged on all seeds", "3"),
        ("Runs", "8 of at most 12"),
        ("Runs saved by ending trials early", "33%"),
        ("Processor time of all runs", "16 s"),
        ("From the first trial to the end of the last", "66 s"),
        ("Runs of the re-test", "8"),
    ]
    assert changes(trials, 2) == [("learning_rate", "0", "2"), ("tau", "-", "1.0")]


def test_the_page_is_one_file_that_says_what_won(tmp_path):
    def page(**changes):
        path = tmp_path / "report.html"
        record, command = made_up.tuning() | changes, "python train.py --conf-file winner.yml"
        write_tuning_page(record, path, "retest/report.html", command)
        text = path.read_text(encoding="utf-8")
        return text, re.findall(r'<section id="(\w+)"', text)

    text, sections = page()
    assert sections == ["verdict", "history", "importances", "cost", "trials"]
    for part in (
        "Best setting: trial 2. On 4 seeds that the search has not seen, its mean score is 0.7;",
        "Trial 2 gains <strong>+0.2</strong> on unseen seeds",
        "(95 % interval +0.1 to +0.3): <",
        ">better so far</span>; 1 of its 4 runs failed",
        '--conf-file</span> <span class="word">winner.yml</span></code>',
        "Changed: <code>learning_rate</code> 2 (0 before), <code>tau</code> 1.0 (not set before)",
        "looked better in the search than on other seeds, by 0.1",
        'href="retest/report.html"',
        ">rate 0.1, kind null, steps 3<",
        "<small>it broke</small>",
        "python tune.py &lt;script&gt;",
    ):
        assert part in text
    assert re.findall(r'(?:src|href)="(?!#|data:|retest/)[^"]*"', text) == []
    text, sections = page(trials=[], retest=None, n_at_optimum=2)
    assert "No re-test: no other setting came close" in text
    assert "2 settings have the optimum on all seeds of the search" in text
    assert "threshold, and more trials were not needed." in text
    assert sections == ["verdict", "history", "cost", "trials"]
