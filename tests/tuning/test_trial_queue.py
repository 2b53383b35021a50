"""Drivers that share a queue, and drivers that are gone."""

import pytest

from pipeline import locks
from tuning import trial_queue
from tuning.trial_queue import DRIVER

STORAGES = ["journal", "sqlite"]


def storage_of(kind, tmp_path):
    return {"journal": f"journal:{tmp_path / 'log'}", "sqlite": f"sqlite:///{tmp_path / 'db'}"}[
        kind
    ]


@pytest.mark.parametrize("kind", STORAGES)
def test_no_two_drivers_take_the_same_trial_and_none_takes_more_than_there_are(toy, kind, tmp_path):
    drivers = [
        toy.opened(toy.tuning(n_trials=4), tmp_path, storage_of(kind, tmp_path)).queue
        for _ in range(3)
    ]
    for driver in drivers:
        driver._add_places()
    taken = [driver.claim(lambda _: {}) for _ in range(2) for driver in drivers]
    assert sorted(trial.number for trial in taken if trial is not None) == list(range(4))
    assert len(drivers[0].study.trials) == 4
    assert not drivers[0].is_done()


@pytest.mark.parametrize("kind", STORAGES)
def test_a_trial_of_a_driver_that_is_gone_is_taken_up_again(toy, kind, tmp_path, monkeypatch):
    storage = storage_of(kind, tmp_path)
    first = toy.opened(toy.tuning(), tmp_path, storage).queue
    first._add_places()
    mark = locks.mark()
    monkeypatch.setattr(locks, "mark", lambda: {**mark, "began": 1})  # not this process
    lost = first.claim(lambda _: {})
    monkeypatch.undo()
    kept = toy.opened(toy.tuning(), tmp_path, storage).queue
    mine = kept.claim(lambda _: {})
    other = toy.opened(toy.tuning(), tmp_path, storage).queue
    assert other.free_dead() == [lost.number]
    assert other.claim(lambda _: {}).number == lost.number
    assert mine.number == 1
    assert other.free_dead() == []


def test_one_elsewhere_counts_as_gone_once_it_has_been_silent(toy, tmp_path, monkeypatch):
    far = toy.opened(toy.tuning(), tmp_path).queue
    far._add_places()
    mark = locks.mark()
    monkeypatch.setattr(locks, "mark", lambda: {**mark, "host": "far", "boot": "another"})
    trial = far.claim(lambda _: {})
    monkeypatch.undo()
    clock = [0.0]
    monkeypatch.setattr(trial_queue.time, "monotonic", lambda: clock[0])
    here = toy.opened(toy.tuning(), tmp_path).queue
    for now, gives_sign, freed in [
        (0.0, True, []),
        (50.0, True, []),
        (100.0, False, []),
        (161.0, False, [trial.number]),
    ]:
        clock[0] = now
        if gives_sign:
            far._give_sign()
        assert here.free_dead() == freed


def test_one_that_was_taken_and_not_signed_is_free_after_a_while(toy, tmp_path, monkeypatch):
    queue = toy.opened(toy.tuning(), tmp_path).queue
    queue._add_places()
    place = queue.trials()[0]
    from optuna.trial import TrialState

    queue.storage.set_trial_state_values(place._trial_id, TrialState.RUNNING)
    clock = [0.0]
    monkeypatch.setattr(trial_queue.time, "monotonic", lambda: clock[0])
    assert queue.free_dead() == []
    clock[0] = 61.0
    assert queue.free_dead() == [0]


def test_what_is_given_back_is_not_taken_from_whoever_has_it_now(toy, tmp_path):
    queue = toy.opened(toy.tuning(), tmp_path).queue
    queue._add_places()
    trial = queue.claim(lambda _: {})
    trial.set_user_attr(DRIVER, {"token": "another"})
    queue.give_back(trial)
    assert toy.states(toy.opened(toy.tuning(), tmp_path))[0] == "RUNNING"


def test_more_trials_are_added_to_those_that_are_there(toy, tmp_path):
    toy.search(toy.opened(toy.tuning(n_trials=4), tmp_path), toy.Launcher())
    more = toy.opened(toy.tuning(n_trials=6), tmp_path)
    launcher = toy.search(more, toy.Launcher())
    assert toy.states(more) == ["COMPLETE"] * 6
    assert len(launcher.done) == 6


@pytest.mark.parametrize(
    "said", [None, 3, [0.5], {"a": 0.5, "0": "x", "-1": 0.5, "1": float("nan")}]
)
def test_figures_that_are_none_are_not_believed(said):
    assert trial_queue.figures_of({"figures": said}) == {}
    assert trial_queue.seconds_of({"seconds": said}) == 0.0 or said == 3


def test_places_beyond_those_that_were_asked_for_are_left_alone(toy, tmp_path):
    more, fewer = (toy.opened(toy.tuning(n_trials=n), tmp_path).queue for n in (6, 4))
    for queue in (more, fewer):
        queue._add_places()
    assert [fewer.claim(lambda _: {}) is None for _ in range(5)] == [False] * 4 + [True]
    assert len(more.trials()) == 6
