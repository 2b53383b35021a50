"""Runs on a cluster: what is sent and taken, who is spoken to, what becomes of lost runs."""

import asyncio
import contextlib
import io
import ipaddress
import json
import os
import shutil
import subprocess
import sys
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rl_yardstick.experiments.child_processes import NO_LIMITS
from rl_yardstick.experiments.cluster.answers import (
    Answer,
    RefusedAnswerError,
    check_in_place,
    files_in,
    packed,
    receive,
    sealed,
    unpacked,
)
from rl_yardstick.experiments.cluster.cluster_launcher import SentRun
from rl_yardstick.experiments.cluster.schedulers import (
    SECONDS_TO_RESTART,
    ClosedScheduler,
    ClosedWorker,
    Connection,
    JobQueue,
    Jobs,
    LocalWorkers,
    SchedulerAddress,
    check_address,
    checked_cluster,
    is_loopback,
    opened_queue,
    read_cluster,
    retiring,
)
from rl_yardstick.experiments.cluster.sent_code import SentCode, SentModule, UnfitError
from rl_yardstick.experiments.cluster.working import Probe, RunOrder
from rl_yardstick.experiments.run_folders import draft_path
from rl_yardstick.experiments.run_in_child import do_run
from rl_yardstick.pipeline.loaded_code import DISTRIBUTIONS, files_in_settings
from rl_yardstick.pipeline.locks import mark
from rl_yardstick.pipeline.settings.hyperparams import split
from rl_yardstick.pipeline.user_modules import import_typed

import compare
from rl_yardstick.experiments.cluster import answers, cluster_launcher, schedulers
from rl_yardstick.experiments.plan import plan
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline import digests
from rl_yardstick.pipeline.errors import UserError

ROOT = Path(compare.__file__).parent


def runs_of(root, tensorboard=False):
    agents = (AgentSpec("mine", "qlearning", tuned=False),)
    lake = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 50})
    return plan(StudySpec("s", "S", agents, (lake,), 2, tensorboard=tensorboard), root)


# --- What a worker may answer, and what is refused before anything of it is written.

FILES = {"run/run.json": b"{}", "run/a/b.zip": b"\0\1", "tensorboard/x": b""}


def test_what_is_packed_is_unpacked():
    failed = Answer("failed", "thin ice", "Traceback")
    for answer in (Answer("done"), Answer("done", files={}), Answer("done", files=FILES), failed):
        assert unpacked(packed(answer)) == answer


def raw(files=(), **changes):
    head = {"kind": "done", "reason": "", "details": "", "has_files": True, **changes}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive, warnings.catch_warnings(action="ignore"):
        for name in ("answer.json", *files):
            archive.writestr(name, json.dumps(head))
    return sealed(buffer.getvalue())


REFUSED = {
    "a cut one": (packed(Answer("done", files=FILES))[:-1], "damaged"),
    "a file twice where case is ignored": (raw(["run/x", "run/X"]), "twice"),
    "a file as a folder": (raw(["run/x", "run/X/y"]), "folder too"),
    "another kind": (raw(kind="fine"), "no way to end"),
    **{name: (raw([name]), "elsewhere|no name") for name in ("/etc/passwd", "run/../../x", "x")},
}


@pytest.mark.parametrize(("content", "words"), REFUSED.values(), ids=REFUSED)
def test_answers_that_are_refused(content, words):
    with pytest.raises(RefusedAnswerError, match=words):
        unpacked(content)


def test_there_are_bounds_on_what_is_sent_and_taken(tmp_path, monkeypatch):
    (tmp_path / "x").write_bytes(bytes(100))
    (tmp_path / "link").symlink_to("/etc/passwd")
    content = packed(Answer("done", files=files_in(tmp_path, "run/")))
    assert unpacked(content).files == {"run/x": bytes(100)}
    monkeypatch.setattr(answers, "LARGEST", 99)  # a quarter of a gigabyte takes long
    with pytest.raises(ValueError, match="let it share"):
        files_in(tmp_path, "run/")
    with pytest.raises(RefusedAnswerError, match="too large"):
        unpacked(content)


# --- What comes back of a run is put in place if it is that very run, whole, and nothing else.


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """What a worker sends of the first run, by name."""
    root = tmp_path_factory.mktemp("worker")
    run = runs_of(root)[0]
    do_run(run, draft_path(root, run), "c")
    return files_in(run.path, "run/")


def with_record(files, **changes):
    """The same files, with a record that says something else of itself."""
    record = {**json.loads(files["run/run.json"]), **changes}
    return {**files, "run/run.json": json.dumps(digests.sealed(record)).encode()}


OTHER_CODE = {DISTRIBUTIONS: {"numpy": "1.0"}}


def test_a_run_is_put_in_place_to_the_last_bit(tmp_path, done, monkeypatch):
    run = runs_of(tmp_path)[0]
    monkeypatch.setattr(answers, "SECONDS_TO_APPEAR", 0.0)  # a folder that is never late
    with pytest.raises(RefusedAnswerError, match="not in its folder"):
        check_in_place(run)
    receive(run, tmp_path, done)
    assert files_in(run.path, "run/") == done
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    check_in_place(run)
    # One that a worker with other code has left in the shared folder goes.
    run.run.info_path.write_bytes(with_record(done, **OTHER_CODE)["run/run.json"])
    with pytest.raises(RefusedAnswerError, match="other code"):
        check_in_place(run)
    assert not run.path.exists()
    # Logs go to their own folder, in place of those of an earlier try.
    logged = runs_of(tmp_path / "logged", tensorboard=True)[0]
    logged.spec.tensorboard_log.mkdir(parents=True)
    (logged.spec.tensorboard_log / "old").touch()
    receive(logged, tmp_path / "logged", {**done, "tensorboard/events": b"x"})
    assert [path.name for path in logged.spec.tensorboard_log.iterdir()] == ["events"]


def test_whatever_else_comes_is_refused_and_leaves_nothing(tmp_path, done):
    another = {**json.loads(done["run/run.json"])["spec"], "seed": 1}
    lies = {
        "unfinished": with_record(done, state="running"),
        "another run": with_record(done, spec=another),
        "other code": with_record(done, **OTHER_CODE),
        **{f"with {name}": {**done, name: b"x"} for name in ("run/more.txt", "run/\ud800")},
        **{f"with {name}": {**done, name: b"x"} for name in ("elsewhere/x", "tensorboard/x")},
    }
    for name, content in done.items():
        lies[f"without {name}"] = {key: data for key, data in done.items() if key != name}
        lies[f"{name} changed"] = {**done, name: bytes([content[0] ^ 1, *content[1:]])}
    for number, (name, files) in enumerate(lies.items()):
        root = tmp_path / str(number)
        root.mkdir()
        with pytest.raises(RefusedAnswerError):
            receive(runs_of(root)[0], root, files)
        assert not list(root.rglob("*")), name


# --- Orders travel as plain data, and arrive as they were.

# Among them texts that YAML would read as something else.
TEXTS = ["1e-4", "yes", "0", "~", "=", "<<", "12:30:00", "2001-01-01", "", " a\n", "\0\x85\u2028é"]
VALUES = [None, True, 1, 10**30, 1e-4, 1e16, -0.0, float("inf"), [], *TEXTS]
PLAIN = runs_of(Path("a b/logs"))[0]


def order_of(planned):
    code = SentCode("v", ("a", "b"), (SentModule({"m.py": "d"}, {"m.py": b"\0x"}),), {"f": "d"})
    probe = Probe(Path("/h"), Path("r"), "n", "c")
    return RunOrder(planned, "compare.py 'x y'", NO_LIMITS, probe, "t", code)


def test_whatever_an_environment_is_given_arrives_as_it_was():
    arguments = {"values": VALUES, **{text: {1: {}} for text in TEXTS}, "keys": {1: "1", "1": 1}}
    raw = {**PLAIN.spec.saved_hyperparams, "env_kwargs": arguments}
    spec = replace(PLAIN.spec, hyperparams=split(raw), saved_hyperparams=raw)
    order = order_of(replace(PLAIN, spec=spec))
    assert repr(RunOrder.unpacked(order.packed())) == repr(order)


def test_an_order_holds_no_code(tmp_path):
    code = f"x: !!python/object/apply:os.mkdir ['{tmp_path / 'mark'}']\ncommand:".encode()
    with pytest.raises(yaml.constructor.ConstructorError):
        RunOrder.unpacked(order_of(PLAIN).packed().replace(b"command:", code))
    assert not list(tmp_path.iterdir())


# --- What --cluster may say, and which schedulers are spoken to.


def test_the_four_forms(tmp_path):
    file, jobs = tmp_path / "scheduler.json", tmp_path / "slurm.yml"
    file.write_text(json.dumps({"address": "tls://10.0.0.1:8786"}))
    jobs.write_text("jobqueue:\n  slurm: {cores: 4, memory: 8GB, walltime: '01:00:00'}\n")
    assert read_cluster("local:8") == LocalWorkers(8)
    assert read_cluster("tls://node:8786") == SchedulerAddress("tls://node:8786")
    assert read_cluster("127.0.0.1:8786").read() == "tcp://127.0.0.1:8786"
    assert read_cluster(str(file)).read() == "tls://10.0.0.1:8786"
    queue = read_cluster(str(jobs))
    assert (type(queue), queue.system, queue.n_cores) == (JobQueue, "slurm", 4)


NO_ADDRESS = "holds no scheduler's address"
NO_CLUSTER = [
    *((text, None, "N is 1 to 1,024") for text in ("local:", "local:0", "local:9999")),
    ("nowhere", None, "give ADDRESS:PORT"),
    *(("s.json", content, NO_ADDRESS) for content in ("[]", '{"address": 3}')),
    ("s.json", "", "no scheduler's file"),
    ("gone.json", None, "cannot be read"),
    ("q.yml", "jobqueue: {slurm: {cores: 4}}", "how many cores and how much memory"),
    ("q.yml", "jobqueue: {cloud: {cores: 4, memory: 8GB}}", "none of htcondor"),
    ("q.yml", "jobqueue: {slurm: {cores: 4, memory: 8GB}, pbs: {}}", "one queueing system"),
]


def test_what_is_no_cluster(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, content, words in NO_CLUSTER:
        if content is not None:
            Path(name).write_text(content)
        with pytest.raises(UserError, match=words):
            read_cluster(name).read()


@given(st.ip_addresses())
def test_an_address_is_open_unless_it_is_of_this_machine_alone(address):
    host = f"[{address}]" if address.version == 6 else str(address)
    assert is_loopback(f"tcp://{host}:8786") is ipaddress.ip_address(address).is_loopback


OPEN = ["10.0.0.1", "localhost.example.org", "0.0.0.0", "127.0.0.1@10.0.0.1"]  # noqa: S104


@pytest.mark.parametrize(
    ("address", "has_certificates", "is_insecure", "words"),
    [
        *((f"tcp://{host}:8786", True, False, "without TLS") for host in OPEN),
        ("tcp://10.0.0.1:8786", False, True, None),
        ("tcp://localhost:8786", False, False, None),
        ("tls://10.0.0.1:8786", True, False, None),
        ("tls://10.0.0.1:8786", False, True, "ca-file"),
        ("ws://127.0.0.1:8786", True, True, "begins with"),
    ],
)
def test_who_is_spoken_to(address, has_certificates, is_insecure, words):
    with pytest.raises(UserError, match=words) if words else contextlib.nullcontext():
        check_address(address, has_certificates, is_insecure)


def test_a_command_checks_before_it_connects(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="without TLS"):
        checked_cluster("192.0.2.1:8786", is_insecure=False)
    monkeypatch.setattr(schedulers, "SECONDS_TO_CONNECT", 0.2)  # eight take long
    nowhere = SchedulerAddress("127.0.0.1:1")
    with (
        pytest.raises(UserError, match="there is no scheduler"),
        cluster_launcher.cluster_launcher(nowhere, tmp_path, "c"),
    ):
        pass
    assert not list(tmp_path.iterdir())


def client_of(scheduler, worker="tcp://127.0.0.1:2", name="s"):
    """A client whose scheduler says so of itself."""
    return SimpleNamespace(
        scheduler_info=lambda n_workers: {"address": scheduler, "id": name},
        nthreads=lambda: {worker: 2},
        status="running",
        close=lambda timeout: None,
    )


@pytest.mark.parametrize(
    ("scheduler", "worker"),
    [("tcp://0.0.0.0:8786", "tcp://127.0.0.1:2"), ("tcp://127.0.0.1:1", "tcp://0.0.0.0:8786")],
)
def test_one_that_says_itself_that_it_is_open_is_refused(scheduler, worker):
    """As one on this machine that listens to its network too."""
    client = client_of(scheduler, worker)
    for is_insecure in (False, True):
        connection = Connection(lambda: client, lambda client: None, is_insecure)
        with contextlib.nullcontext() if is_insecure else pytest.raises(UserError, match="TLS"):
            connection.begin()
            assert connection.n_threads() == client.nthreads()


def test_a_scheduler_that_is_restarted_is_found_again():
    first, second = (client_of("tcp://127.0.0.1:1", name=name) for name in ("a", "b"))
    answers, prepared = iter([first, OSError("refused"), second]), []

    def connect():
        found = next(answers)
        if found in (first, second):
            return found
        raise found

    connection = Connection(connect, prepared.append, is_insecure=False)
    connection.begin()
    assert connection.client() is first
    first.status = "closed"
    assert connection.client() is second
    assert prepared == [first, second]


# --- Jobs of a queue: when their workers leave, what they are told, and which are sent again.

MINUTE, HOUR, DAY = 60, 3600, 86400
WALLTIMES = {
    ("slurm", "30"): 30 * MINUTE,
    ("slurm", "1:30:00"): 90 * MINUTE,
    ("slurm", "2-12:30:15"): 2 * DAY + 12 * HOUR + 30 * MINUTE + 15,
    ("pbs", "04:00:00"): 4 * HOUR,
    ("lsf", "90"): 90 * MINUTE,
}
NO_WALLTIMES = [
    *(("slurm", text, "of the form 30,") for text in ("", "UNLIMITED", "4h")),
    ("slurm", 14400, "in quotes"),
    ("lsf", "2-00", "of the form 90 or 1:30;"),
]


def queue_of(system, **settings):
    return JobQueue(system, {"cores": 1, "memory": "1GB", **settings}, 1, Path("q.yml"))


def test_workers_leave_before_the_walltime_ends():
    for (system, walltime), seconds in WALLTIMES.items():
        leaving = min(0.1 * seconds, 300)
        words = [f"{seconds - leaving:.0f}s", "--lifetime-stagger", f"{leaving / 2:.0f}s"]
        found = retiring(queue_of(system, walltime=walltime))
        assert found == {"worker-extra-args": ["--lifetime", *words]}, walltime
    for system, walltime, words in NO_WALLTIMES:
        with pytest.raises(UserError, match=f"^q.yml: {system}: walltime: .*{words}"):
            retiring(queue_of(system, walltime=walltime))
        own = {"walltime": walltime, "worker-extra-args": ["--lifetime", "1h"]}
        assert retiring(queue_of(system, **own)) == {}


JOBS = """
jobqueue:
  slurm:
    {{cores: 1, memory: 1GB, interface: lo, python: {python}, job_extra_directives: [-q x]}}
"""


def test_what_jobs_are_told(tmp_path, monkeypatch):
    """With TLS and keys that only this user can read; workers by the real SLURM come later."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slurm.yml").write_text(JOBS.format(python=sys.executable))
    # What killed commands have left goes, and what others still need stays.
    for name, owner in (("dead", {**mark(), "began": 1}), ("alive", mark())):
        (tmp_path / f".yardstick-keys-{name}").mkdir()
        (tmp_path / f".yardstick-keys-{name}" / "owner.json").write_text(json.dumps(owner))
    with opened_queue(read_cluster("slurm.yml"), Path("study")) as queue:
        alive, keys = sorted(
            tmp_path.glob(".yardstick-keys-*"), key=lambda path: "alive" not in path.name
        )
        assert alive.name == ".yardstick-keys-alive"
        assert keys.stat().st_mode & 0o77 == 0
        assert queue.scheduler_address.startswith("tls://")
        assert isinstance(queue.scheduler, ClosedScheduler)
        for words in (f"--tls-key {keys}/", "--no-dashboard", ClosedWorker.__name__):
            assert words in queue.job_script()
        script = queue.job_script().splitlines()
        assert {"#SBATCH --no-requeue", "#SBATCH -q x"} <= set(script)
        assert f"#SBATCH -o {tmp_path}/study/jobs/dask-worker-%J.out" in script
    assert list(tmp_path.glob(".yardstick-keys-*")) == [alive]


SLURM = ("munged", "slurmctld", "slurmd", "sbatch", "scancel", "scontrol", "squeue")


@pytest.mark.skipif(not all(map(shutil.which, SLURM)), reason="apt-get install slurm-wlm munge")
def test_a_study_by_the_real_slurm_is_that_of_this_machine():
    """With a job that is cancelled after three runs."""
    words = ["--runs", "8", "--faults", "scancel"]
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks/slurm.py"), *words],
        # Which a server of processes in this one has set for what it forks.
        env={key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        timeout=280,
    )
    assert done.returncode == 0, done.stdout
    assert "8 of 8 runs" in done.stdout


class Queue:
    """Two jobs of dask-jobqueue; its loop calls at once."""

    def __init__(self):
        self.worker_spec = {"job-1": {}, "job-10": {}}
        self.workers, self.closed, self.n_sent, self._futures = {}, [], 0, set()
        self.scheduler = SimpleNamespace(workers={})
        self.loop = SimpleNamespace(add_callback=lambda function, *args: function(*args))

    def scale(self, jobs):
        assert jobs == 2
        for name in self.worker_spec.keys() - self.workers.keys():
            self.n_sent += 1
            self.workers[name] = SimpleNamespace(close=lambda name=name: self.close(name))

    async def close(self, name):
        self.closed.append(name)


# Workers that arrive, by address; those that are lost, and those that left in good order; seconds
# that pass; and which jobs have been closed by then.
ENDINGS = [
    ({"a": "job-1-0", "b": "job-1-1"}, "", "", 0, []),
    # A job goes at once where the last of its workers has retired; the other waits in the queue.
    ({}, "a", "a", 0, []),
    ({}, "b", "ab", 0, ["job-1"]),
    ({}, "", "ab", 10 * SECONDS_TO_RESTART, ["job-1"]),
    # After a while where its worker was lost, which may come back until then.
    ({"c": "job-10"}, "", "ab", 0, ["job-1"]),
    ({}, "c", "ab", SECONDS_TO_RESTART, ["job-1"]),
    ({"d": "job-10"}, "", "ab", 0, ["job-1"]),
    ({}, "d", "ab", SECONDS_TO_RESTART, ["job-1"]),
    ({}, "", "ab", 1, ["job-1", "job-10"]),
]


def test_a_job_that_has_ended_is_sent_again(monkeypatch):
    async def play():
        queue, now = Queue(), [100.0]
        monkeypatch.setattr(schedulers, "time", SimpleNamespace(monotonic=lambda: now[0]))
        jobs = Jobs(queue, 2)
        for arriving, lost, left, seconds, closed in ENDINGS:
            for address, name in arriving.items():
                worker = SimpleNamespace(name=name, address=address)
                queue.scheduler.workers[address] = worker
            for address in lost:
                del queue.scheduler.workers[address]
            now[0] += seconds
            jobs.replace(set(left))
            await asyncio.gather(*queue._futures)
            assert (queue.closed, queue.n_sent) == (closed, 2 + len(closed))

    asyncio.run(play())


# --- Runs that do not come back: sent again, given up, or blamed.

BEGUN, LOST, RETIRED = ("begin", False), ("lose", False), ("lose", True)
# What happens to a run each time that it is sent, and after how many times it is given up.
LOSSES = {
    "its worker is lost": ([BEGUN, LOST], 3, "the worker that did it was lost 3 times (tcp://w)"),
    "it begins elsewhere": ([BEGUN], 4, "the worker that did it was lost 3 times (tcp://w)"),
    "its answer is none": ([("refuse", "odd")], 3, "3 times it did not come back as a run: odd"),
    "its worker is lost while it waits": ([LOST], 50, "it was sent 50 times and never came back"),
    "its worker retires": ([BEGUN, RETIRED], None, ""),
}


@pytest.mark.parametrize("case", LOSSES)
def test_when_a_run_is_given_up(case):
    events, n_times, reason = LOSSES[case]
    sent, count = SentRun(PLAIN), 0
    while not sent.is_given_up and count < 100:
        count += 1
        sent.n_sent += 1
        for event, value in events:
            getattr(sent, event)(*(["tcp://w"] if event == "begin" else []), value)
    assert (count, sent.reason) == (n_times or 100, reason)


# --- Files of the user's on a worker.


def test_an_installed_module_of_other_contents_is_not_used(tmp_path, monkeypatch):
    (tmp_path / "five_found.py").write_text("REWARD = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    (module,) = import_typed(["five_found"])
    sent = SentModule.of(module)
    assert sent.files is None  # what is installed is not sent
    assert sent.placed(module, tmp_path) == module
    with pytest.raises(UnfitError, match="the module five_found has other contents there"):
        replace(sent, digests={"five_found.py": "another"}).placed(module, tmp_path)


def test_files_in_settings_are_compared(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    log = tmp_path / "log.csv"
    log.write_text("1")
    spec = runs_of(tmp_path)[0].spec
    raw = {**spec.saved_hyperparams, "env_kwargs": {"a": [str(log)], "b": {"c": "log.csv"}}}
    spec = replace(spec, hyperparams=split(raw), saved_hyperparams=raw)
    assert files_in_settings(spec) == [str(log), "log.csv"]
    code = SentCode.of(spec)
    code.check_files(tmp_path)
    with pytest.raises(UnfitError, match="cannot be read"):
        code.check_files(tmp_path / "elsewhere")
    log.write_text("23")
    with pytest.raises(UnfitError, match="other contents"):
        code.check_files(tmp_path)
