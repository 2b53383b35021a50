"""Runs on a cluster of two workers on this machine: killed, sent, refused."""

import contextlib
import gc
import os
import socket
import ssl
import subprocess
import sys
from concurrent.futures import CancelledError
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from distributed import Client, LocalCluster
from distributed.scheduler import KilledWorker

import compare
from experiments.child_processes import NO_LIMITS
from experiments.cluster import answers, schedulers
from experiments.cluster import cluster_launcher as launching_there
from experiments.cluster.answers import Answer, packed
from experiments.cluster.cluster_launcher import MOST_SENDS, ClusterLauncher, cluster_launcher
from experiments.cluster.schedulers import (
    JobQueue,
    LocalWorkers,
    SchedulerAddress,
    opened,
    opened_queue,
)
from experiments.cluster.working import Probe, probing
from experiments.launching import execute
from experiments.plan import plan
from experiments.run_folders import draft_path
from experiments.run_in_child import do_run
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError
from pipeline.user_modules import import_typed

ROOT = Path(compare.__file__).parent
DEADLY = """
import multiprocessing, os, pathlib, signal
import gymnasium as gym
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv

class Deadly(FrozenLakeEnv):
    def __init__(self, mark, **kwargs):
        super().__init__(**kwargs)
        self.mark = pathlib.Path(mark)

    def reset(self, **kwargs):
        parent = multiprocessing.parent_process()
        if parent is not None and self.mark.suffix == ".each":
            os.kill(os.getpid(), signal.SIGKILL)
        if parent is not None and not self.mark.exists():
            self.mark.touch()
            os.kill(parent.pid, signal.SIGKILL)
        return super().reset(**kwargs)

gym.register("Deadly-v0", Deadly, max_episode_steps=20)
"""


@pytest.fixture(scope="module")
def scheduler():
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", memory_limit=0
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def there(scheduler):
    """Launchers on the cluster, by the study's folder."""
    return lambda root: partial(cluster_launcher, SchedulerAddress(scheduler), root, "c")


def runs_of(root, modules=(), **more):
    environments = [EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 500})]
    for label, mark in more.items():
        settings = {"n_timesteps": 40, "env_kwargs": {"mark": str(mark)}}
        environments.append(EnvironmentSpec(label, "Deadly-v0", settings))
    agents = (AgentSpec("mine", "qlearning", tuned=False),)
    names = tuple(module.name for module in modules)
    study = StudySpec(
        "s", "S", agents, tuple(environments), 2, gym_packages=names, user_modules=modules
    )
    return plan(study, root)


def left_in(root):
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        from _run_contents import contents
    finally:
        sys.path.pop(0)
    return contents(root / "runs")


def done(root, launchers, runs):
    """What runs leave, by name; and the failures, by environment."""
    root.mkdir()
    failures = execute(runs, root, launchers, lambda *_: None)
    assert sorted({path.name for path in root.iterdir()} - {"failures"}) == ["runs"]
    by_run = {(each.planned.environment, each.planned.seed): each for each in failures}
    return left_in(root), by_run


def check_what_dies(there, folder, here):
    """A run that kills its worker is tried again; one that dies each time fails alone."""
    (folder / "deadly_lake.py").write_text(DEADLY)
    modules = import_typed([str(folder / "deadly_lake.py")])
    marks = {"once": folder / "once", "poison": folder / "x.each"}
    root = folder / "shared"
    found, failures = done(root, there(root), runs_of(root, modules, **marks))
    assert (folder / "once").exists()
    assert failures.keys() == {("poison", 0), ("poison", 1)}
    assert failures["poison", 0].reason == "its process died 2 times (SIGKILL)"
    assert failures["poison", 0].log.read_text()
    # Beside the copies of the module.
    assert {name: found.get(name) for name in here} == here
    assert len({name for name in found if "once_" in name and "run.json" in name}) == 2


def check_what_is_sent(there, folder, here, monkeypatch):
    """Where no folder is shared, files come back."""

    @contextlib.contextmanager
    def elsewhere(root):
        yield Probe(Path("/nowhere"), root, ".probe", "x")

    monkeypatch.setattr(launching_there, "probing", elsewhere)
    root = folder / "apart"
    assert done(root, there(root), runs_of(root)) == (here, {})


def check_what_is_refused(there, folder, monkeypatch):
    """It is tried again, and then told."""

    def lying(planned, root, files):
        raise answers.RefusedAnswerError("a stray file")

    monkeypatch.setattr(launching_there, "receive", lying)
    root = folder / "refused"
    root.mkdir()
    (failure,) = execute(runs_of(root)[:1], root, there(root), lambda *_: None)
    assert failure.reason == "3 times it did not come back as a run: a stray file"
    assert [path.name for path in root.rglob("*") if path.is_file()] == ["mine@lake_1.txt"]


def test_a_cluster_does_what_this_machine_does_whatever_dies(there, tmp_path, monkeypatch):
    """All in one: several processes of the suite would start a cluster each."""
    root = tmp_path / "here"
    for run in runs_of(root):
        do_run(run, draft_path(root, run), "c")
    here = left_in(root)
    assert here
    check_what_dies(there, tmp_path, here)
    check_what_is_sent(there, tmp_path, here, monkeypatch)
    check_what_is_refused(there, tmp_path, monkeypatch)


def listening_in(pid):
    """The ports that a process and those that it has started listen to, with whose they are."""
    owners, pids = {}, [pid]
    for one in pids:
        for file in Path(f"/proc/{one}").glob("task/*/children"):
            pids += map(int, file.read_text().split())
        for link in Path(f"/proc/{one}/fd").glob("*"):
            with contextlib.suppress(OSError):
                owners[str(link.readlink())] = one
    ports = {}
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            _, local, _, state, *_, inode = line.split()[:10]
            if state == "0A" and f"socket:[{inode}]" in owners:
                ports[int(local.rpartition(":")[2], 16)] = owners[f"socket:[{inode}]"]
    return ports


def answer_of(port, context=None):
    """What a port says to somebody who has no certificate; nothing if it closes."""
    try:
        with contextlib.ExitStack() as stack:
            asker = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
            if context is not None:
                asker = stack.enter_context(context.wrap_socket(asker))
            asker.sendall(b"GET /json/identity.json HTTP/1.0\r\n\r\n")
            return asker.recv(100)
    except (ConnectionError, ssl.SSLError):
        return b""


def check_ports(n_processes, before):
    """All sockets of so many processes speak TLS, with those alone who have a certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    ports = {port: pid for port, pid in listening_in(os.getpid()).items() if port not in before}
    assert len(set(ports.values())) == n_processes
    for port in ports:
        assert answer_of(port) == b""
        assert answer_of(port, context) == b""


@pytest.mark.skipif(sys.platform != "linux", reason="it looks into /proc")
def test_all_ports_of_workers_here_want_a_certificate():
    before = listening_in(os.getpid())  # of servers that other tests have left
    with opened(LocalWorkers(1)) as (connect, _), connect() as client:
        client.wait_for_workers(1, timeout=60)
        assert client.dashboard_link == ""
        check_ports(2, before)  # this one, with the scheduler and the nanny, and the worker


@pytest.mark.filterwarnings("ignore:unclosed file")  # dask-jobqueue's, which hold the keys
@pytest.mark.skipif(sys.platform != "linux", reason="it looks into /proc")
def test_all_ports_of_jobs_want_a_certificate(tmp_path):
    """The queue is played by a shell, which does what the script of a job says."""
    before = listening_in(os.getpid())
    settings = {"cores": 1, "memory": "1GB", "shared-temp-directory": str(tmp_path)}
    settings |= {"interface": "lo", "python": sys.executable, "local-directory": str(tmp_path)}
    queue = opened_queue(JobQueue("slurm", settings, 1, tmp_path / "slurm.yml"))
    with queue, Client(queue, set_as_default=False) as client:
        job = subprocess.Popen(["bash", "-c", queue.job_script()], stderr=subprocess.DEVNULL)
        try:
            client.wait_for_workers(1, timeout=60)
            check_ports(3, before)  # this one, with the scheduler, the nanny and the worker
        finally:
            client.shutdown()
            job.wait(30)
    del queue, client
    gc.collect()


def test_no_scheduler_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.cluster.schedulers.SECONDS_TO_CONNECT", 0.2)
    nowhere = partial(cluster_launcher, SchedulerAddress("127.0.0.1:1"), tmp_path, "c")
    with pytest.raises(UserError, match="there is no scheduler"), nowhere():
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("address", ["tcp://10.0.0.1:8786", "tcp://0.0.0.0:8786"])
def test_one_that_says_itself_that_it_is_open_is_refused(address):
    connection = schedulers.Connection(pytest.fail, pytest.fail, is_insecure=False)
    with pytest.raises(UserError, match="without TLS"):
        connection._check_open(["tls://10.0.0.2:1", "tcp://127.0.0.1:2", address])
    schedulers.Connection(pytest.fail, pytest.fail, is_insecure=True)._check_open([address])


def test_without_a_cluster_nothing_of_dask_is_loaded():
    code = (
        "import sys, experiments.launching, commands.compare\n"
        "print([name for name in sys.modules if name.startswith(('dask', 'distributed'))])"
    )
    words = [sys.executable, "-c", code]
    out = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    assert out.stdout == "[]\n"


# --- What a launcher makes of what schedulers say of runs: sent again, blamed, or given up.

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
