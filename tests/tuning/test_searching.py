"""Searches over a toy: what is tried and ended, what it is worth, and what a kill changes."""

import errno
import json
import math
import os
from contextlib import suppress

import numpy as np
import optuna
import pytest
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState

from experiments.results import Curve, RunResults
from pipeline.errors import UserError
from tuning import searching
from tuning.searching import UnjudgedError, outcome_of
from tuning.suggesting import make_sampler
from tuning.trial_storage import FAILURE, FIGURES, SETTINGS
from tuning.tuning_spec import SAMPLERS, judged

optuna.logging.set_verbosity(optuna.logging.ERROR)


def test_each_trial_is_the_mean_of_its_seeds_and_the_first_has_the_shipped_settings(
    toy, tmp_path, monkeypatch
):
    place = toy.opened(toy.tuning(), tmp_path)
    launcher = toy.search(place, toy.Launcher())
    assert len(launcher.done) == 30
    for trial in place.queue.trials():
        entry = trial.user_attrs[SETTINGS]
        assert trial.value == pytest.approx(np.mean([toy.score(entry, seed) for seed in range(3)]))
        assert set(trial.user_attrs[FIGURES]) == {"0", "1", "2"}
    assert place.queue.trials()[0].user_attrs[SETTINGS] == toy.shipped


@pytest.mark.parametrize(
    ("sampler", "stops_after"),
    [("tpe", 1), ("tpe", 14), ("random", 29), ("gp", 14)],
)
def test_what_was_broken_off_goes_on_to_the_same_trials(toy, tmp_path, sampler, stops_after):
    tuning = toy.tuning(sampler=sampler)
    whole = toy.opened(tuning, tmp_path / "whole")
    toy.search(whole, toy.Launcher())
    first = toy.opened(tuning, tmp_path / "broken")
    toy.search(first, toy.Launcher(stops_after=stops_after))
    assert "RUNNING" not in toy.states(first)
    again = toy.opened(tuning, tmp_path / "broken")
    rest = toy.search(again, toy.Launcher())
    assert toy.states(again) == ["COMPLETE"] * 10
    assert toy.params(again) == toy.params(whole)
    assert len(rest.done) == 30 - stops_after


WRITES = [
    *("create_new_trial", "set_trial_param", "set_trial_state_values", "set_study_user_attr"),
    *("set_trial_intermediate_value", "set_trial_user_attr", "set_trial_system_attr"),
]


class DyingStorage(InMemoryStorage):
    """From its k-th write on its driver is dead, until it is revived."""

    n_writes, dies_at = 0, math.inf

    def revive(self):
        self.dies_at = math.inf
        for trial in self.get_all_trials(0, states=[TrialState.RUNNING]):
            self.set_trial_state_values(trial._trial_id, TrialState.WAITING)


def dying(name):
    def write(self, *args, **options):
        self.n_writes += 1
        if self.n_writes >= self.dies_at:
            raise KeyboardInterrupt
        return getattr(InMemoryStorage, name)(self, *args, **options)

    return write


for name in WRITES:
    setattr(DyingStorage, name, dying(name))


@pytest.mark.parametrize("sampler", ["tpe", "random"])
def test_a_kill_at_any_write_to_the_storage_changes_no_trial(toy, tmp_path, sampler):
    tuning = toy.tuning(sampler=sampler, pruner="racing", n_trials=8, n_seeds=4)

    def searched(storage):
        place = toy.opened(tuning, tmp_path, storage)
        toy.search(place, toy.Launcher())
        return [(t.state, t.value, t.params, t.user_attrs.get(FIGURES)) for t in place.study.trials]

    whole = DyingStorage()
    undisturbed = searched(whole)
    assert TrialState.PRUNED in [state for state, *_ in undisturbed]
    for k in range(10, whole.n_writes, 8):
        storage = DyingStorage()
        storage.dies_at = k
        with suppress(KeyboardInterrupt):
            searched(storage)
        storage.revive()
        assert searched(storage) == undisturbed, k


def test_a_hopeless_trial_is_ended_and_its_other_seeds_are_not_run(toy, tmp_path):
    place = toy.opened(toy.tuning(pruner="median", n_trials=20, n_seeds=5), tmp_path)
    launcher = toy.search(place, toy.Launcher())
    ended = [trial for trial in place.queue.trials() if trial.state.name == "PRUNED"]
    assert ended
    assert all(len(trial.user_attrs[FIGURES]) < 5 for trial in ended)
    assert len(launcher.done) == sum(len(t.user_attrs[FIGURES]) for t in place.queue.trials())


def test_a_full_disk_says_nothing_of_settings(toy, tmp_path, monkeypatch):
    def full(**_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    place = toy.opened(toy.tuning(), tmp_path)
    toy.search(place, toy.Launcher(stops_after=7))
    monkeypatch.setattr(searching.tempfile, "TemporaryFile", full)
    with pytest.raises(UserError, match="No space left on device: make room"):
        toy.search(place, toy.Launcher(failing={0, 1, 2}))
    assert set(toy.states(place)) == {"COMPLETE", "WAITING"}


@pytest.mark.parametrize(("judged_by", "hopeless"), [("score", False), ("final", True)])
def test_only_scores_have_1_to_hope_for_where_all_are_below_0(toy, tmp_path, judged_by, hopeless):
    """Of returns nobody knows how high they go: those seen so far have to do."""
    place = toy.opened(toy.tuning(n_trials=2, pruner="bound"), tmp_path)

    def low(entry, seed):
        return -1.0 - seed if entry == toy.shipped else -6.0

    launcher = toy.search(place, toy.Launcher(), low, judged_by=judged_by)
    assert toy.states(place)[0] == "COMPLETE"
    assert place.hopeless(1, {0: -6.0}) is hopeless
    # With 1 on the last seed they come to -11 / 3, and the mean to be beaten is -2.
    assert place.hopeless(1, {0: -6.0, 1: -6.0})
    assert len(launcher.done) == (4 if hopeless else 5)


def test_a_setting_that_fails_is_one_of_the_worst_and_the_search_goes_on(toy, tmp_path):
    place = toy.opened(toy.tuning(), tmp_path)

    class Fragile(toy.Launcher):
        def submit(self, planned):
            self.failing = {0, 1, 2} if planned.entry["gamma"] > 0.9 else ()
            return super().submit(planned)

    toy.search(place, Fragile())
    for trial in place.queue.trials():
        fails = trial.user_attrs[SETTINGS]["gamma"] > 0.9
        assert trial.state.name == ("PRUNED" if fails else "COMPLETE")
        assert (FAILURE in trial.user_attrs) == fails


def test_where_nothing_but_failures_comes_of_it_the_search_ends_and_says_why(toy, tmp_path):
    place = toy.opened(toy.tuning(), tmp_path)
    with pytest.raises(UserError, match=r"all of the first 5 trials failed; seed \d: it broke"):
        toy.search(place, toy.Launcher(failing={0, 1, 2}))


def test_how_many_runs_there_are(toy, tmp_path):
    """None after the time is over; seeds side by side; more trials beside those that are there."""
    late = toy.opened(toy.tuning(n_trials=4), tmp_path)
    assert not toy.search(late, toy.Launcher(), deadline=-math.inf).done
    assert toy.states(late) == ["WAITING"] * 4
    assert len(toy.search(late, toy.Launcher(n_workers=3)).done) == 12
    more = toy.opened(toy.tuning(n_trials=6), tmp_path)
    assert len(toy.search(more, toy.Launcher()).done) == 6
    assert toy.states(more) == ["COMPLETE"] * 6


def test_a_grid_goes_through_every_point_once(toy, tmp_path):
    place = toy.opened(toy.tuning(sampler="grid", n_trials=12, figure="steps"), tmp_path / "it")
    toy.search(place, toy.Launcher(), lambda entry, seed: 100.0 * entry["gamma"])
    tried = {(p["learning_rate"], p["gamma"]) for p in toy.params(place)[1:]}
    assert len(toy.params(place)) == 10  # three values of each, and what was shipped
    assert len(tried) == 9
    assert {gamma for _, gamma in tried} == {0.5, 0.75, 1.0}
    assert place.study.best_value == 50.0  # a cost is made small
    with pytest.raises(UserError, match="4 settings with two values of each number"):
        toy.opened(toy.tuning(sampler="grid", n_trials=4), tmp_path / "too few")


# --- what suggests settings -----------------------------------------------------------------------


def asked(study, number):
    """The draws of the trial of a number, in a study that has those before it."""
    while len(study.trials) <= number:
        trial = study.ask()
        values = [trial.suggest_float(name, 0.0, 1.0) for name in "abc"]
        study.tell(trial, sum(values))
    return study.trials[number].params


def study_of(tuning):
    return optuna.create_study(sampler=make_sampler(tuning), direction="maximize")


@pytest.mark.parametrize("sampler", [name for name in SAMPLERS if name != "grid"])
def test_a_trial_is_drawn_by_its_number_and_the_seed(toy, sampler):
    tuning = toy.tuning(sampler=sampler)
    study = study_of(tuning)
    asked(study, 7)
    other = study_of(tuning)
    for trial in study.trials[:6]:
        other.add_trial(trial)  # as another driver finds them
    assert asked(other, 7) == asked(study, 7)
    assert len({json.dumps(trial.params) for trial in study.trials}) > 5
    assert asked(study_of(toy.tuning(sampler=sampler, seed=1)), 0) != asked(study, 0)


# --- what a run and a setting are worth, worked out by hand ---------------------------------------


VALUES = [0.0, 1.0, 0.9, 0.8, 0.1]


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
    assert judged(VALUES, objective, is_cost=is_cost) == pytest.approx(value)


def outcome(toy, monkeypatch, figure, **row):
    figures = {"step": [10, 20, 30], "seconds": [0.5, 1.0, 1.5], "value": [0.0, 0.6, 0.4]}
    evaluations = Curve({}, {name: np.array(values) for name, values in figures.items()})
    row = {"seconds": 2.0, "n_timesteps": 30, "threshold": 0.5, **row}
    results = RunResults([row], [evaluations])
    monkeypatch.setattr(searching, "read_run", lambda *_: results)
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


@pytest.mark.parametrize("regret", [None, np.nan, np.inf])
def test_a_run_without_the_figure_says_nothing(toy, monkeypatch, regret):
    with pytest.raises(UnjudgedError, match="no figure for regret"):
        outcome(toy, monkeypatch, "regret", regret=regret)
    with pytest.raises(UserError, match="give --threshold"):
        outcome(toy, monkeypatch, "steps", threshold=None)
