"""Searches over a toy: what is tried and ended, and what becomes of it after a kill."""

import errno
import math
import os
from contextlib import suppress

import numpy as np
import pytest
from optuna.storages import InMemoryStorage
from optuna.trial import TrialState

from pipeline.errors import UserError
from tuning import searching
from tuning.trial_queue import FAILURE, FIGURES, SETTINGS


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


@pytest.mark.parametrize("sampler", ["tpe", "random", "cmaes"])
@pytest.mark.parametrize("stops_after", [1, 14, 29])
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


@pytest.mark.parametrize("sampler", ["tpe", "random", "cmaes"])
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


def test_scores_are_not_compared_with_returns_of_before(toy, tmp_path):
    """The optimum of an environment may be known since an update."""
    place = toy.opened(toy.tuning(), tmp_path)
    toy.search(place, toy.Launcher(stops_after=7), judged_by="final")
    with pytest.raises(UserError, match=r"judged by final, and now by score: --name NAME makes"):
        toy.search(place, toy.Launcher())
    assert toy.search(place, toy.Launcher(), judged_by="final").done
    assert toy.states(place) == ["COMPLETE"] * 10


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


def test_a_cost_is_made_small(toy, tmp_path):
    place = toy.opened(toy.tuning(figure="steps"), tmp_path)
    toy.search(place, toy.Launcher(), lambda entry, seed: 100.0 * entry["gamma"])
    assert place.study.best_value == min(trial.value for trial in place.queue.trials())


def test_seeds_go_side_by_side_where_trials_are_few(toy, tmp_path):
    place = toy.opened(toy.tuning(n_trials=1), tmp_path)
    waiting = []

    class Slow(toy.Launcher):
        def submit(self, planned):
            waiting.append(planned.seed)
            return super().submit(planned)

    toy.search(place, Slow(n_workers=3))
    assert sorted(waiting) == [0, 1, 2]
    assert toy.states(place) == ["COMPLETE"]


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


def test_where_nothing_but_failures_comes_of_it_the_search_ends_and_says_why(
    toy, tmp_path, monkeypatch
):
    place = toy.opened(toy.tuning(), tmp_path)
    with pytest.raises(UserError, match=r"all of the first 5 trials failed; seed \d: it broke"):
        toy.search(place, toy.Launcher(failing={0, 1, 2}))


def test_after_the_time_no_run_is_begun(toy, tmp_path):
    place = toy.opened(toy.tuning(), tmp_path)
    launcher = toy.search(place, toy.Launcher(), deadline=-math.inf)
    assert not launcher.done
    assert toy.states(place) == ["WAITING"] * 10


def test_a_grid_goes_through_every_point_once(toy, tmp_path):
    place = toy.opened(toy.tuning(sampler="grid", n_trials=12), tmp_path)
    toy.search(place, toy.Launcher())
    tried = {(p["learning_rate"], p["gamma"]) for p in toy.params(place)[1:]}
    assert len(toy.params(place)) == 10  # three values of each, and what was shipped
    assert len(tried) == 9
    assert {gamma for _, gamma in tried} == {0.5, 0.75, 1.0}


def test_a_grid_that_does_not_fit_is_refused(toy, tmp_path):
    with pytest.raises(UserError, match="4 settings with two values of each number"):
        toy.opened(toy.tuning(sampler="grid", n_trials=4), tmp_path)


def test_what_the_user_fixes_is_not_searched(toy, tmp_path):
    place = toy.opened(toy.tuning(settings={"gamma": 0.9}), tmp_path)
    toy.search(place, toy.Launcher())
    assert place.suggestions.n_free == 1
    assert {p["gamma"] for p in toy.params(place)} == {0.9}
    assert len({p["learning_rate"] for p in toy.params(place)}) == 10


def test_another_search_under_the_same_name_is_refused(toy, tmp_path):
    toy.opened(toy.tuning(), tmp_path)
    toy.opened(toy.tuning(n_trials=20, retest=0), tmp_path)
    with pytest.raises(UserError, match=r"toy: the tuning there is another .*objective: 'mean'"):
        toy.opened(toy.tuning(objective="lower"), tmp_path)
