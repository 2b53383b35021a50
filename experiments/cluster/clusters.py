"""Schedulers: one that is there, one with workers on this machine, one whose workers are jobs."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Callable, Iterator
from typing import Any

from distributed import Client, LocalCluster
from distributed.security import Security

from experiments.cluster.addresses import (
    Cluster,
    LocalWorkers,
    SchedulerAddress,
    check_address,
    read_cluster,
)
from experiments.cluster.connections import SECONDS_TO_CONNECT
from experiments.cluster.job_queues import QUEUES, has_certificates, opened_queue
from pipeline.errors import UserError, one_line

Connect = Callable[[], Client]


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
def opened(
    cluster: Cluster, n_runs: int, is_told: bool
) -> Iterator[tuple[Connect, Callable[[], object]]]:
    """Have a scheduler while the ``with`` statement runs.

    Args:
        cluster: which.
        n_runs: for how many runs at once jobs are to be started.
        is_told: whether the user has said that an open one will do.

    Yields:
        What makes a client of it; and what is to be called now and then, so that jobs that have
        ended are replaced.
    """
    _be_quiet()
    if isinstance(cluster, SchedulerAddress):
        yield lambda: _client_of(cluster, is_told), _nothing
    elif isinstance(cluster, LocalWorkers):
        with _local(cluster.n_workers) as local:
            yield lambda: Client(local, set_as_default=False), _nothing
    else:
        n_jobs = math.ceil(n_runs / cluster.n_cores)
        with opened_queue(cluster) as queue:
            queue.scale(jobs=n_jobs)
            yield lambda: Client(queue, set_as_default=False), lambda: queue.scale(jobs=n_jobs)


def _be_quiet() -> None:
    """Let the library log nothing: what matters, the launcher tells."""
    for name in ("distributed", *logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)


def _nothing() -> None:
    """Nothing has to be done."""


def _client_of(cluster: SchedulerAddress, is_told: bool) -> Client:
    address, security = cluster.read(), Security()
    check_address(address, has_certificates(security), is_told)
    try:
        return Client(address, timeout=SECONDS_TO_CONNECT, set_as_default=False, security=security)
    except (ValueError, RuntimeError) as error:
        raise UserError(f"--cluster {address}: {one_line(error)}") from error


def _local(n_workers: int) -> Any:
    """Workers on this machine, and nobody but them and this process can talk to the scheduler.

    Loopback alone would not do: any user of the machine could, and have their code run by this one.
    """
    return LocalCluster(
        n_workers=n_workers,
        threads_per_worker=1,
        host="127.0.0.1",
        protocol="tls://",
        security=Security.temporary(),
        dashboard_address="127.0.0.1:0",
        memory_limit=0,  # a run's memory is its child's, and --run-memory's matter
        silence_logs=logging.CRITICAL,
    )
