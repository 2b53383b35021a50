"""Reads ``--cluster``, and connects to a scheduler: an existing one, a local one, or a queue's.

Dask's messages are pickles, so anyone who can connect to a scheduler can run code as its user, on
the scheduler, on its workers and in the driver. So connections need TLS with certificates on both
sides, or stay on this machine. A lost connection is made again. dask-jobqueue starts the jobs of a
queueing system.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import ipaddress
import json
import logging
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

import dask
from distributed import Client, Nanny, Scheduler, SpecCluster
from distributed.security import Security

from rl_yardstick.experiments.cluster.working import ClosedScheduler, ClosedWorker
from rl_yardstick.pipeline.errors import UserError, one_line, shown
from rl_yardstick.pipeline.files import write_json
from rl_yardstick.pipeline.locks import is_alive, mark
from rl_yardstick.pipeline.settings.yaml import read_yaml
from rl_yardstick.pipeline.stopping import current
from rl_yardstick.safe_files.files import UnsafeFileError, read_file

# The classes of dask-jobqueue by system.
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
    """A number of workers on this machine for the duration of the command."""

    n_workers: int
    is_insecure: bool = False  # irrelevant: no other user can connect


@dataclass(frozen=True)
class SchedulerAddress:
    """An existing scheduler, by its address or by a file with the address."""

    text: str  # the address; empty if it is in the file
    file: Path | None = None  # the file, or None
    n_workers: int = 0  # workers to count on: any number is enough
    is_insecure: bool = False  # whether the user accepts a scheduler that is open to the network

    def read(self) -> str:
        """The current address, with ``tcp://`` or ``tls://``."""
        text = self.text if self.file is None else _address_in(self.file)
        return text if "://" in text else f"tcp://{text}"


@dataclass(frozen=True)
class JobQueue:
    """Workers that a queueing system starts as jobs."""

    system: str  # its name in dask-jobqueue
    settings: dict[str, Any]  # arguments for dask-jobqueue
    n_cores: int  # of each job: its parallel runs
    file: Path  # the file with these settings
    n_workers: int = 0  # parallel runs for which jobs are started
    is_insecure: bool = False  # as in a `SchedulerAddress`


Cluster = LocalWorkers | SchedulerAddress | JobQueue


def read_cluster(text: str) -> Cluster:
    """Parse ``--cluster``, or raise `UserError`."""
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
    """Refuse a scheduler that is open to the network, or uses TLS without our certificates."""
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
    """Whether an address can be reached only from its own machine."""
    host = _host(address)
    if host is None or host == "localhost":
        return host is not None
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name
        return False


def _host(address: str) -> str | None:
    """The host of an address; None if the address is invalid or lacks the port."""
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
    settings = {str(name).replace("_", "-"): value for name, value in settings.items()}
    return JobQueue(system, settings, cores, path)


# --- Jobs of a queueing system.

# The time before a job's end at which its workers retire: a share, and a maximum.
SHARE_FOR_LEAVING = 0.1
MOST_FOR_LEAVING = 300.0  # seconds

# The time-out for the restart of a killed worker, before another replaces it: Dask's 15 seconds
# are too short on a busy machine.
SECONDS_TO_RESTART = 60.0
_NEVER = 1e9  # seconds

JOB_LOGS = "jobs"  # the folder in a study's folder with the output of its jobs
_KEYS = ".yardstick-keys-"  # folders with the keys of a command
_OWNER = "owner.json"  # the file with its process

# The forms of a walltime besides hours:minutes:seconds, by system; examples; seconds of parts.
_WALLTIMES = {
    "slurm": r"(?P<d>\d+)-(?P<h>\d+)(:(?P<m>\d+)(:(?P<s>\d+))?)?|(?P<M>\d+)(:(?P<S>\d+))?",
    "lsf": r"((?P<h>\d+):)?(?P<m>\d+)",
}
_EXAMPLES = {"slurm": "30, 90:00, 1:30:00, 2-00, 2-12:30 or 2-12:30:15", "lsf": "90 or 1:30"}
_SECONDS = {"d": 86400, "h": 3600, "m": 60, "M": 60, "s": 1, "S": 1}


def has_certificates(security: Security) -> bool:
    """Whether Dask's configuration names the certificate and key for TLS."""
    tls = security.get_tls_config_for_role("client")
    return bool(tls["ca_file"] and tls["cert"])


@contextlib.contextmanager
def opened_queue(queue: JobQueue, root: Path) -> Iterator[Any]:
    """Start jobs with a scheduler in this process; makes certificates if none are given."""
    settings = {**_defaults(queue.system), **queue.settings, **retiring(queue)}
    words = settings["worker-extra-args"] or []
    if not any("dashboard" in str(word) for word in words):
        closed = f"{ClosedWorker.__module__}.{ClosedWorker.__name__}"
        settings["worker-extra-args"] = [*words, "--no-dashboard", "--worker-class", closed]
    settings["log-directory"] = settings["log-directory"] or str(root.absolute() / JOB_LOGS)
    directives = settings.get("job-extra-directives") or []
    # A job that SLURM requeues would duplicate the job that `Jobs` has submitted in its place.
    if queue.system == "slurm" and not any("requeue" in str(word) for word in directives):
        settings["job-extra-directives"] = [*directives, "--no-requeue"]
    # Otherwise Dask would cancel the waiting job of the same name that `Jobs` has submitted.
    dask.config.set({"distributed.deploy.lost-worker-timeout": _NEVER})
    kind = getattr(_library(), QUEUES[queue.system])
    options = settings["scheduler-options"] or {}
    is_closed = "dashboard_address" not in options
    with _folder_for_keys(settings["shared-temp-directory"] or str(Path.cwd())) as folder:
        settings["shared-temp-directory"] = folder
        dask.config.set({f"jobqueue.{queue.system}": settings})
        security = Security()
        if not has_certificates(security):
            security = Security.temporary()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                opened = kind(
                    security=security,
                    protocol="tls://",
                    scheduler_options={"dashboard": not is_closed, **options},
                    scheduler_cls=ClosedScheduler if is_closed else Scheduler,
                )
        except (ValueError, TypeError, OSError, RuntimeError) as error:
            raise UserError(f"{queue.file}: {one_line(error)}") from error
        try:
            with opened:
                yield opened
        finally:
            for name in ("ca_file", "cert", "key"):  # dask-jobqueue's files, which it never closes
                with contextlib.suppress(AttributeError):
                    getattr(opened, f"_job_{name}").close()


@contextlib.contextmanager
def _folder_for_keys(typed: str) -> Iterator[str]:
    """A temporary folder for keys inside ``typed``; removes folders that killed commands left.

    The path begins as the user typed it, because ``~`` may be another folder on other machines.
    """
    parent = Path(os.path.expanduser(os.path.expandvars(typed)))  # noqa: PTH111  # as Dask does
    for left in parent.glob(f"{_KEYS}*"):
        with contextlib.suppress(OSError, ValueError):
            if is_alive(json.loads((left / _OWNER).read_text(encoding="utf-8"))) is False:
                shutil.rmtree(left)
    try:
        made = TemporaryDirectory(prefix=_KEYS, dir=parent, ignore_cleanup_errors=True)
    except OSError as error:
        raise UserError(f"shared-temp-directory {typed}: {error.strerror}") from error
    with made as folder:
        write_json(Path(folder) / _OWNER, mark())
        yield f"{typed}/{Path(folder).name}"


class Jobs:
    """Keeps the wanted number of jobs, and replaces jobs that have ended.

    Dask itself notices the end of a job only if the job has a single worker. If ``listed`` returns
    the numbers of existing jobs, jobs that ended before they had workers are replaced too.
    """

    def __init__(
        self, queue: Any, n_jobs: int, listed: Callable[[], Collection[str] | None] = lambda: None
    ) -> None:
        self._queue, self._n_jobs, self._listed = queue, n_jobs, listed
        self._seen: dict[str, tuple[set[str], float]] = {}  # by job: its workers, and the time
        self._unlisted: set[str] = set()  # jobs that the system did not list at the last look
        queue.scale(jobs=n_jobs)

    def replace(self, left: Collection[str]) -> None:
        """Replace jobs whose workers are lost; not those that left in good order."""
        self._queue.loop.add_callback(self._replace, frozenset(left), self._listed())

    def _replace(self, left: frozenset[str], listed: Collection[str] | None) -> None:
        jobs, now = self._queue.workers, time.monotonic()
        before, self._unlisted = self._unlisted, set()
        for name, there in self._workers_of_jobs().items():
            if there:
                self._seen[name] = (there, now)
            elif name in self._seen and name in jobs:
                workers, last = self._seen[name]
                if workers <= left or now > last + SECONDS_TO_RESTART:
                    del self._seen[name]
                    self._close(name)
            elif listed is not None and name in jobs and str(jobs[name].job_id) not in listed:
                if name in before:
                    self._close(name)
                else:  # it may have been submitted after the list was made
                    self._unlisted.add(name)
        self._queue.scale(jobs=self._n_jobs)

    def _close(self, name: str) -> None:
        self._queue._futures.add(asyncio.ensure_future(self._queue.workers.pop(name).close()))

    def _workers_of_jobs(self) -> dict[str, set[str]]:
        """The addresses of existing workers by job."""
        workers = list(self._queue.scheduler.workers.values())
        # A single worker has the job's name; several have the name and a number.
        return {
            job: {each.address for each in workers if f"{each.name}-".startswith(f"{job}-")}
            for job in self._queue.worker_spec
        }


def listed_by_slurm() -> list[str] | None:
    """The numbers of this user's waiting and running jobs; None without an answer."""
    words = ["squeue", "--noheader", "--me", "--format=%A"]
    try:
        done = subprocess.run(words, capture_output=True, timeout=30, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode().split()


def _library() -> ModuleType:
    """Import dask-jobqueue, and restore the Ctrl-C handler that the import replaces."""
    before = signal.getsignal(signal.SIGINT)
    try:
        return importlib.import_module("dask_jobqueue")
    finally:
        signal.signal(signal.SIGINT, before)


def _defaults(system: str) -> dict[str, Any]:
    _library()
    found: dict[str, Any] = dask.config.get(f"jobqueue.{system}")
    return found


def retiring(queue: JobQueue) -> dict[str, Any]:
    """Options that make workers retire before their job ends, unless the file sets them."""
    words = queue.settings.get("worker-extra-args") or []
    settings = {**_defaults(queue.system), **queue.settings}
    if "walltime" not in settings or any(str(word).startswith("--lifetime") for word in words):
        return {}
    walltime, where = settings["walltime"], f"{queue.file}: {queue.system}: walltime"
    if not isinstance(walltime, str):  # YAML reads 04:00:00 as a number in base 60
        raise UserError(f"{where}: give it in quotes, as '04:00:00'")
    forms = (r"(?P<h>\d+):(?P<m>\d+):(?P<s>\d+)", _WALLTIMES.get(queue.system, ""))
    found = [each for form in forms if (each := re.fullmatch(form, walltime, re.ASCII))]
    parts = found[0].groupdict() if found else {}
    whole = sum(_SECONDS[unit] * int(n) for unit, n in parts.items() if n)
    if not whole:
        raise UserError(
            f"{where}: {shown(walltime)} is not of the form "
            f"{_EXAMPLES.get(queue.system, '1:30:00')}; workers stop before its end, or when you "
            "say: worker-extra-args: ['--lifetime', '80m']"
        )
    leaving = min(SHARE_FOR_LEAVING * whole, MOST_FOR_LEAVING)
    added = ["--lifetime", f"{whole - leaving:.0f}s", "--lifetime-stagger", f"{leaving / 2:.0f}s"]
    return {"worker-extra-args": [*words, *added]}


# --- The connection to a scheduler.

# How long a scheduler may be unreachable: a restart takes a few seconds, a reboot a minute.
SECONDS_WITHOUT_SCHEDULER = 120.0
SECONDS_TO_CONNECT = 8.0
_SECONDS_BETWEEN_LOOKS = 0.2


class ClusterGoneError(UserError):
    """The scheduler is lost."""


class Connection:
    """Keeps a client of a scheduler, made by ``connect``, and makes a new one after a loss.

    Each client is passed to ``prepare``.
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
        """Connect for the first time; `UserError` if the scheduler is missing or open to others."""
        try:
            self._client = self._connected()
        except OSError as error:
            raise UserError(f"--cluster: there is no scheduler: {one_line(error)}") from error

    def lose(self, client: Client) -> None:
        """Drop a lost client, also one that has connected to another scheduler instead."""
        with self._lock:
            if self._client is client and not self._closed.is_set():
                self._is_lost = True

    def client(self) -> Client:
        """Wait for a connected client; `ClusterGoneError` after the time-out."""
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
        """The parallel runs of each worker by address; refuses workers that are open to others."""
        client = self.client()
        if _identity(client)["id"] != self._identity:
            self.lose(client)
            return {}
        workers: Mapping[str, int] = client.nthreads()
        self._check_open(workers)
        return workers

    def close(self) -> None:
        """Leave the scheduler; its running tasks end."""
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
            except (OSError, UserError) as error:  # the file may be missing or half-written
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
        """Refuse a scheduler that listens to a network without TLS, whatever its address here."""
        for address in addresses:
            if not (self._is_insecure or address.startswith("tls://") or is_loopback(address)):
                raise UserError(
                    f"--cluster: {address} is open to its network without TLS: start it with "
                    "--host 127.0.0.1 or with TLS, or say --insecure-cluster"
                )


def _identity(client: Client) -> dict[str, Any]:
    """A scheduler's description of itself, including its addresses."""
    found: dict[str, Any] = client.scheduler_info(n_workers=0)
    return found


def _close(client: Client) -> None:
    # Errors while leaving do not matter.
    with contextlib.suppress(Exception):
        client.close(timeout=2)


# --- Opening a cluster.

Connect = Callable[[], Client]
Replace = Callable[[Collection[str]], object]


def checked_cluster(text: str, is_insecure: bool) -> Cluster:
    """Parse and check ``--cluster`` before anything starts; refuses a cluster open to others."""
    cluster = replace(read_cluster(text), is_insecure=is_insecure)
    if isinstance(cluster, SchedulerAddress):
        check_address(cluster.read(), has_certificates(Security()), is_insecure)
    return cluster


@contextlib.contextmanager
def opened(cluster: Cluster, root: Path) -> Iterator[tuple[Connect, Replace]]:
    """Provide a scheduler for a study in ``root`` during the ``with`` statement.

    Yields a function that makes a client, and a function to call periodically with the addresses
    of workers that left in good order, which replaces ended workers and jobs.
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
        with opened_queue(cluster, root) as queue:
            jobs = Jobs(queue, n_jobs, *([listed_by_slurm] if cluster.system == "slurm" else []))
            yield lambda: Client(queue, set_as_default=False), jobs.replace


def _be_quiet() -> None:
    """Silence the library's log: the launcher reports what matters."""
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
    """Shield child processes from signals of the terminal, which this process handles."""
    if sys.platform == "win32":
        yield
        return
    # The resource tracker unblocks SIGINT at its start, so it must start first.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _local(n_workers: int) -> Iterator[SpecCluster]:
    """Start workers on this machine, with a scheduler that accepts only them and this process.

    Loopback alone is not safe: any user of the machine could connect, and run code as this user.
    """
    security = Security.temporary()
    common = {"host": "127.0.0.1", "protocol": "tls://", "security": security, "dashboard": False}
    worker = {
        **common,
        "nthreads": 1,
        "memory_limit": 0,  # the run is in a child, which --run-memory limits
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
        # Starting workers make it fail; they end with this process.
        with contextlib.suppress(Exception):
            cluster.close()
        SpecCluster._instances.discard(cluster)  # it would retry at exit
