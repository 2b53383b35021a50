"""A worker's side: a supervisor whose child does the run, and what it tells the driver."""

from __future__ import annotations

import multiprocessing
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from distributed import Scheduler, Worker, WorkerPlugin, get_worker

from experiments import child_processes, fork_server
from experiments.child_processes import StoppedError, TaskFailedError
from experiments.cluster.answers import DONE, FAILED, STOPPED, UNFIT, Answer, files_in, packed
from experiments.cluster.orders import LEAVING, RunOrder, version
from experiments.launching import do_supervised
from experiments.run_limits import RunLimits

SECONDS_BETWEEN_LOOKS = 0.5
# The states of a task that its driver has given up, or that was lost with its scheduler.
_UNWANTED = ("cancelled", "released", "forgotten")


class _Closed:
    """Opens no port for pages: these would answer every user of the machine, without TLS."""

    def start_http_server(self, *args: Any, **kwargs: Any) -> None:
        """Dask has no setting that leaves this out."""


class ClosedScheduler(_Closed, Scheduler):
    """A scheduler that speaks TLS alone."""


class ClosedWorker(_Closed, Worker):
    """A worker that speaks TLS alone."""


class Supervisors(WorkerPlugin):
    """Makes workers able to do runs: the process that children are forked from starts at once.

    Attributes:
        warm_ups: what it is to compile once for all runs, see `experiments.warm_ups`.
    """

    name = "yardstick-supervisors"
    idempotent = True  # of several drivers, the first is enough

    def __init__(self, warm_ups: str) -> None:
        self.warm_ups = warm_ups

    def setup(self, worker: Worker) -> None:
        """Get ready; what takes long goes on in the background."""
        multiprocessing.current_process().daemon = False  # those of a nanny may have no children
        child_processes.be_ready(self.warm_ups)
        version()  # of what has been loaded, before it can change

    def teardown(self, worker: Worker) -> None:
        """End what is under way: it leaves its state where it can be reached."""
        worker.log_event(LEAVING, {"at": worker.address})
        child_processes.stop_all()
        fork_server.end_server()


@dataclass(frozen=True)
class WatchedLimits(RunLimits):
    """Limits of a run that is ended too when nobody waits for it any more."""

    is_wanted: Callable[[], bool] = lambda: True

    @property
    def pause(self) -> float | None:
        return super().pause or SECONDS_BETWEEN_LOOKS

    def exceeded(self, pid: int, elapsed: float) -> str:
        if not self.is_wanted():
            return "nobody waits for it any more"
        return super().exceeded(pid, elapsed)


def answer_to(content: bytes) -> bytes:
    """Do the run of an order, and say how it ended; see `experiments.cluster.tasks.do_order`."""
    worker = get_worker()
    key = worker.get_current_task()
    order = RunOrder.unpacked(content)
    worker.log_event(order.topic, {"run": key, "at": worker.address})
    if Supervisors.name not in worker.plugins:  # as after a scheduler was started again
        Supervisors("[]").setup(worker)
    if order.version != version():
        return packed(Answer(UNFIT, f"{worker.address} has other code or libraries than this"))
    limits = order.limits
    watched = WatchedLimits(limits.seconds, limits.memory, lambda: _is_wanted(worker, key))
    order = replace(order, limits=watched)
    try:
        if order.probe.is_there:
            _do(order, order.probe.home)
            return packed(Answer(DONE))
        return packed(_done_apart(order.apart(), Path(worker.local_directory)))
    except StoppedError:
        return packed(Answer(STOPPED))
    except TaskFailedError as error:
        return packed(Answer(FAILED, str(error), error.details))
    except OSError as error:
        return packed(Answer(FAILED, f"{worker.address}: {error}"))


def _is_wanted(worker: Worker, key: Any) -> bool:
    task = worker.state.tasks.get(key)
    return task is not None and task.state not in _UNWANTED


def _do(order: RunOrder, home: Path) -> None:
    there = replace(order.planned, path=home / order.planned.path)
    if not there.is_finished:  # else it was done before, and its worker died with the answer
        do_supervised(order.planned, order.probe.root, order.command, order.limits, home)


def _done_apart(order: RunOrder, folder: Path) -> Answer:
    """Do a run in a folder of the worker's own, and take along what it left."""
    home = folder / order.topic
    home.mkdir(exist_ok=True)
    _do(order, home)
    run, log = home / order.planned.path, order.planned.spec.tensorboard_log
    try:
        files = files_in(run, "run/")
        files |= {} if log is None else files_in(home / log, "tensorboard/")
    except ValueError as error:
        return Answer(FAILED, str(error))
    finally:
        shutil.rmtree(run, ignore_errors=True)
        if log is not None:
            shutil.rmtree(home / log, ignore_errors=True)
    return Answer(DONE, files=files)
