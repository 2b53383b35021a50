"""What ``--cluster`` may say, and which schedulers are spoken to."""

import ipaddress
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.cluster.addresses import (
    JobQueue,
    LocalWorkers,
    SchedulerAddress,
    check_address,
    is_loopback,
    read_cluster,
)
from experiments.cluster.schedulers import QUEUES, _retiring, checked_cluster
from pipeline.errors import UserError

SYSTEMS = tuple(QUEUES)
SLURM = "jobqueue:\n  slurm: {cores: 4, memory: 8GB, walltime: '01:00:00'}\n"


def test_the_four_forms(tmp_path):
    assert read_cluster("local:8", SYSTEMS) == LocalWorkers(8)
    assert read_cluster("tls://node:8786", SYSTEMS) == SchedulerAddress("tls://node:8786")
    assert read_cluster("127.0.0.1:8786", SYSTEMS).read() == "tcp://127.0.0.1:8786"
    file = tmp_path / "scheduler.json"
    file.write_text(json.dumps({"address": "tls://10.0.0.1:8786"}))
    assert read_cluster(str(file), SYSTEMS).read() == "tls://10.0.0.1:8786"
    jobs = tmp_path / "slurm.yml"
    jobs.write_text(SLURM)
    queue = read_cluster(str(jobs), SYSTEMS)
    assert isinstance(queue, JobQueue)
    assert (queue.system, queue.n_cores) == ("slurm", 4)


@pytest.mark.parametrize(
    "text",
    ["local:", "local:0", "local:-1", "local:x", "local:9999", "local:٣", "nowhere", "a b:c"],
)
def test_nonsense_is_refused(text):
    with pytest.raises(UserError, match="--cluster"):
        read_cluster(text, SYSTEMS)


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"address": 3}', '{"address": "x"}', "[" * 10**5, "\xff"]
)
def test_a_file_that_holds_no_address_is_refused(tmp_path, content):
    file = tmp_path / "scheduler.json"
    file.write_text(content)
    with pytest.raises(UserError, match="scheduler"):
        read_cluster(str(file), SYSTEMS).read()


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
        read_cluster(str(file), SYSTEMS)


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
        check_address(address, True, is_told=False)
    check_address(address, False, is_told=True)


def test_tls_takes_certificates_and_other_ways_are_unknown():
    check_address("tls://10.0.0.1:8786", True, is_told=False)
    check_address("tcp://localhost:8786", False, is_told=False)
    with pytest.raises(UserError, match="ca-file"):
        check_address("tls://10.0.0.1:8786", False, is_told=True)
    with pytest.raises(UserError, match="begins with"):
        check_address("ws://127.0.0.1:8786", True, is_told=True)


def test_a_command_checks_before_it_connects():
    with pytest.raises(UserError, match="without TLS"):
        checked_cluster("192.0.2.1:8786", is_told=False)


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
