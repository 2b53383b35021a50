"""Runs of a study on a cluster, through Dask: `do_run`, unchanged, on its workers.

The workers share the study's folder with this process, and have the same versions of the libraries:
both are checked at the start. Runs of a lost worker are done again by others, three times at most.
Encryption and certificates are matters of Dask's own configuration.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Collection
from concurrent.futures import Future
from functools import cached_property
from pathlib import Path
from signal import SIGTERM
from typing import Any

import dask
import dask_jobqueue
from distributed import Client, LocalCluster

from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.pool import Workers, do_run
from rl_yardstick.pipeline.errors import Stopped, UserError, as_user_error, shown
from rl_yardstick.pipeline.run import Stop, versions
from rl_yardstick.pipeline.settings import read_yaml

# The systems of dask-jobqueue, in the names of its classes.
SYSTEMS = ("HTCondor", "LSF", "Moab", "OAR", "PBS", "SGE", "SLURM")
_ONE_AT_A_TIME = threading.Lock()  # the libraries' generators belong to a whole process


class ClusterWorkers(Workers):
    """The workers of a Dask cluster, which is connected to when the first run is submitted.

    Args:
        where: the scheduler's address, its file, a YAML file of dask-jobqueue, or ``local:N``.
        n_jobs: runs at once, for a queue of jobs.
        root: the study's folder, which all workers share.
        timeout: seconds for each run; None for any time.
    """

    def __init__(self, where: str, n_jobs: int, root: Path, timeout: float | None = None) -> None:
        super().__init__(max(n_jobs, 1), timeout)
        self.where, self.n_jobs, self.root = where, n_jobs, root.absolute()
        self.words = f"on the cluster {where}"
        self._cluster: Any = None
        if n_jobs and not where.endswith((".yml", ".yaml")):
            raise UserError("--jobs is for this machine or a queue of jobs: leave it out")
        is_file = where.endswith((".yml", ".yaml")) or Path(where).is_file()
        if not is_file and not where.rpartition(":")[2].isdecimal():
            forms = "ADDRESS:PORT, a scheduler's file, a YAML of dask-jobqueue, or local:N"
            raise UserError(f"--cluster {where}: give {forms}")

    def submit(self, planned: PlannedRun, command: str) -> Future[None]:
        """Do a run as soon as a worker is free."""
        given = planned, command, str(Path.cwd()), self.timeout
        future: Future[None] = self._client.get_executor(pure=False).submit(_do_run, *given)
        self.n_at_once = 2 * max(len(self._client.scheduler_info(-1)["workers"]), 1)
        return future

    def end(self, under_way: Collection[Future[None]] = ()) -> None:
        """Give back the workers; Dask sends them a SIGTERM."""
        if "_client" in vars(self):
            self._client.close(timeout=5)
        if self._cluster is not None:
            self._cluster.close(timeout=30)

    @cached_property
    def _client(self) -> Any:
        """The connection, after a check of versions and of the shared folder."""
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        with as_user_error(f"--cluster {self.where}", OSError, ValueError, TypeError, RuntimeError):
            client = self._connected()
            client.wait_for_workers(1, timeout=600)
            client.get_versions(check=True)
            found = client.run(_facts, str(self.root))
        for worker, (theirs, shares_folder) in found.items():
            for name, version in versions().items():
                if theirs.get(name) != version:
                    there = f"{name} {theirs.get(name)}"
                    raise UserError(f"worker {worker} has {there}, here is {version}")
            if not shares_folder:
                raise UserError(f"worker {worker} does not have the folder {self.root}")
        return client

    def _connected(self) -> Client:
        kind, _, number = self.where.partition(":")
        if kind == "local" and number.isdecimal() and int(number) > 0:
            options = {"threads_per_worker": 1, "dashboard_address": ":0"}  # any port
            self._cluster = LocalCluster(n_workers=int(number), **options)
        elif self.where.endswith((".yml", ".yaml")):
            self._cluster = _job_queue(Path(self.where), self.n_jobs)
        elif Path(self.where).is_file():
            return Client(scheduler_file=self.where)
        return Client(self._cluster or self.where)


def _job_queue(path: Path, n_jobs: int) -> Any:
    """Jobs of a queueing system, as dask-jobqueue's own YAML describes them."""
    content = read_yaml(path)
    asked = content.get("jobqueue") if isinstance(content, dict) else None
    if not isinstance(asked, dict) or len(asked) != 1:
        raise UserError(f"{path} must hold the key jobqueue, and in it one queueing system")
    ((system, given),) = asked.items()
    queues = {name.lower(): getattr(dask_jobqueue, f"{name}Cluster") for name in SYSTEMS}
    if system not in queues or not isinstance(given, dict):
        raise UserError(f"{path}: {shown(system)} is none of {', '.join(queues)}")
    if n_jobs < 1:
        raise UserError(f"{path}: say how many runs to do at once: --jobs N")
    settings = {str(name).replace("_", "-"): value for name, value in given.items()}
    settings["processes"] = settings.get("cores")  # one run in each
    # The library's own defaults for what the file leaves out.
    dask.config.set({f"jobqueue.{system}": {**dask.config.get(f"jobqueue.{system}"), **settings}})
    cluster = queues[system]()
    cluster.scale(n_jobs)
    return cluster


def _facts(root: str) -> tuple[dict[str, str], bool]:
    return versions(), Path(root).is_dir()


def _do_run(planned: PlannedRun, command: str, home: str, timeout: float | None) -> None:
    """Do a run on a worker, in the folder in which the command was typed."""
    stop = Stop()
    timer = threading.Timer(timeout or threading.TIMEOUT_MAX, setattr, (stop, "number", SIGTERM))
    timer.daemon = True
    with _ONE_AT_A_TIME:
        os.chdir(home)
        timer.start()
        try:
            do_run(planned, command, stop)
        except Stopped:
            raise UserError(f"took longer than --run-timeout allows, {timeout:g} s") from None
        finally:
            timer.cancel()
