"""Workers that are jobs of a queueing system, by dask-jobqueue."""

from __future__ import annotations

import asyncio
import importlib
import re
import signal
import time
import warnings
from collections.abc import Collection
from types import ModuleType
from typing import Any

import dask
from distributed import Scheduler
from distributed.security import Security

from experiments.cluster.addresses import JobQueue
from experiments.cluster.working import ClosedScheduler, ClosedWorker
from pipeline.errors import UserError, one_line

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

    Args:
        queue: of dask-jobqueue, with its scheduler in this process.
        n_jobs: how many.
    """

    def __init__(self, queue: Any, n_jobs: int) -> None:
        self._queue, self._n_jobs = queue, n_jobs
        self._seen: dict[str, tuple[set[str], float]] = {}  # of a job: its workers, and when
        queue.scale(jobs=n_jobs)

    def replace(self, left: Collection[str]) -> None:
        """Send again those whose workers have gone; called now and then.

        Args:
            left: addresses of workers that left in good order: these are not started again.
        """
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
