"""Workers that are jobs of a queueing system, by dask-jobqueue."""

from __future__ import annotations

import importlib
import re
import signal
import warnings
from types import ModuleType
from typing import Any

import dask
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
        settings["worker-extra-args"] = [*words, "--dashboard-address", "127.0.0.1:0"]
    dask.config.set({f"jobqueue.{queue.system}": {**_defaults(queue.system), **settings}})
    kind = getattr(_library(), QUEUES[queue.system])
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
