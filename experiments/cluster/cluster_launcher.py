"""Does runs on a cluster, and retries each lost run separately."""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from distributed import Client
from distributed import Future as DaskFuture
from distributed.scheduler import KilledWorker

from experiments.child_processes import NO_LIMITS
from experiments.cluster import do_order
from experiments.cluster.answers import (
    FAILED,
    STOPPED,
    UNFIT,
    RefusedAnswerError,
    check_in_place,
    receive,
    unpacked,
)
from experiments.cluster.schedulers import Cluster, Connection, Replace, opened
from experiments.cluster.working import LEAVING, Probe, RunOrder, Supervisors, probing, version
from experiments.launching import Launcher, RunFailure, ended
from experiments.plan import PlannedRun
from experiments.run_folders import run_name
from experiments.run_limits import RunLimits
from pipeline.errors import UserError, one_line
from pipeline.signs_of_life import Heartbeat

SECONDS_TO_GATHER = 60.0
SECONDS_BETWEEN_LOOKS = 1.0
SECONDS_BETWEEN_REPLACEMENTS = 15.0
# Answers that are processed in parallel, and so are in memory together.
N_RECEIVERS = 4


MOST_TRIES = 3
# Retries of a run that was lost without fault.
MOST_SENDS = 50


@dataclass
class SentRun:
    """A run that was sent to the scheduler.

    Only a run that has begun can have crashed its worker. A run that only waited on the worker, or
    whose worker retired in good order, or whose scheduler was lost, is sent again without blame.
    """

    planned: PlannedRun
    future: Future[RunFailure | None] = field(default_factory=Future)  # the sender waits for it
    key: str = ""  # its name at the scheduler, new at each try
    task: Any = None  # Dask's future
    n_sent: int = 0  # number of sends
    n_lost: int = 0  # number of workers lost after beginning it
    n_refused: int = 0  # number of invalid answers
    worker: str | None = None  # the worker that has begun it, if known
    reason: str = ""  # of the last loss or refusal

    def begin(self, worker: str, has_left: bool) -> None:
        """Record that a worker has begun the run; an earlier worker counts as lost."""
        self.lose(has_left)
        self.worker = worker

    def lose(self, has_left: bool) -> None:
        """Record the loss of the run's worker, if any; ``has_left``: it retired in good order."""
        if self.worker is not None and not has_left:
            self.n_lost += 1
            self.reason = f"the worker that did it was lost {self.n_lost} times ({self.worker})"
        self.worker = None

    def refuse(self, reason: str) -> None:
        """Record an invalid answer."""
        self.n_refused += 1
        self.worker = None
        self.reason = f"{self.n_refused} times it did not come back as a run: {reason}"

    @property
    def is_given_up(self) -> bool:
        """Whether the retries are used up."""
        is_sent_too_often = self.n_sent >= MOST_SENDS
        if is_sent_too_often and not self.reason:
            self.reason = f"it was sent {self.n_sent} times and never came back"
        return self.n_lost + self.n_refused >= MOST_TRIES or is_sent_too_often


@contextlib.contextmanager
def cluster_launcher(
    cluster: Cluster,
    root: Path,
    command: str,
    limits: RunLimits = NO_LIMITS,
    warm_ups: str = "[]",
    tell: Callable[[str], object] = str,
) -> Iterator[Launcher]:
    """Do runs on a cluster; ``tell`` receives the address of the dashboard, if there is one.

    Workers compile ``warm_ups`` once, see `experiments.run_in_child.warm_ups`.

    Raises:
        UserError: if there is no such cluster.
    """
    with probing(root) as probe, opened(cluster) as (connect, replace_jobs):
        launcher = ClusterLauncher(probe, command, limits, cluster.n_workers)
        prepare = partial(launcher.prepare, Supervisors(warm_ups))
        launcher.connection = connection = Connection(connect, prepare, cluster.is_insecure)
        connection.begin()
        if link := connection.client().dashboard_link:
            tell(f"dashboard: {link}")
        heart = Heartbeat(partial(launcher.look, replace_jobs), SECONDS_BETWEEN_LOOKS)
        heart.start()
        try:
            yield launcher
        finally:
            launcher.close()
            heart.stop()


class ClusterLauncher:
    """The driver's side of a cluster with at least ``n_wanted`` workers."""

    connection: Connection

    def __init__(self, probe: Probe, command: str, limits: RunLimits, n_wanted: int) -> None:
        self._probe, self._command, self._limits = probe, command, limits
        self._topic = f"yardstick-{secrets.token_hex(8)}"
        self._sent: dict[str, SentRun] = {}  # by key
        self._left: set[str] = set()  # workers
        self._lock = threading.RLock()
        self._receivers = ThreadPoolExecutor(N_RECEIVERS)
        self._n_wanted = n_wanted
        self._workers: Mapping[str, int] = {}  # parallel runs by worker
        self._replaced = time.monotonic()
        self._end: UserError | None = None

    @property
    def n_workers(self) -> int:
        """The number of parallel runs on the cluster."""
        return max(sum(self._workers.values()), self._n_wanted)

    @property
    def words(self) -> str:
        """The current number of workers, in words."""
        n, n_runs = len(self._workers), sum(self._workers.values())
        text = "1 worker" if n == 1 else f"{n:,} workers"
        return text if n == n_runs else f"{text} for {n_runs:,} runs at once"

    def prepare(self, plugin: Supervisors, client: Client) -> None:
        """Install the plugin on a scheduler's workers, and subscribe to their events."""
        for topic, handler in ((LEAVING, self._on_leaving), (self._topic, self._on_begun)):
            client.subscribe_topic(topic, handler)
        try:
            client.register_plugin(plugin)
        except Exception as error:
            raise UserError(f"--cluster: its workers can do no runs: {one_line(error)}") from error

    def submit(self, planned: PlannedRun) -> Future[RunFailure | None]:
        """See `experiments.launching.Launcher`."""
        sent = SentRun(planned)
        sent.future.set_running_or_notify_cancel()
        self._receivers.submit(self._guarded, sent, self._send)
        return sent.future

    def look(self, replace_jobs: Replace) -> None:
        """Count the workers, and check that the scheduler exists."""
        try:
            self._workers = self.connection.n_threads()
            if time.monotonic() > self._replaced + SECONDS_BETWEEN_REPLACEMENTS:
                self._replaced = time.monotonic()
                with self._lock:
                    left = frozenset(self._left)
                replace_jobs(left)
        except UserError as error:
            self._end_all(error)
        except Exception:  # noqa: BLE001  # of the library, gone just now: the next look knows more
            self._workers = {}

    def close(self) -> None:
        """Leave the cluster; running runs end there, and keep their states."""
        self._end_all(UserError("the cluster was left"))
        self.connection.close()
        self._receivers.shutdown(cancel_futures=True)

    def _end_all(self, error: UserError) -> None:
        with self._lock:
            self._end = self._end or error
            sent, self._sent = list(self._sent.values()), {}
        for each in sent:
            _set_error(each.future, error)

    def _guarded(self, sent: SentRun, function: Callable[..., object], *args: Any) -> None:
        """Pass every exception to the future, so that nothing waits for ever."""
        try:
            if self._end is not None:
                raise self._end
            function(sent, *args)
        except UserError as error:  # about the whole cluster
            _set_error(sent.future, error)
            self._end_all(error)
        except Exception as error:  # noqa: BLE001  # whoever waits for it has to know
            _set_error(sent.future, error)

    def _send(self, sent: SentRun) -> None:
        """Send a run to the scheduler, unless its retries are used up."""
        with self._lock:
            self._sent.pop(sent.key, None)
            if sent.is_given_up:
                self._settle(sent, sent.reason)
                return
            sent.n_sent += 1
            sent.key = f"{run_name(sent.planned)}-{secrets.token_hex(8)}"
            self._sent[sent.key] = sent
        order = RunOrder(
            sent.planned, self._command, self._limits, self._probe, self._topic, version()
        )
        client = self.connection.client()
        try:
            sent.task = client.submit(do_order, order.packed(), key=sent.key, pure=False)
        except (OSError, RuntimeError):  # the client has just lost its scheduler
            self.connection.lose(client)
            self._receivers.submit(self._guarded, sent, self._send)
            return
        sent.task.add_done_callback(partial(self._on_done, sent))

    def _on_done(self, sent: SentRun, task: DaskFuture[Any]) -> None:
        with contextlib.suppress(RuntimeError):  # closed
            self._receivers.submit(self._guarded, sent, self._take, task)

    def _take(self, sent: SentRun, task: DaskFuture[Any]) -> None:
        """Process the result of a run, and send the run again if there is none."""
        if sent.future.done() or sent.task is not task:
            return
        if task.status == "finished":
            try:
                content = task.result(timeout=SECONDS_TO_GATHER)
            except TimeoutError:  # its worker has died, and the run is repeated
                task.add_done_callback(partial(self._on_done, sent))
                return
            except Exception:  # noqa: BLE001  # of whatever kind, from the scheduler: it is lost
                sent.worker = None
            else:
                ending = _ending_of(sent, content, self._probe.root)
                if ending is not None:
                    self._settle(sent, *ending)
                    return
        elif task.status == "error":
            error = task.exception()
            if isinstance(error, KilledWorker):
                sent.lose(sent.worker in self._left)
            else:
                sent.refuse(one_line(error))
        else:
            sent.worker = None
            self._workers = {}
            self.connection.lose(task.client)
        self._send(sent)

    def _settle(self, sent: SentRun, reason: str, details: str = "") -> None:
        """Set the result of a run's future: done, or how it failed."""
        with self._lock:
            self._sent.pop(sent.key, None)
        failure = ended(sent.planned, self._probe.root, reason, details or f"{reason}\n")
        with contextlib.suppress(Exception):
            sent.task.release()
        if not sent.future.done():
            sent.future.set_result(failure)

    def _on_begun(self, event: Any) -> None:
        """Record which worker has begun a run; the client calls this with unchecked data."""
        match event:
            case [_, {"run": str(key), "at": str(worker)}]:
                pass
            case _:
                return
        with self._lock:
            sent = self._sent.get(key)
            if sent is not None:
                sent.begin(worker, sent.worker in self._left)
                self._left.discard(worker)
                if sent.is_given_up:
                    self._receivers.submit(self._guarded, sent, self._give_up)

    def _give_up(self, sent: SentRun) -> None:
        self._settle(sent, sent.reason)
        with contextlib.suppress(Exception):
            sent.task.cancel()

    def _on_leaving(self, event: Any) -> None:
        match event:
            case [_, {"at": str(worker)}]:
                with self._lock:
                    self._left.add(worker)


def _set_error(future: Future[RunFailure | None], error: Exception) -> None:
    if not future.done():
        future.set_exception(error)


def _ending_of(sent: SentRun, content: object, root: Path) -> tuple[str, str] | None:
    """Why a run failed, in one line and at length; both empty if it is done and in its place.

    ``content``, the worker's answer, is not trusted. Returns None if the run must be sent again;
    raises UserError for a worker that cannot do any run.
    """
    try:
        answer = unpacked(content)
        if answer.kind == FAILED:
            return answer.reason or "it does not say why", answer.details
        if answer.kind == UNFIT:
            raise UserError(f"--cluster: {answer.reason}: start it anew, from the same folder")
        if answer.kind == STOPPED:
            sent.worker = None
            return None
        if answer.files is None:
            check_in_place(sent.planned)
        else:
            receive(sent.planned, root, answer.files)
    except RefusedAnswerError as error:
        sent.refuse(one_line(error))
        return None
    except OSError as error:  # the disk is full
        return one_line(error), ""
    return "", ""
