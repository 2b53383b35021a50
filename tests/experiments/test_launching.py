"""Doing the runs of a study: what each leaves behind, in what order, and on how many cores."""

import contextlib
import errno
import heapq
import json
import os
import threading
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from agents import ALGORITHMS
from agents.registry import AlgorithmEntry
from experiments import launching, run_in_child
from experiments.child_processes import NO_LIMITS, StoppedError, TaskFailedError
from experiments.launching import (
    WINDOW,
    TimeLeft,
    available_cores,
    execute,
    expected_seconds,
    failure_log,
)
from experiments.plan import plan
from experiments.run_folders import draft_path, leave_drafts, run_name
from experiments.run_in_child import do_run
from experiments.run_limits import RunLimits
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.digests import source_digest
from pipeline.errors import UserError
from pipeline.state_files import SavedState
from pipeline.unfinished_runs import StateKeeping

LAKE = EnvironmentSpec("dry lake", "FrozenLake-v1", {"n_timesteps": 20})


def runs_of(root, n_seeds=2, tensorboard=False):
    agents = (AgentSpec("mine", "qlearning"),)
    study = StudySpec("s", "S", agents, (LAKE,), n_seeds=n_seeds, tensorboard=tensorboard)
    return plan(study, root)


def test_the_cores_that_this_process_may_use(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {pid, 3, 5}, raising=False)
    assert available_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert available_cores() == 7
    # Python does not know on every machine.
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert available_cores() == 1


def test_a_run_says_what_it_is(tmp_path):
    _, planned = runs_of(tmp_path)
    draft = draft_path(tmp_path, planned)
    do_run(planned, draft, "compare.py s.yml")
    assert planned.is_finished
    assert not draft.exists()
    args = yaml.safe_load((planned.run.params_path / "args.yml").read_text())
    given = {key: value for key, value in args.items() if value is not None}
    assert given == {"algo": "qlearning", "env": "FrozenLake-v1", "seed": 1}
    assert "compare.py s.yml" in (planned.run.params_path / "command.txt").read_text()


def test_a_run_replaces_one_of_other_settings_and_leaves_one_that_is_finished(tmp_path):
    first, second = runs_of(tmp_path)
    first.path.mkdir(parents=True)
    (first.path / "old.txt").touch()
    do_run(first, draft_path(tmp_path, first), "again")
    assert first.is_finished
    assert not (first.path / "old.txt").exists()
    # Another process was faster: what it has done stays.
    do_run(second, draft_path(tmp_path, second), "one")
    (second.path / "mark").touch()
    do_run(second, draft_path(tmp_path, second), "two")
    assert (second.path / "mark").exists()


def test_tensorboard_logs_of_an_earlier_try_are_removed(tmp_path):
    planned, _ = runs_of(tmp_path, tensorboard=True)
    old = planned.spec.tensorboard_log / "old"
    old.mkdir(parents=True)
    do_run(planned, draft_path(tmp_path, planned), "compare.py s.yml")
    assert not old.exists()
    assert list(planned.spec.tensorboard_log.rglob("events.out.tfevents.*"))


FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("error", "cause", "is_kept"),
    [
        (UserError("the disk takes no more"), FULL, True),
        (MemoryError(), None, True),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), None, True),
        (UserError("reward at step 3 is nan"), None, False),
        (RuntimeError("thin ice"), None, False),
        (FileNotFoundError(errno.ENOENT, "the environment's own file"), None, False),
    ],
)
def test_what_a_run_failed_by_says_whether_the_next_try_goes_on(
    tmp_path, monkeypatch, error, cause, is_kept
):
    planned, _ = runs_of(tmp_path)
    draft = draft_path(tmp_path, planned)

    def fail(*_):
        (draft / "state").mkdir()
        (draft / "state" / "odd.state").touch()
        raise error from cause

    monkeypatch.setattr(run_in_child, "train", fail)
    with pytest.raises(type(error)):
        do_run(planned, draft, "compare.py s.yml")
    leave_drafts(tmp_path, run_name(planned))
    assert draft.exists() == is_kept


@pytest.mark.parametrize("sources", ["older", source_digest()])
def test_a_study_goes_on_from_states_of_its_own_sources_alone(tmp_path, monkeypatch, sources):
    planned, _ = runs_of(tmp_path)
    left = StateKeeping(state=SavedState(None, {"sources": sources}), goes_on=True)
    for name, value in (("holds_state", True), ("go_on", left)):
        monkeypatch.setattr(run_in_child, name, lambda *_, value=value: value)
    monkeypatch.setattr(type(planned), "is_of", lambda *_: True)
    found = run_in_child._to_go_on_with(planned, planned.run)
    assert found.goes_on == (sources != "older")


class InPlace:
    """Does the work at once, in this process."""

    def submit(self, function, *args):
        future = Future()
        future.set_result(function(*args))
        return future


def launchers_on(executor, root, limits=NO_LIMITS):
    launcher = launching._LocalLauncher(executor, 1, root, "c", limits)
    return lambda: contextlib.nullcontext(launcher)


def test_every_run_is_told_of_and_failures_are_kept(tmp_path, monkeypatch):
    runs = runs_of(tmp_path, n_seeds=3)
    good, bad, stopped = runs
    log = failure_log(tmp_path, good)
    log.parent.mkdir()
    log.write_text("of an earlier try")

    def supervise(work, run, *where, clean_up, limits, shares_process):
        assert shares_process
        assert (work, limits) == (launching._do_planned_run, RunLimits(9))
        assert where == (tmp_path, "c", Path())
        if run is bad:
            raise TaskFailedError("thin ice", "Traceback: thin ice\n")
        if run is stopped:
            raise StoppedError

    monkeypatch.setattr(launching, "supervise", supervise)
    told = {}
    launchers = launchers_on(InPlace(), tmp_path, RunLimits(seconds=9))
    failures = execute(
        runs, tmp_path, launchers, lambda run, failure: told.setdefault(run.seed, failure)
    )
    (failure,) = failures
    assert (failure.planned, failure.reason) == (bad, "thin ice")
    assert told == {0: None, 1: failure, 2: None}
    assert failure.log == tmp_path / "failures" / "mine@dry_lake_2.txt"
    # What an earlier try left of a run that has now been done is gone.
    assert list(log.parent.iterdir()) == [failure.log]
    assert failure.log.read_text() == "Traceback: thin ice\n"


def test_nothing_to_do_starts_nothing(tmp_path):
    def never(*_):
        pytest.fail("a launcher was opened")

    assert execute([], tmp_path, never, never) == []


class Growing:
    """Has no worker at first, and two from the moment on at which it has been given something."""

    n_workers = 0
    words = ""

    def __init__(self):
        self.given, self.most = [], 0

    def submit(self, planned):
        self.n_workers = 2
        future = Future()
        self.given.append(future)
        self.most = max(self.most, sum(not future.done() for future in self.given))
        threading.Timer(0.05, future.set_result, [None]).start()
        return future


def test_runs_are_handed_over_in_windows_as_wide_as_there_are_workers(tmp_path, monkeypatch):
    monkeypatch.setattr(launching, "SECONDS_BETWEEN_LOOKS", 0.01)
    runs, launcher, told = runs_of(tmp_path, n_seeds=12), Growing(), []

    def listen(run, failure):
        told.append(run.seed)

    assert execute(runs, tmp_path, lambda: contextlib.nullcontext(launcher), listen) == []
    assert sorted(told) == list(range(12))
    assert launcher.most == 2 * WINDOW


def test_a_record_is_whole(tmp_path):
    planned, _ = runs_of(tmp_path)
    do_run(planned, draft_path(tmp_path, planned), "c")
    info = json.loads(planned.run.info_path.read_text())
    assert (info["state"], info["spec"]["seed"]) == ("finished", 0)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (TaskFailedError("the disk is full", "Traceback"), "the disk is full"),
        (EOFError("unexpected EOF"), "its process could not be started: unexpected EOF"),
        (BlockingIOError(errno.EAGAIN, "none left"), "its process could not be started: [Errno"),
    ],
)
def test_a_failure_whose_details_cannot_be_written_is_told_and_the_others_go_on(
    tmp_path, monkeypatch, error, reason
):
    def full(path, text):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    def failing(*args, **kwargs):
        raise error

    monkeypatch.setattr(launching, "write_text", full)
    monkeypatch.setattr(launching, "supervise", failing)
    with launchers_on(InPlace(), tmp_path)() as launcher:
        failure = launcher.submit(runs_of(tmp_path)[0]).result()
    assert failure.reason.startswith(reason)
    assert failure.log is None


def test_what_is_done_meanwhile_is_done_once_after_the_first_runs_are_handed_over(tmp_path):
    runs, launcher, given_then = runs_of(tmp_path, n_seeds=5), Growing(), []
    launcher.n_workers = 2

    def meanwhile():
        given_then.append(len(launcher.given))

    where = contextlib.nullcontext(launcher)
    execute(runs, tmp_path, lambda: where, lambda run, failure: None, meanwhile)
    assert given_then == [2 * WINDOW]


# --- How long a study may still take, held against simulated times.

# What a run takes by agent, in seconds; environments change it twofold.
TAKES = {"qlearning": 0.5, "sarsa": 0.6, "dqn": 40.0, "double_dqn": 90.0, "ppo": 25.0}
ENVIRONMENTS = {"FrozenLake-v1": 0.7, "FrozenLake8x8-v1": 1.0, "Taxi-v4": 1.4, "CliffWalking-v1": 1}


def runs_to_time(n_seeds):
    return plan(
        StudySpec(
            "s",
            "S",
            tuple(AgentSpec(algo, algo) for algo in TAKES),
            tuple(EnvironmentSpec(name, name, {"n_timesteps": 9}) for name in ENVIRONMENTS),
            n_seeds=n_seeds,
        ),
        Path("nowhere"),
    )


def played(runs, takes, n_workers, expected, shares):
    """The estimate by the truth, where so many of the runs have ended."""
    left, now, n_ended, estimates = TimeLeft(runs, expected), 0.0, 0, {}
    waiting, under_way = list(enumerate(runs)), []
    left.start(now, n_workers)
    for _ in range(n_workers):
        number, run = waiting.pop(0)
        heapq.heappush(under_way, (takes[number], number, run))
    while under_way:
        now, _, run = heapq.heappop(under_way)
        n_ended += 1
        left.end(run, now)
        left.start(now, n_workers)
        if waiting:
            number, run = waiting.pop(0)
            heapq.heappush(under_way, (now + takes[number], number, run))
        for share in shares:
            if share not in estimates and n_ended >= share * len(runs):
                estimates[share] = (now, left.seconds(now, n_workers))
    return {share: guess / (now - at) for share, (at, guess) in estimates.items()}


@pytest.mark.parametrize("n_seeds", [3, 10])
@pytest.mark.parametrize("n_workers", [1, 2, 8])
@pytest.mark.parametrize("off", [0.6, 1.0, 1.7, 4.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_after_a_tenth_of_the_runs_it_is_right_within_a_factor_of_two(
    n_seeds, n_workers, off, seed
):
    """Also where all take more or less than was expected, as on a busy machine."""
    runs, rng = runs_to_time(n_seeds), np.random.default_rng(seed)
    usual = [TAKES[run.agent] * ENVIRONMENTS[run.environment] for run in runs]
    takes = [time * rng.uniform(0.8, 1.25) for time in usual]
    expected = {
        (run.agent, run.environment): time / off * rng.uniform(0.8, 1.25)
        for run, time in zip(runs, usual, strict=True)
    }
    found = played(runs, takes, n_workers, expected, (0.1, 0.25, 0.5))
    assert all(0.5 < ratio < 2 for ratio in found.values()), found


def test_equal_runs_of_which_nothing_is_known():
    runs = [run for run in runs_to_time(10) if run.agent == "qlearning"]
    found = played(runs, [3.0] * len(runs), 2, {}, (0.1, 0.5))
    assert found == pytest.approx({0.1: 1, 0.5: 1}, rel=0.1)


def test_a_run_may_take_the_whole_time_that_is_left():
    slow, *fast = [run for run in runs_to_time(3) if run.environment == "Taxi-v4"][:4]
    expected = {(run.agent, run.environment): 1.0 for run in fast}
    left = TimeLeft([slow, *fast], {**expected, (slow.agent, slow.environment): 100.0})
    left.start(0.0, 8)
    for run in fast:
        left.end(run, 1.0)
    assert left.seconds(10.0, 8) == pytest.approx(90)
    # Nobody knows how long, once it has taken longer.
    assert 0 < left.seconds(1000.0, 8) <= 250


def test_runs_may_end_in_another_order():
    first, *_, last = runs_to_time(3)
    left = TimeLeft([first, last], {})
    left.start(0.0, 1)
    left.end(last, 5.0)
    left.start(5.0, 1)
    left.end(last, 6.0)  # told twice
    left.end(first, 7.0)
    assert left.seconds(7.0, 1) == 0


def test_expectations_go_by_agent_and_budget():
    table, network = runs_to_time(1)[0].spec, runs_to_time(1)[2].spec
    assert (table.algo, network.algo) == ("qlearning", "dqn")
    assert expected_seconds(table) < expected_seconds(network) < expected_seconds(network, 60.0)


def test_nothing_is_said_while_an_agent_of_the_users_has_not_ended_a_run(monkeypatch):
    """Nobody knows whether it is compiled."""
    monkeypatch.setitem(ALGORITHMS, "own", AlgorithmEntry("own:Own", "own"))
    runs = [replace(run, spec=replace(run.spec, algo="own")) for run in runs_to_time(3)[:12]]
    left = TimeLeft(runs, {})
    left.start(0.0, 1)
    assert left.seconds(1.0, 1) is None
    for n, run in enumerate(runs[: len(ENVIRONMENTS) * len(TAKES)], start=1):
        left.end(run, 2.0 * n)
        left.start(2.0 * n, 1)
    assert left.seconds(24.0, 1) == pytest.approx(0.0)
