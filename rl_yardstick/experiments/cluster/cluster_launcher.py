"""Does runs on a cluster, and retries each lost run separately."""

from __future__ import annotations

import contextlib
import json
import secrets
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from distributed import Client
from distributed import Future as DaskFuture
from distributed.scheduler import KilledWorker

from rl_yardstick.experiments.child_processes import NO_LIMITS
from rl_yardstick.experiments.cluster import do_order
from rl_yardstick.experiments.cluster.answers import (
    FAILED,
    STOPPED,
    UNFIT,
    Answer,
    RefusedAnswerError,
    check_in_place,
    receive,
    unpacked,
)
from rl_yardstick.experiments.cluster.schedulers import Cluster, Connection, Replace, opened
from rl_yardstick.experiments.cluster.sent_code import SentCode, SentModule, differences, versions
from rl_yardstick.experiments.cluster.working import (
    LEAVING,
    Probe,
    RunOrder,
    Supervisors,
    found_versions,
    probing,
)
from rl_yardstick.experiments.launching import Launcher, RunFailure, ended
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.run_folders import run_name
from rl_yardstick.experiments.run_limits import RunLimits
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.signs_of_life import Heartbeat
from rl_yardstick.pipeline.user_modules import UserModule

SECONDS_TO_GATHER = 60.0
SECONDS_BETWEEN_LOOKS = 1.0
SECONDS_BETWEEN_REPLACEMENTS = 15.0
# Answers that are processed in parallel, and so are in memory together.
N_RECEIVERS = 4


MOST_TRIES = 3
# The largest number of times that a run is sent.
MOST_SENDS = 50
# The time-out while every existing worker has other code than this command.
SECONDS_WITHOUT_FIT_WORKERS = 120.0


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
    n_sent: int = 0  # number of sends, except those whose worker left in good order
    n_lost: int = 0  # number of workers lost after beginning it
    n_refused: int = 0  # number of invalid answers
    worker: str | None = None  # the worker that has begun it, if known
    reason: str = ""  # of the last loss or refusal
    n_aside: int = 0  # number of workers that had been set aside when it was sent

    def begin(self, worker: str, has_left: bool) -> None:
        """Record that a worker has begun the run; an earlier worker counts as lost."""
        self.lose(has_left)
        self.worker = worker

    def lose(self, has_left: bool) -> None:
        """Record the loss of the run's worker, if any; ``has_left``: it retired in good order."""
        if self.worker is not None and not has_left:
            self.n_lost += 1
            self.reason = f"the worker that did it was lost {self.n_lost} times ({self.worker})"
        self.excuse(has_left)

    def excuse(self, has_left: bool) -> None:
        """Forget the run's worker; if it retired in good order, the last send does not count."""
        self.n_sent -= has_left and self.worker is not None
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
    """Do runs on a cluster; ``tell`` gets the dashboard's address, and workers that do no runs.

    Workers compile ``warm_ups`` once, see `experiments.run_in_child.warm_ups`.

    Raises:
        UserError: if there is no such cluster.
    """
    with probing(root) as probe, opened(cluster, root) as (connect, replace_jobs):
        launcher = ClusterLauncher(probe, command, limits, cluster.n_workers, tell)
        prepare = partial(launcher.prepare, Supervisors(warm_ups, _modules_in(warm_ups)))
        launcher.connection = connection = Connection(connect, prepare, cluster.is_insecure)
        connection.begin()
        if link := connection.client().dashboard_link:
            tell(f"dashboard: {link}")
        launcher.look(replace_jobs)
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

    def __init__(
        self,
        probe: Probe,
        command: str,
        limits: RunLimits,
        n_wanted: int,
        tell: Callable[[str], object] = str,
    ) -> None:
        self._probe, self._command, self._limits = probe, command, limits
        self._topic = f"yardstick-{secrets.token_hex(8)}"
        self._sent: dict[str, SentRun] = {}  # by key
        self._left: set[str] = set()  # workers
        self._lock = threading.RLock()
        self._receivers = ThreadPoolExecutor(N_RECEIVERS)
        self._n_wanted = n_wanted
        self._tell = tell
        self._workers: Mapping[str, int] = {}  # parallel runs by worker that is not set aside
        self._asked: set[str] = set()  # workers whose versions are known
        self._aside: dict[str, str] = {}  # by worker: why it does no runs
        self._n_aside = 0  # number of workers that were ever set aside
        self._fit_until = time.monotonic()
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
        self._asked = set()  # of another scheduler, if any
        with contextlib.suppress(Exception):  # workers with other code fail, and are set aside
            client.register_plugin(plugin)

    def submit(self, planned: PlannedRun) -> Future[RunFailure | None]:
        """See `experiments.launching.Launcher`."""
        sent = SentRun(planned)
        sent.future.set_running_or_notify_cancel()
        self._receivers.submit(self._guarded, sent, self._send)
        return sent.future

    def look(self, replace_jobs: Replace) -> None:
        """Count the workers, and check that the scheduler exists."""
        try:
            self._look_at(self.connection.n_threads())
            if time.monotonic() > self._replaced + SECONDS_BETWEEN_REPLACEMENTS:
                self._replaced = time.monotonic()
                with self._lock:
                    left = frozenset(self._left)
                replace_jobs(left)
        except UserError as error:
            self._end_all(error)
        except Exception:  # noqa: BLE001  # an error of the library: the next look retries
            self._workers = {}

    def _look_at(self, found: Mapping[str, int]) -> None:
        """Set aside workers with other code, and keep the others busy."""
        self._ask(found.keys() - self._asked)
        with self._lock:
            self._aside = {at: why for at, why in self._aside.items() if at in found}
            fit = {at: n for at, n in found.items() if at not in self._aside}
            is_new, self._workers = fit.keys() != self._workers.keys(), fit
            now = time.monotonic()
            self._fit_until = now if fit or not self._aside else self._fit_until
            waiting = [each for each in self._sent.values() if each.worker not in found]
        if now > self._fit_until + SECONDS_WITHOUT_FIT_WORKERS:
            raise UserError(
                f"--cluster: for {SECONDS_WITHOUT_FIT_WORKERS:.0f} s no worker had the code of "
                f"this command ({next(iter(self._aside.values()))}): restart the workers with the "
                "same versions; finished runs are kept, and the same command continues"
            )
        if is_new and self._aside:
            for each in waiting:
                self._receivers.submit(self._guarded, each, self._send_elsewhere)

    def _ask(self, workers: Collection[str]) -> None:
        """Ask new workers for their versions."""
        if not workers:
            return
        client = self.connection.client()
        answers = client.run(found_versions, workers=list(workers), on_error="return")
        for at, answer in answers.items():
            self._asked.add(at)
            match answer:
                case {"name": str(name), "versions": dict(found)}:
                    if told := differences(versions(), found):
                        self._set_aside(at, f"{name}: {told}")
                case OSError():  # it is gone
                    self._asked.discard(at)
                case _:  # it lacks this project, or a part of it
                    self._set_aside(at, f"{at}: {one_line(answer)}")

    def _set_aside(self, worker: str, reason: str) -> None:
        """Send no more runs to a worker."""
        with self._lock:
            is_new = worker not in self._aside
            self._n_aside += is_new
            self._aside[worker] = reason
            self._workers = {at: n for at, n in self._workers.items() if at != worker}
        if is_new:
            self._tell(f"a worker does no runs of this study, and the others go on: {reason}")

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
        except Exception as error:  # noqa: BLE001  # the future raises it
            _set_error(sent.future, error)

    def _send(self, sent: SentRun) -> None:
        """Send a run to the scheduler, unless its retries are used up, or no worker may do it."""
        with self._lock:
            self._sent.pop(sent.key, None)
            if sent.is_given_up:
                self._settle(sent, sent.reason)
                return
            sent.key = f"{run_name(sent.planned)}-{secrets.token_hex(8)}"
            self._sent[sent.key] = sent
            sent.task, sent.n_aside = None, self._n_aside
            workers = list(self._workers) if self._aside else None
            if workers == []:  # `_look_at` sends it when there is a worker
                return
            sent.n_sent += 1
        code = SentCode.of(sent.planned.spec)
        order = RunOrder(sent.planned, self._command, self._limits, self._probe, self._topic, code)
        packed, client = order.packed(), self.connection.client()
        try:
            task = client.submit(do_order, packed, key=sent.key, pure=False, workers=workers)
        except (OSError, RuntimeError):  # the client has just lost its scheduler
            self.connection.lose(client)
            self._receivers.submit(self._guarded, sent, self._send)
            return
        sent.task = task
        task.add_done_callback(partial(self._on_done, sent))

    def _send_elsewhere(self, sent: SentRun) -> None:
        """Send a run again that the scheduler keeps for workers that are gone or set aside."""
        task = sent.task
        if sent.future.done():
            return
        sent.lose(sent.worker in self._left)
        sent.n_sent -= task is not None
        self._send(sent)
        if task is not None:
            task.cancel()

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
            except Exception:  # noqa: BLE001  # any error of the scheduler: the result is lost
                sent.excuse(sent.worker in self._left)
            else:
                ending = self._ending_of(sent, content)
                if ending is not None:
                    self._settle(sent, *ending)
                    return
        elif task.status == "error":
            error = task.exception()
            if isinstance(error, KilledWorker):
                sent.lose(sent.worker in self._left)
            else:
                with contextlib.suppress(Exception):  # the scheduler may be lost just now
                    self._look_at(self.connection.n_threads())
                if sent.n_aside == self._n_aside:  # else a worker with other code may have failed
                    sent.refuse(one_line(error))
        else:
            sent.worker = None
            self._workers = {}
            self.connection.lose(task.client)
        self._send(sent)

    def _ending_of(self, sent: SentRun, content: object) -> tuple[str, str] | None:
        """Why a run failed, in one line and at length; both empty if it succeeded.

        ``content``, the worker's answer, is not trusted. None if the run must be sent again.
        """
        try:
            answer = unpacked(content)
            if answer.kind == FAILED:
                return answer.reason or "it does not say why", answer.details
            if answer.kind == UNFIT:
                self._set_unfit_aside(sent, answer)
                return None
            if answer.kind == STOPPED:
                sent.excuse(sent.worker in self._left)
                return None
            if answer.files is None:
                check_in_place(sent.planned)
            else:
                receive(sent.planned, self._probe.root, answer.files)
        except RefusedAnswerError as error:
            sent.refuse(one_line(error))
            return None
        except OSError as error:  # the disk is full
            return one_line(error), ""
        return "", ""

    def _set_unfit_aside(self, sent: SentRun, answer: Answer) -> None:
        """Set aside a worker that answered that it has other code."""
        try:
            told = json.loads(answer.details)
        except (ValueError, RecursionError):
            told = None
        match told:
            case {"at": str(at), "name": str(name), "versions": dict(found)}:
                wanted = versions(*SentCode.of(sent.planned.spec).more)
                self._set_aside(at, f"{name}: {differences(wanted, found) or answer.reason}")
                sent.n_sent -= 1
            case _:
                raise RefusedAnswerError("it does not say what it has")

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


def _modules_in(warm_ups: str) -> dict[str, SentModule]:
    """The user's modules that workers import to compile, by name."""
    found = [UserModule(**m) for item in json.loads(warm_ups) for m in item["modules"]]
    return {module.name: SentModule.of(module) for module in found}
