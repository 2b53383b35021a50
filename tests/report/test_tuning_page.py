"""The page of a tuning: what its figures and tables say, worked out by hand."""

import json
import re
from pathlib import Path

import optuna
import pytest
import yaml

from rl_yardstick.report.page import tuning as tuning_page
from rl_yardstick.report.page.frame import as_json
from tests.report import made_up

SAID = yaml.safe_load(Path(__file__).with_name("tuning_page.yml").read_text(encoding="utf-8"))


def shown_of(record):
    """The history as the page has it."""
    return json.loads(as_json(tuning_page.history(tuning_page.Trials(record))))


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
        found = tuning_page.Trials({**made_up.tuning(), **fields}).best_first
        assert [trial["number"] for trial in found] == ranked


def test_the_parameter_that_decides_matters_most():
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(0))
    space = tuning_page.Trials(made_up.tuning()).distributions
    drawn = enumerate(study.ask(space).params for _ in range(60))
    trials = [made_up.trial(n, -abs(each["steps"] - 3), {"1": 0.0}, **each) for n, each in drawn]
    shares = tuning_page.importances(tuning_page.Trials({**made_up.tuning(), "trials": trials}))
    assert next(iter(shares)) == "steps"
    assert shares["steps"] > 0.7
    assert sum(shares.values()) == pytest.approx(1.0)


def test_tables_have_the_cost_and_what_changed():
    trials = tuning_page.Trials(made_up.tuning())
    assert tuning_page.cost(trials) == [*SAID["cost"].items()]
    assert tuning_page.changes(trials, 2) == [("learning_rate", "0", "2"), ("tau", "-", "1.0")]


def test_the_page_is_one_file_that_says_what_won(tmp_path):
    def page(**changes):
        path = tmp_path / "report.html"
        record, command = made_up.tuning() | changes, "python train.py --conf-file winner.yml"
        tuning_page.write_tuning_page(record, path, "retest/report.html", command)
        text = path.read_text(encoding="utf-8")
        return text, re.findall(r'<section id="(\w+)"', text)

    text, sections = page()
    assert sections == ["verdict", "history", "importances", "cost", "trials"]
    for part in SAID["page"]:
        assert part in text
    assert re.findall(r'(?:src|href)="(?!#|data:|retest/)[^"]*"', text) == []
    text, sections = page(trials=[], retest=None, n_at_optimum=2)
    for part in SAID["without a re-test"]:
        assert part in text
    assert sections == ["verdict", "history", "cost", "trials"]
