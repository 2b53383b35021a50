"""What ``--cluster`` says, and the way to its scheduler: one that is there, one here, or a queue's.

Dask's own messages are pickles, so whoever can talk to a scheduler can run code as its user, on the
scheduler, on its workers and in the driver. Hence a scheduler is spoken to only by TLS with
certificates on both sides, or on this machine alone. A connection that is lost is made again. Jobs
are those of a queueing system, by dask-jobqueue.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import ipaddress
import json
import logging
import math
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

import dask
from distributed import Client, Nanny, Scheduler, SpecCluster
from distributed.security import Security

from experiments.cluster.working import ClosedScheduler, ClosedWorker
from pipeline.errors import UserError, one_line, shown
from pipeline.settings.yaml import read_yaml
from pipeline.stopping import current
from safe_files.files import UnsafeFileError, read_file

# The classes of dask-jobqueue, by the names of their systems.
QUEUES = {
    "htcondor": "HTCondorCluster",
    "lsf": "LSFCluster",
    "moab": "MoabCluster",
    "oar": "OARCluster",
    "pbs": "PBSCluster",
    "sge": "SGECluster",
    "slurm": "SLURMCluster",
}
MOST_LOCAL_WORKERS = 1024
_LARGEST_FILE = 1 << 20  # bytes, of a scheduler's file
_FORMS = "ADDRESS:PORT, a scheduler's file, a YAML of dask-jobqueue, or local:N"


@dataclass(frozen=True)
class LocalWorkers:
    """That many workers on this machine, for as long as the command takes."""

    n_workers: int
    is_insecure: bool = False  # of no matter: nobody else can talk to them


@dataclass(frozen=True)
class SchedulerAddress:
    """A scheduler that is there, by its address or by the file that has it."""

    text: str  # the address; empty where it stands in the file
    file: Path | None = None  # the file; None where there is none
    n_workers: int = 0  # to be waited for: whatever there is will do
    is_insecure: bool = False  # whether the user has said that one open to the network will do

    def read(self) -> str:
        """The address, as it is now: with ``tcp://`` or ``tls://``."""
        text = self.text if self.file is None else _address_in(self.file)
        return text if "://" in text else f"tcp://{text}"


@dataclass(frozen=True)
class JobQueue:
    """Workers that a queueing system starts as jobs."""

    system: str  # its name in dask-jobqueue
    settings: dict[str, Any]  # what dask-jobqueue is told of it
    n_cores: int  # of each job, as many runs at once
    file: Path  # where that stands
    n_workers: int = 0  # for how many runs at once jobs are started
    is_insecure: bool = False  # as of a `SchedulerAddress`


Cluster = LocalWorkers | SchedulerAddress | JobQueue


def read_cluster(text: str) -> Cluster:
    """What ``--cluster`` means, or `UserError`."""
    if text.startswith("local:"):
        number = text.removeprefix("local:")
        if number.isascii() and number.isdecimal() and 0 < int(number[:9]) <= MOST_LOCAL_WORKERS:
            return LocalWorkers(int(number))
        raise UserError(f"--cluster local:N: N is 1 to {MOST_LOCAL_WORKERS:,}, not {shown(number)}")
    path = Path(text)
    if path.suffix in (".yml", ".yaml"):
        return _job_queue(path)
    if path.suffix == ".json" or path.is_file():
        return SchedulerAddress("", path)
    if _host(text) is None:
        raise UserError(f"--cluster {shown(text)}: give {_FORMS}")
    return SchedulerAddress(text)


def check_address(address: str, has_certificates: bool, is_insecure: bool) -> None:
    """Refuse a scheduler that is open to the network, or by TLS without its certificates."""
    scheme = urlsplit(address).scheme
    if scheme not in ("tcp", "tls"):
        raise UserError(f"--cluster {address}: give an address that begins with tls:// or tcp://")
    if scheme == "tls" and not has_certificates:
        raise UserError(
            f"--cluster {address}: TLS takes a ca-file and the client's cert and key in Dask's "
            "configuration, under distributed.comm.tls; docs/cluster.md shows how"
        )
    if scheme == "tcp" and not is_loopback(address) and not is_insecure:
        raise UserError(
            f"--cluster {address}: without TLS, anybody who can connect to a scheduler can run "
            "code as you; use tls://, or give --insecure-cluster if the network is yours alone"
        )


def is_loopback(address: str) -> bool:
    """Whether an address can be reached from its own machine alone."""
    host = _host(address)
    if host is None or host == "localhost":
        return host is not None
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name
        return False


def _host(address: str) -> str | None:
    """The host of an address; None where it is none, or lacks the port."""
    try:
        parts = urlsplit(address if "://" in address else f"tcp://{address}")
        return parts.hostname if parts.port else None
    except ValueError:
        return None


def _address_in(path: Path) -> str:
    try:
        found = json.loads(read_file(path, _LARGEST_FILE))
    except OSError as error:
        raise UserError(f"--cluster {path}: cannot be read: {error.strerror}") from error
    except (UnsafeFileError, ValueError, RecursionError) as error:
        raise UserError(f"--cluster {path}: is no scheduler's file") from error
    address = found.get("address") if isinstance(found, dict) else None
    if not isinstance(address, str) or _host(address) is None:
        raise UserError(f"--cluster {path}: holds no scheduler's address")
    return address


def _job_queue(path: Path) -> JobQueue:
    content = read_yaml(path)
    queues = content.get("jobqueue") if isinstance(content, dict) else None
    if not isinstance(queues, dict) or len(content) != 1 or len(queues) != 1:
        raise UserError(f"{path}: must hold the key jobqueue, and in it one queueing system")
    ((system, settings),) = queues.items()
    if system not in QUEUES:
        raise UserError(f"{path}: {shown(system)} is none of {', '.join(QUEUES)}")
    if not isinstance(settings, dict) or not {"cores", "memory"} <= settings.keys():
        raise UserError(f"{path}: {system}: say how many cores and how much memory a job has")
    cores = settings["cores"]
    if not isinstance(cores, int) or isinstance(cores, bool) or cores < 1:
        raise UserError(f"{path}: {system}: cores must be a whole number, not {shown(cores)}")
    return JobQueue(system, settings, cores, path)


# --- Jobs of a queueing system.

# Of the time that a job has, what its workers leave for going: they retire before it is over.
SHARE_FOR_LEAVING = 0.1
MOST_FOR_LEAVING = 300.0  # seconds

# How long a killed worker may take to be started again, before it is given up for another: Dask's
# 15 seconds are soon over on a machine that is busy.
SECONDS_TO_RESTART = 60.0
_NEVER = 1e9  # seconds

_WALLTIME = re.compile(r"(?:(\d{1,4})-)?(\d{1,4}):(\d\d):(\d\d)")


def has_certificates(security: Security) -> bool:
    """Whether Dask's configuration names what TLS takes to prove oneself."""
    tls = security.get_tls_config_for_role("client")
    return bool(tls["ca_file"] and tls["cert"])


def opened_queue(queue: JobQueue) -> Any:
    """Jobs whose scheduler is in this process; with certificates of its own, if none are given."""
    settings = {**queue.settings, **_retiring(queue)}
    words = settings.get("worker-extra-args") or []
    if not any("dashboard" in str(word) for word in words):
        closed = f"{ClosedWorker.__module__}.{ClosedWorker.__name__}"
        settings["worker-extra-args"] = [*words, "--no-dashboard", "--worker-class", closed]
    dask.config.set({f"jobqueue.{queue.system}": {**_defaults(queue.system), **settings}})
    # Else it would end the job of the same name that `Jobs` has sent instead, while that waits.
    dask.config.set({"distributed.deploy.lost-worker-timeout": _NEVER})
    kind = getattr(_library(), QUEUES[queue.system])
    security = Security()
    if not has_certificates(security):
        security = Security.temporary()
    options = settings.get("scheduler-options") or {}
    is_closed = "dashboard_address" not in options
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return kind(
                security=security,
                protocol="tls://",
                scheduler_options={"dashboard": not is_closed, **options},
                scheduler_cls=ClosedScheduler if is_closed else Scheduler,
            )
    except (ValueError, TypeError, OSError, RuntimeError) as error:
        raise UserError(f"{queue.file}: {one_line(error)}") from error


class Jobs:
    """As many jobs as are wanted, of which those that have ended are sent again.

    Dask finds out that a job has ended only where one worker is all of it.
    """

    def __init__(self, queue: Any, n_jobs: int) -> None:
        self._queue, self._n_jobs = queue, n_jobs
        self._seen: dict[str, tuple[set[str], float]] = {}  # of a job: its workers, and when
        queue.scale(jobs=n_jobs)

    def replace(self, left: Collection[str]) -> None:
        """Send again those whose workers have gone; not those that left in good order."""
        self._queue.loop.add_callback(self._replace, frozenset(left))

    def _replace(self, left: frozenset[str]) -> None:
        jobs, now = self._queue.workers, time.monotonic()
        for name, there in self._workers_of_jobs().items():
            if there:
                self._seen[name] = (there, now)
            elif name in self._seen and name in jobs:
                workers, last = self._seen[name]
                if workers <= left or now > last + SECONDS_TO_RESTART:
                    del self._seen[name]
                    self._queue._futures.add(asyncio.ensure_future(jobs.pop(name).close()))
        self._queue.scale(jobs=self._n_jobs)

    def _workers_of_jobs(self) -> dict[str, set[str]]:
        """The addresses of the workers that there are, by their job."""
        workers = list(self._queue.scheduler.workers.values())
        # One has the job's name, several have numbers behind it.
        return {
            job: {each.address for each in workers if f"{each.name}-".startswith(f"{job}-")}
            for job in self._queue.worker_spec
        }


def _library() -> ModuleType:
    """Dask-jobqueue; importing it takes Ctrl-C for itself, which is given back."""
    before = signal.getsignal(signal.SIGINT)
    try:
        return importlib.import_module("dask_jobqueue")
    finally:
        signal.signal(signal.SIGINT, before)


def _defaults(system: str) -> dict[str, Any]:
    _library()
    found: dict[str, Any] = dask.config.get(f"jobqueue.{system}")
    return found


def _retiring(queue: JobQueue) -> dict[str, Any]:
    """What lets workers retire before their job is ended, where the file does not say it."""
    words = queue.settings.get("worker-extra-args") or []
    walltime = queue.settings.get("walltime", _defaults(queue.system).get("walltime"))
    if not isinstance(walltime, str | None):  # YAML takes 04:00:00 for a number in base 60
        raise UserError(f"{queue.file}: {queue.system}: put walltime in quotes, as '04:00:00'")
    parts = _WALLTIME.fullmatch(walltime or "")
    if parts is None or any(str(word).startswith("--lifetime") for word in words):
        return {}
    days, hours, minutes, seconds = (int(part or 0) for part in parts.groups())
    whole = 86400 * days + 3600 * hours + 60 * minutes + seconds
    leaving = min(SHARE_FOR_LEAVING * whole, MOST_FOR_LEAVING)
    added = ["--lifetime", f"{whole - leaving:.0f}s", "--lifetime-stagger", f"{leaving / 2:.0f}s"]
    return {"worker-extra-args": [*words, *added]}


# --- The connection to a scheduler.

# How long a scheduler may be gone: to be started again takes a few seconds, a reboot a minute.
SECONDS_WITHOUT_SCHEDULER = 120.0
SECONDS_TO_CONNECT = 8.0
_SECONDS_BETWEEN_LOOKS = 0.2


class ClusterGoneError(UserError):
    """There is no scheduler any more."""


class Connection:
    """A client of a scheduler, made by ``connect``, and another when it has lost it.

    Each is handed to ``prepare``.
    """

    def __init__(
        self, connect: Callable[[], Client], prepare: Callable[[Client], None], is_insecure: bool
    ) -> None:
        self._connect = connect
        self._prepare = prepare
        self._is_insecure = is_insecure
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._client: Client | None = None
        self._is_lost = False
        self._identity = ""

    def begin(self) -> None:
        """Connect for the first time; `UserError` if there is no scheduler, or an open one."""
        try:
            self._client = self._connected()
        except OSError as error:
            raise UserError(f"--cluster: there is no scheduler: {one_line(error)}") from error

    def lose(self, client: Client) -> None:
        """Take a client for lost: also one that has found another scheduler in its place."""
        with self._lock:
            if self._client is client and not self._closed.is_set():
                self._is_lost = True

    def client(self) -> Client:
        """A client that has its scheduler, which is waited for; else `ClusterGoneError`."""
        with self._lock:
            client = self._client
            if client is None or self._closed.is_set():
                raise ClusterGoneError("the cluster is closed")
            if client.status == "running" and not self._is_lost:
                return client
            _close(client)
            self._client, self._is_lost = self._waited_for(), False
            return self._client

    def n_threads(self) -> Mapping[str, int]:
        """How many runs each worker does at once, by address; a worker must not be open."""
        client = self.client()
        if _identity(client)["id"] != self._identity:
            self.lose(client)
            return {}
        workers: Mapping[str, int] = client.nthreads()
        self._check_open(workers)
        return workers

    def close(self) -> None:
        """Leave the scheduler; what is under way there ends."""
        self._closed.set()
        with self._lock:
            if self._client is not None:
                _close(self._client)
                self._client = None

    def _waited_for(self) -> Client:
        until = time.monotonic() + SECONDS_WITHOUT_SCHEDULER
        reason = "it is gone"
        while time.monotonic() < until and not self._closed.is_set():
            try:
                return self._connected()
            except (OSError, UserError) as error:  # its file may be missing, or half-written
                reason = one_line(error)
            time.sleep(_SECONDS_BETWEEN_LOOKS)
        raise ClusterGoneError(
            f"--cluster: there was no scheduler for {SECONDS_WITHOUT_SCHEDULER:.0f} s ({reason}); "
            "finished runs are kept, and the same command continues"
        )

    def _connected(self) -> Client:
        client = self._connect()
        try:
            identity = _identity(client)
            self._check_open([identity["address"]])
            self._identity = identity["id"]
            self._prepare(client)
        except BaseException:
            _close(client)
            raise
        return client

    def _check_open(self, addresses: Any) -> None:
        """Refuse what listens to a network without TLS, whatever it was called here."""
        for address in addresses:
            if not (self._is_insecure or address.startswith("tls://") or is_loopback(address)):
                raise UserError(
                    f"--cluster: {address} is open to its network without TLS: start it with "
                    "--host 127.0.0.1 or with TLS, or say --insecure-cluster"
                )


def _identity(client: Client) -> dict[str, Any]:
    """What a scheduler says of itself: where it listens among it."""
    found: dict[str, Any] = client.scheduler_info(n_workers=0)
    return found


def _close(client: Client) -> None:
    # Whatever goes wrong in leaving, there is nothing left to be done.
    with contextlib.suppress(Exception):
        client.close(timeout=2)


# --- Opening a cluster.

Connect = Callable[[], Client]
Replace = Callable[[Collection[str]], object]


def checked_cluster(text: str, is_insecure: bool) -> Cluster:
    """What ``--cluster`` means, before anything is begun; refused if it is open to others."""
    cluster = replace(read_cluster(text), is_insecure=is_insecure)
    if isinstance(cluster, SchedulerAddress):
        check_address(cluster.read(), has_certificates(Security()), is_insecure)
    return cluster


@contextlib.contextmanager
def opened(cluster: Cluster) -> Iterator[tuple[Connect, Replace]]:
    """Have a scheduler while the ``with`` statement runs.

    Yields what makes a client of it; and what is to be called now and then with the addresses of
    workers that left in good order, so that workers and jobs that have ended are replaced.
    """
    _be_quiet()
    dask.config.set({"distributed.deploy.lost-worker-timeout": SECONDS_TO_RESTART})
    if isinstance(cluster, SchedulerAddress):
        yield lambda: _client_of(cluster), lambda _: None
    elif isinstance(cluster, LocalWorkers):
        with _local(cluster.n_workers) as local:
            n_workers = cluster.n_workers
            yield lambda: Client(local, set_as_default=False), lambda _: local.scale(n_workers)
    else:
        n_jobs = math.ceil(cluster.n_workers / cluster.n_cores)
        with opened_queue(cluster) as queue:
            jobs = Jobs(queue, n_jobs)
            yield lambda: Client(queue, set_as_default=False), jobs.replace


def _be_quiet() -> None:
    """Let the library log nothing: what matters, the launcher tells."""
    for name in ("distributed", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "Creating scratch directories")


def _client_of(cluster: SchedulerAddress) -> Client:
    address, security = cluster.read(), Security()
    check_address(address, has_certificates(security), cluster.is_insecure)
    try:
        return Client(address, timeout=SECONDS_TO_CONNECT, set_as_default=False, security=security)
    except (ValueError, RuntimeError) as error:
        raise UserError(f"--cluster {address}: {one_line(error)}") from error


@contextlib.contextmanager
def _left_to_driver() -> Iterator[None]:
    """Let what is started leave signals to this process, which reach all of a terminal at once."""
    if sys.platform == "win32":
        yield
        return
    # It lets SIGINT through again after its own start, so that has to come first.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _local(n_workers: int) -> Iterator[SpecCluster]:
    """Workers on this machine, and nobody but them and this process can talk to the scheduler.

    Loopback alone would not do: any user of the machine could, and have their code run by this one.
    """
    security = Security.temporary()
    common = {"host": "127.0.0.1", "protocol": "tls://", "security": security, "dashboard": False}
    worker = {
        **common,
        "nthreads": 1,
        "memory_limit": 0,  # a run's memory is its child's, and what --run-memory is about
        "silence_logs": logging.CRITICAL,
        "worker_class": ClosedWorker,
    }
    with current().held(), _left_to_driver():
        cluster = SpecCluster(
            scheduler={"cls": ClosedScheduler, "options": {**common, "port": 0}},
            worker={"cls": Nanny, "options": worker},
            security=security,
            silence_logs=logging.CRITICAL,
        )
    try:
        current().raise_if_asked()
        cluster.scale(n_workers)
        yield cluster
    finally:
        # Workers that are about to start make it fail; they end with this process.
        with contextlib.suppress(Exception):
            cluster.close()
        SpecCluster._instances.discard(cluster)  # it would try again at the end
