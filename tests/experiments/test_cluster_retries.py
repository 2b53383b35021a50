"""What a launcher makes of what schedulers say of runs: sent again, blamed, or given up."""

from concurrent.futures import CancelledError
from types import SimpleNamespace

import pytest
from distributed.scheduler import KilledWorker

from experiments.child_processes import NO_LIMITS
from experiments.cluster.answers import MOST_SENDS, Answer, packed
from experiments.cluster.cluster_launcher import ClusterLauncher
from experiments.cluster.working import probing
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError

LAKE = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 20})
FAILED = packed(Answer("failed", "thin ice", "at length"))


class Task:
    """One that has ended as it is told to."""

    def __init__(self, client, end):
        self.client, self.end = client, end
        self.status = end if isinstance(end, str) else "finished"
        if isinstance(end, Exception):
            self.status = "error"

    def add_done_callback(self, function):
        function(self)

    def result(self, timeout):
        if self.end == "lost":
            raise CancelledError
        return self.end

    def exception(self):
        return self.end

    def cancel(self):
        pass

    release = cancel


class Scheduler:
    """Ends runs as a list says; a worker begins each before, where it is asked to."""

    def __init__(self, ends, begins=True):
        self.ends, self.begins, self.n_sent, self.n_lost = list(ends), begins, 0, 0

    def submit(self, function, order, *, key, pure):
        self.n_sent += 1
        if self.begins:
            self.launcher._on_begun((0.0, {"run": key, "at": f"tcp://w:{self.n_sent}"}))
        end = self.ends.pop(0) if len(self.ends) > 1 else self.ends[0]
        return Task(self, end)

    def client(self):
        return self

    def lose(self, client):
        self.n_lost += 1

    def close(self):
        pass


@pytest.fixture
def outcome(tmp_path):
    """How a run ends at a scheduler, with the details."""
    agents = (AgentSpec("mine", "qlearning"),)
    (run,) = plan(StudySpec("s", "S", agents, (LAKE,), n_seeds=1), tmp_path)

    def of(scheduler):
        with probing(tmp_path) as probe:
            launcher = ClusterLauncher(probe, "c", NO_LIMITS, 0)
            launcher.connection = scheduler.launcher = scheduler
            scheduler._on_begun = launcher._on_begun
            try:
                failure = launcher.submit(run).result(timeout=30)
            finally:
                launcher.close()
        return failure

    return of


KILLED = KilledWorker("run", SimpleNamespace(address="tcp://w:1"), 3)


def test_a_failure_is_told_with_its_details(outcome):
    failure = outcome(Scheduler([FAILED]))
    assert failure.reason == "thin ice"
    assert failure.log.read_text() == "at length"


def test_a_failure_without_a_word_is_one_all_the_same(outcome):
    assert outcome(Scheduler([packed(Answer("failed"))])).reason == "it does not say why"


@pytest.mark.parametrize("end", ["cancelled", "lost", packed(Answer("stopped")), KILLED])
def test_what_is_nobodys_fault_is_sent_again(outcome, end):
    scheduler = Scheduler([end] * 5 + [FAILED], begins=False)
    assert outcome(scheduler).reason == "thin ice"
    assert scheduler.n_sent == 6
    assert scheduler.n_lost == (5 if end in ("cancelled", "lost") else 0)


def test_but_not_for_ever(outcome):
    scheduler = Scheduler([packed(Answer("stopped"))])
    assert "never came back" in outcome(scheduler).reason
    assert scheduler.n_sent == MOST_SENDS


def test_a_scheduler_that_goes_blames_no_run(outcome):
    assert outcome(Scheduler(["cancelled"] * 5 + [FAILED])).reason == "thin ice"


def test_a_run_that_had_begun_on_workers_that_were_killed_is_given_up(outcome):
    scheduler = Scheduler([KILLED])
    assert outcome(scheduler).reason == "the worker that did it was lost 3 times (tcp://w:3)"
    assert scheduler.n_sent == 3


@pytest.mark.parametrize("end", [ValueError("odd"), b"", packed(Answer("done"))[:-1]])
def test_what_is_no_answer_is_refused(outcome, end):
    scheduler = Scheduler([end])
    assert outcome(scheduler).reason.startswith("3 times it did not come back as a run: ")
    assert scheduler.n_sent == 3


def test_a_worker_that_can_do_no_runs_ends_them_all(outcome):
    with pytest.raises(UserError, match="other code: start it anew"):
        outcome(Scheduler([packed(Answer("unfit", "w has other code"))]))


@pytest.mark.parametrize("event", [None, (), (0, {}), (0, {"run": 3, "at": 4}), (0, {"at": 3})])
def test_odd_events_are_nothing(event, tmp_path):
    with probing(tmp_path) as probe:
        launcher = ClusterLauncher(probe, "c", NO_LIMITS, 0)
        launcher._on_begun(event)
        launcher._on_leaving(event)
        assert not launcher._left
