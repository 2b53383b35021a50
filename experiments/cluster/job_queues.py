"""Workers that are jobs of a queueing system, by dask-jobqueue."""

from __future__ import annotations

import importlib
import math
import shlex
import warnings
from typing import Any

import dask
from dask.utils import parse_timedelta
from distributed.security import Security

from experiments.cluster.addresses import JobQueue
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


def has_certificates(security: Security) -> bool:
    """Whether Dask's configuration names what TLS takes to prove oneself."""
    tls = security.get_tls_config_for_role("client")
    return bool(tls["ca_file"] and tls["cert"])


def opened_queue(queue: JobQueue) -> Any:
    """Jobs whose scheduler is in this process; with certificates of its own, if none are given."""
    settings = {**queue.settings, **_retiring(queue)}
    dask.config.set({f"jobqueue.{queue.system}": {**_defaults(queue.system), **settings}})
    kind = getattr(importlib.import_module("dask_jobqueue"), QUEUES[queue.system])
    security = Security()
    if not has_certificates(security):
        security = Security.temporary()
    options = {"dashboard_address": "127.0.0.1:0", **settings.get("scheduler-options", {})}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return kind(security=security, protocol="tls://", scheduler_options=options)
    except (ValueError, TypeError, OSError, RuntimeError) as error:
        raise UserError(f"{queue.file}: {one_line(error)}") from error


def _defaults(system: str) -> dict[str, Any]:
    importlib.import_module("dask_jobqueue")
    found: dict[str, Any] = dask.config.get(f"jobqueue.{system}")
    return found


def _retiring(queue: JobQueue) -> dict[str, Any]:
    """What lets workers retire before their job is ended, where the file does not say it."""
    words = queue.settings.get("worker-extra-args") or []
    walltime = queue.settings.get("walltime", _defaults(queue.system).get("walltime"))
    if any(str(word).startswith("--lifetime") for word in words) or walltime is None:
        return {}
    seconds = _seconds(str(walltime), queue)
    leaving = min(SHARE_FOR_LEAVING * seconds, MOST_FOR_LEAVING)
    times = [math.floor(seconds - leaving), math.floor(leaving / 2)]
    added = shlex.split("--lifetime {}s --lifetime-stagger {}s".format(*times))
    return {"worker-extra-args": [*words, *added]}


def _seconds(walltime: str, queue: JobQueue) -> float:
    """A time such as ``1-12:00:00``, ``04:00:00`` or ``90``, which is minutes."""
    days, _, rest = walltime.rpartition("-")
    parts = rest.split(":")
    try:
        numbers = [float(part) for part in parts]
        if days:
            hours = numbers + [0.0] * (3 - len(numbers))
            return float(days) * 86400 + hours[0] * 3600 + hours[1] * 60 + hours[2]
        if len(numbers) == 1:
            return numbers[0] * 60
        return sum(number * 60**power for power, number in enumerate(reversed(numbers)))
    except ValueError:
        pass
    try:
        found: float = parse_timedelta(walltime)
        return found
    except (ValueError, KeyError) as error:
        where = f"{queue.file}: {queue.system}"
        raise UserError(f"{where}: walltime must be such as 04:00:00, not {walltime!r}") from error
