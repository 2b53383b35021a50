"""The page of a tuning: what its figures and tables say, worked out by hand."""

import json
import re

import optuna
import pytest

from report.page.tuning import (
    Trials,
    changes,
    cost,
    history,
    importances,
    parallel,
    write_tuning_page,
)


def test_the_history_has_the_best_of_those_with_all_seeds(tuning_record):
    shown = history(Trials(tuning_record))
    assert shown["numbers"] == [0, 1, 2, 3, 4, 6]
    assert shown["best"] == [0.6, 0.6, 0.8, 0.8, 0.8, 0.8]
    assert shown["values"]["judged on all seeds"] == [0.6, None, 0.8, 0.7, None, None]
    assert shown["values"]["ended early"] == [None, -30.0, None, None, None, 0.75]
    assert (shown["failed"], shown["shipped"]) == ([4], 0.6)
    assert shown["texts"][1] == "trial 1: -30 on 1 seed"
    # The one far off lies beyond the edge of the axis, and all others inside.
    assert -30.0 < shown["edge"] < 0.6


def test_a_cost_is_the_better_the_lower(tuning_record):
    tuning_record["lower_is_better"] = True
    trials = Trials(tuning_record)
    assert history(trials)["best"] == [0.6, 0.6, 0.6, 0.6, 0.6, 0.6]
    assert [each["number"] for each in trials.best_first] == [0, 3, 2, 1, 4, 6]


def test_lines_run_through_the_parameters_between_their_ends(tuning_record):
    shown = parallel(Trials(tuning_record), {"steps": 1.0})
    assert [axis["name"] for axis in shown["axes"]] == ["steps", "rate", "kind"]
    assert shown["axes"][2]["ticks"] == [(1 / 6, "a"), (0.5, "null"), (5 / 6, "true")]
    lines = {line["number"]: line for line in shown["lines"]}
    # The geometric mean of the ends is in the middle.
    assert lines[0]["at"] == [0.5, pytest.approx(0.5), 1 / 6]
    assert lines[3]["at"][0] == 1.0
    assert lines[1]["at"][1] == 1.0
    assert lines[2]["said"] == ["3", "0.1", "null"]
    # The worst first, so that the best are drawn over them.
    assert [line["number"] for line in shown["lines"]] == [1, 0, 3, 6, 2]
    assert [line["group"] for line in shown["lines"]] == [0, 1, 2, 3, 4]
    del tuning_record["trials"][0]["params"]["rate"]
    (first,) = [x for x in parallel(Trials(tuning_record), {})["lines"] if x["number"] == 0]
    assert (first["at"][0], first["said"][0]) == (None, "not there")


def test_the_parameter_that_decides_matters_most(tuning_record, tuning_trial):
    rng = optuna.samplers.RandomSampler(0)
    study = optuna.create_study(sampler=rng)
    space = Trials(tuning_record).distributions()
    drawn = [study.ask(space).params for _ in range(60)]
    tuning_record["trials"] = [
        tuning_trial(number, -abs(params["steps"] - 3), {"1": 0.0}, **params)
        for number, params in enumerate(drawn)
    ]
    shares = importances(Trials(tuning_record))
    assert next(iter(shares)) == "steps"
    assert shares["steps"] > 0.7
    assert sum(shares.values()) == pytest.approx(1.0)


def test_a_parameter_that_one_trial_alone_has_is_no_reason_to_warn(tuning_record):
    for trial in tuning_record["trials"][1:]:
        trial["params"].pop("rate", None)
    assert importances(Trials(tuning_record)).keys() <= {"steps", "kind"}


def test_where_all_are_alike_nothing_matters(tuning_record, tuning_trial):
    tuning_record["trials"] = [tuning_trial(n, 0.5, {"1": 0.5}) for n in range(5)]
    assert importances(Trials(tuning_record)) == {}


def test_the_cost_is_counted(tuning_record):
    assert cost(Trials(tuning_record)) == [
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


def test_tables_have_what_changed_and_all_trials(tuning_record):
    trials = Trials(tuning_record)
    assert [change._asdict() for change in changes(trials, 2)] == [
        {"name": "learning_rate", "shipped": "0", "found": "2"},
        {"name": "tau", "shipped": "-", "found": "1.0"},
    ]
    assert [trial["number"] for trial in trials.best_first] == [2, 3, 0, 1, 4, 6]


def test_the_page_is_one_file_that_says_what_won(tuning_record, tmp_path):
    path = tmp_path / "report.html"
    write_tuning_page(json.loads(json.dumps(tuning_record)), path, "retest/report.html")
    text = path.read_text(encoding="utf-8")
    assert re.findall(r'<section id="(\w+)"', text) == [
        "verdict", "history", "parallel", "importances", "cost", "trials",
    ]  # fmt: skip
    assert "Trial 2 is the best on seeds that the search has not seen: 0.7" in text
    assert "and 1 of its 4 runs failed. Its settings are in" in text
    assert "looked better in the search than on other seeds, by 0.1" in text
    assert 'href="retest/report.html"' in text
    assert ">rate 0.1, kind null, steps 3<" in text
    assert "<small>it broke</small>" in text
    assert "python tune.py &lt;script&gt;" in text
    assert re.findall(r'(?:src|href)="(?!#|data:|retest/)[^"]*"', text) == []


def test_a_page_without_trials_and_re_test_is_written_too(tuning_record, tmp_path):
    tuning_record |= {"trials": [], "retest": None}
    write_tuning_page(tuning_record, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "There has been no re-test yet" in text
    assert re.findall(r'<section id="(\w+)"', text) == ["verdict", "history", "cost", "trials"]


def test_where_none_won_the_reason_stands_there(tuning_record, tmp_path):
    tuning_record["retest"] |= {"winner": None, "winner_file": None, "reason": "all were worse"}
    write_tuning_page(tuning_record, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "No winner: all were worse." in text
    assert "What the winner has otherwise" not in text
