"""What ``--cluster`` may say, and which schedulers are spoken to."""

import asyncio
import ipaddress
import json
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.cluster import schedulers
from experiments.cluster.schedulers import (
    SECONDS_TO_RESTART,
    JobQueue,
    Jobs,
    LocalWorkers,
    SchedulerAddress,
    _retiring,
    check_address,
    checked_cluster,
    is_loopback,
    read_cluster,
)
from pipeline.errors import UserError

SLURM = "jobqueue:\n  slurm: {cores: 4, memory: 8GB, walltime: '01:00:00'}\n"


def test_the_four_forms(tmp_path):
    assert read_cluster("local:8") == LocalWorkers(8)
    assert read_cluster("tls://node:8786") == SchedulerAddress("tls://node:8786")
    assert read_cluster("127.0.0.1:8786").read() == "tcp://127.0.0.1:8786"
    file = tmp_path / "scheduler.json"
    file.write_text(json.dumps({"address": "tls://10.0.0.1:8786"}))
    assert read_cluster(str(file)).read() == "tls://10.0.0.1:8786"
    jobs = tmp_path / "slurm.yml"
    jobs.write_text(SLURM)
    queue = read_cluster(str(jobs))
    assert isinstance(queue, JobQueue)
    assert (queue.system, queue.n_cores) == ("slurm", 4)


@pytest.mark.parametrize(
    "text",
    ["local:", "local:0", "local:-1", "local:x", "local:9999", "local:٣", "nowhere", "a b:c"],
)
def test_nonsense_is_refused(text):
    with pytest.raises(UserError, match="--cluster"):
        read_cluster(text)


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"address": 3}', '{"address": "x"}', "[" * 10**5, "\xff"]
)
def test_a_file_that_holds_no_address_is_refused(tmp_path, content):
    file = tmp_path / "scheduler.json"
    file.write_text(content)
    with pytest.raises(UserError, match="scheduler"):
        read_cluster(str(file)).read()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("jobqueue: {slurm: {cores: 4}}", "how many cores and how much memory"),
        ("jobqueue: {slurm: {cores: many, memory: 8GB}}", "whole number"),
        ("jobqueue: {cloud: {cores: 4, memory: 8GB}}", "none of htcondor"),
        ("jobqueue: {slurm: {cores: 4, memory: 8GB}, pbs: {}}", "one queueing system"),
        ("jobqueue: !!python/name:os.system", "not allowed here"),
        ("slurm: {cores: 4, memory: 8GB}", "must hold the key jobqueue"),
    ],
)
def test_a_queue_that_cannot_be_is_refused(tmp_path, content, words):
    file = tmp_path / "slurm.yml"
    file.write_text(content)
    with pytest.raises(UserError, match=words):
        read_cluster(str(file))


@given(st.ip_addresses())
def test_an_address_is_open_unless_it_is_of_this_machine_alone(address):
    host = f"[{address}]" if address.version == 6 else str(address)
    assert is_loopback(f"tcp://{host}:8786") is ipaddress.ip_address(address).is_loopback


@pytest.mark.parametrize(
    "address",
    [
        "tcp://10.0.0.1:8786",
        "tcp://node:8786",
        "tcp://localhost.example.org:8786",
        "tcp://0.0.0.0:8786",
        "tcp://127.0.0.1@10.0.0.1:8786",
    ],
)
def test_an_open_scheduler_is_refused_unless_told(address):
    with pytest.raises(UserError, match="without TLS"):
        check_address(address, True, is_insecure=False)
    check_address(address, False, is_insecure=True)


def test_tls_takes_certificates_and_other_ways_are_unknown():
    check_address("tls://10.0.0.1:8786", True, is_insecure=False)
    check_address("tcp://localhost:8786", False, is_insecure=False)
    with pytest.raises(UserError, match="ca-file"):
        check_address("tls://10.0.0.1:8786", False, is_insecure=True)
    with pytest.raises(UserError, match="begins with"):
        check_address("ws://127.0.0.1:8786", True, is_insecure=True)


def test_a_command_checks_before_it_connects():
    with pytest.raises(UserError, match="without TLS"):
        checked_cluster("192.0.2.1:8786", is_insecure=False)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"walltime": "01:00:00"}, ["--lifetime", "3300s", "--lifetime-stagger", "150s"]),
        ({"walltime": "00:10:00"}, ["--lifetime", "540s", "--lifetime-stagger", "30s"]),
        ({"walltime": "1-00:00:00"}, ["--lifetime", "86100s", "--lifetime-stagger", "150s"]),
        ({"walltime": "90"}, None),
        ({"walltime": "01:00:00", "worker-extra-args": ["--lifetime", "1h"]}, None),
    ],
)
def test_workers_retire_before_their_job_ends(tmp_path, settings, words):
    retiring = _retiring(JobQueue("slurm", settings, 1, tmp_path))
    assert retiring.get("worker-extra-args") == words


def test_a_walltime_that_yaml_takes_for_a_number_is_refused(tmp_path):
    with pytest.raises(UserError, match="quotes"):
        _retiring(JobQueue("slurm", {"walltime": 3600}, 1, tmp_path))


# --- Jobs of a queue that have ended are sent again, and others are left alone.


class Queue:
    """Two jobs of dask-jobqueue, of one worker each or of two."""

    def __init__(self, suffixes):
        self.suffixes = suffixes
        self.worker_spec = {"job-1": {}, "job-10": {}}
        self.workers, self.closed, self._futures = {}, [], set()
        self.scheduler = SimpleNamespace(workers={})
        self.loop = SimpleNamespace(add_callback=lambda function, *args: function(*args))
        self.n_sent = 0

    def scale(self, jobs):
        assert jobs == 2
        for name in self.worker_spec.keys() - self.workers.keys():
            self.n_sent += 1
            self.workers[name] = SimpleNamespace(close=lambda name=name: self.close(name))

    async def close(self, name):
        self.closed.append(name)

    def arrive(self, job, port):
        for i, suffix in enumerate(self.suffixes):
            address = f"tls://{port}{i}"
            worker = SimpleNamespace(name=f"{job}{suffix}", address=address)
            self.scheduler.workers[address] = worker

    def lose(self, *addresses):
        for address in addresses:
            del self.scheduler.workers[address]


@pytest.fixture
def clock(monkeypatch):
    fake = SimpleNamespace(now=100.0)
    monkeypatch.setattr(schedulers, "time", SimpleNamespace(monotonic=lambda: fake.now))
    return fake


def test_a_job_whose_worker_has_retired_is_sent_again_at_once(clock):
    async def retire():
        queue = Queue(("",))
        jobs = Jobs(queue, 2)
        assert queue.n_sent == 2
        jobs.replace(())
        queue.arrive("job-1", 1)
        jobs.replace(())
        queue.lose("tls://10")
        jobs.replace({"tls://10"})
        await asyncio.gather(*queue._futures)
        # The other still waits in the queue, however long that takes, and so does the new one.
        clock.now += 10 * SECONDS_TO_RESTART
        jobs.replace({"tls://10"})
        return queue

    queue = asyncio.run(retire())
    assert (queue.closed, queue.n_sent) == (["job-1"], 3)


def test_where_it_is_lost_it_has_time_to_be_started_again(clock):
    async def lose():
        queue = Queue(("",))
        jobs = Jobs(queue, 2)
        for port in (1, 2):
            queue.arrive("job-10", port)
            jobs.replace(())
            queue.lose(f"tls://{port}0")
            clock.now += SECONDS_TO_RESTART
            jobs.replace(())
            assert queue.n_sent == 2
        clock.now += 1
        jobs.replace(())
        await asyncio.gather(*queue._futures)
        return queue

    queue = asyncio.run(lose())
    assert (queue.closed, queue.n_sent) == (["job-10"], 3)


def test_a_job_of_several_workers_ends_with_the_last_of_them(clock):
    async def retire():
        queue = Queue(("-0", "-1"))
        jobs = Jobs(queue, 2)
        queue.arrive("job-1", 1)
        queue.arrive("job-10", 2)
        jobs.replace(())
        queue.lose("tls://10")
        jobs.replace({"tls://10"})
        assert queue.n_sent == 2
        queue.lose("tls://11")
        jobs.replace({"tls://10", "tls://11"})
        await asyncio.gather(*queue._futures)
        return queue

    queue = asyncio.run(retire())
    assert (queue.closed, queue.n_sent) == (["job-1"], 3)
