"""Schedulers: one that is there, one with workers on this machine, one whose workers are jobs."""

from __future__ import annotations

import contextlib
import logging
import math
import signal
import sys
import warnings
from collections.abc import Callable, Collection, Iterator
from multiprocessing import resource_tracker

import dask
from distributed import Client, Nanny, SpecCluster
from distributed.security import Security

from experiments.cluster.addresses import (
    Cluster,
    LocalWorkers,
    SchedulerAddress,
    check_address,
    read_cluster,
)
from experiments.cluster.connections import SECONDS_TO_CONNECT
from experiments.cluster.job_queues import (
    QUEUES,
    SECONDS_TO_RESTART,
    Jobs,
    has_certificates,
    opened_queue,
)
from experiments.cluster.working import ClosedScheduler, ClosedWorker
from pipeline.errors import UserError, one_line
from pipeline.stopping import current

Connect = Callable[[], Client]
Replace = Callable[[Collection[str]], object]


def checked_cluster(text: str, is_told: bool) -> Cluster:
    """What ``--cluster`` means, before anything is begun.

    Raises:
        UserError: if it means nothing, or a scheduler that is open to others.
    """
    cluster = read_cluster(text, tuple(QUEUES))
    if isinstance(cluster, SchedulerAddress):
        check_address(cluster.read(), has_certificates(Security()), is_told)
    return cluster


@contextlib.contextmanager
def opened(cluster: Cluster, n_runs: int, is_told: bool) -> Iterator[tuple[Connect, Replace]]:
    """Have a scheduler while the ``with`` statement runs.

    Args:
        cluster: which.
        n_runs: for how many runs at once jobs are to be started.
        is_told: whether the user has said that an open one will do.

    Yields:
        What makes a client of it; and what is to be called now and then with the addresses of
        workers that left in good order, so that workers and jobs that have ended are replaced.
    """
    _be_quiet()
    dask.config.set({"distributed.deploy.lost-worker-timeout": SECONDS_TO_RESTART})
    if isinstance(cluster, SchedulerAddress):
        yield lambda: _client_of(cluster, is_told), _nothing
    elif isinstance(cluster, LocalWorkers):
        with _local(cluster.n_workers) as local:
            n_workers = cluster.n_workers
            yield lambda: Client(local, set_as_default=False), lambda _: local.scale(n_workers)
    else:
        n_jobs = math.ceil(n_runs / cluster.n_cores)
        with opened_queue(cluster) as queue:
            jobs = Jobs(queue, n_jobs)
            yield lambda: Client(queue, set_as_default=False), jobs.replace


def _be_quiet() -> None:
    """Let the library log nothing: what matters, the launcher tells."""
    for name in ("distributed", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "Creating scratch directories")


def _nothing(_: Collection[str]) -> None:
    """Nothing has to be done."""


def _client_of(cluster: SchedulerAddress, is_told: bool) -> Client:
    address, security = cluster.read(), Security()
    check_address(address, has_certificates(security), is_told)
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
