"""Runs of a study in processes of their own: a crash or a time-out hits one run alone."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache, partial
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import Any

import cloudpickle
from pebble import ProcessExpired, ProcessPool
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rl_yardstick.agents.registry import BY_VALUE, name_of
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.pipeline.components import import_modules
from rl_yardstick.pipeline.errors import Stopped, UserError, one_line
from rl_yardstick.pipeline.run import INTERRUPTED, LOCK, RUNNING, Run, Stop, resumable

ERROR_FILE = "error.txt"  # the traceback of a run that failed
SECONDS_BETWEEN_LINES = 10.0
GRACE = 30.0  # seconds until stopped runs must have saved their states


def do_run(planned: PlannedRun, command: str = "", stop: Stop | None = None) -> None:
    """Do one run in this process, or what is left of it. This is what any pool or cluster calls.

    ``command`` is the user's, for the run folder; ``stop`` is None to stop after a SIGTERM.

    Raises:
        UserError: with the reason, if the run fails.
        Stopped: after a SIGTERM; the state of the training is saved.
    """
    spec, path = planned.spec, planned.path
    before = signal.getsignal(signal.SIGTERM)
    # Ctrl-C reaches all processes, and is the driver's to heed.
    asked = Stop().listen(signal.SIGTERM) if stop is None else stop
    try:
        import_modules(spec.gym_packages)
        path.mkdir(parents=True, exist_ok=True)
        with Run(path, stop=asked) as run:
            if planned.is_finished:
                return
            resumes = _can_resume(planned, run)
            if not resumes:
                _clear(planned)
                run.begin(spec, {"algo": spec.algo, "env": spec.env_id, "seed": spec.seed}, command)
            if planned.is_batch:
                from rl_yardstick.experiments.bandits import do_batch

                do_batch(spec, planned.n_runs, run)
            else:
                from rl_yardstick.pipeline.training import train

                train(spec, run, resumes)
    except (UserError, Stopped) as error:  # not of subclasses, which another process cannot read
        raise (error if isinstance(error, Stopped) else UserError(str(error))) from None
    except BaseException as error:  # noqa: BLE001  # of the user's code: told in one line
        with suppress(OSError):
            (path / ERROR_FILE).write_text(traceback.format_exc(), encoding="utf-8")
        raise UserError(f"{one_line(error)}; see {path / ERROR_FILE}") from None
    finally:
        if stop is None:
            signal.signal(signal.SIGTERM, before)


def _can_resume(planned: PlannedRun, run: Run) -> bool:
    """Whether the folder has a state of this run, saved with the same versions."""
    with suppress(UserError):
        is_this = run.state_path.exists() and not planned.differences(planned.recorded())
        return is_this and resumable(run.path) is not None
    return False


def _clear(planned: PlannedRun) -> None:
    """Remove what an earlier attempt has left."""
    for path in planned.path.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != LOCK:
            path.unlink()
    if planned.spec.tensorboard_log is not None:
        shutil.rmtree(planned.spec.tensorboard_log, ignore_errors=True)


# --- workers on this machine ----------------------------------------------------------------------


class Workers(AbstractContextManager["Workers"]):
    """Processes of this machine that do runs, one after another, until the ``with`` ends.

    Attributes:
        n_at_once: their number.
        timeout: seconds for each run; None for any time.
        words: the workers in a few words.
    """

    def __init__(self, n_at_once: int, timeout: float | None = None) -> None:
        if n_at_once < 1:  # as many as there are cores that this process may use
            cores = getattr(os, "sched_getaffinity", None)
            n_at_once = len(cores(0)) if cores else os.cpu_count() or 1
        self.n_at_once, self.timeout = n_at_once, timeout
        self.words = f"{n_at_once} at once"
        self._pool: ProcessPool | None = None

    def __exit__(self, *error: object) -> None:
        self.end()

    def submit(self, planned: PlannedRun, command: str) -> Future[None]:
        """Do a run as soon as a worker is free; the future raises what `do_run` raises."""
        if self._pool is None:
            self._pool = process_pool(self.n_at_once)
        future: Future[None] = self._pool.submit(do_run, self.timeout, planned, command)
        return future

    def end(self, under_way: Collection[Future[None]] = ()) -> None:
        """Let runs that are under way save their states, and end the workers."""
        if self._pool is not None:
            for process in multiprocessing.active_children():
                if process.name.startswith("pebble"):
                    process.terminate()
            wait(under_way, timeout=GRACE)
            self._pool.stop()  # type: ignore[no-untyped-call]
            self._pool.join()
            self._pool = None


#: What workers call first, after they know the user's classes: it registers environments.
REGISTRATIONS: dict[str, Callable[[], object]] = {}


def registrations() -> bytes:
    """The registrations, as cloudpickle copies code that stands in no module."""
    classes = [partial(name_of, cls) for cls in BY_VALUE.values()]
    return bytes(cloudpickle.dumps([*classes, *REGISTRATIONS.values()]))


def process_pool(n_workers: int) -> ProcessPool:
    """A pool of processes that have imported the libraries, and use one thread each."""
    forks = sys.platform not in ("win32", "darwin")  # where forked libraries crash
    context: Any = multiprocessing.get_context("forkserver" if forks else "spawn")
    context.set_forkserver_preload(["rl_yardstick.experiments.preloaded"])
    for library in ("OMP", "MKL", "OPENBLAS"):  # small networks are slower with more
        os.environ[f"{library}_NUM_THREADS"] = "1"
    return ProcessPool(n_workers, initializer=_begin, initargs=(registrations(),), context=context)


def _begin(own: bytes) -> None:
    """Let a worker end with the command that started it, also after a SIGKILL; and register."""
    parent, leave = multiprocessing.parent_process(), os._exit
    assert parent is not None
    # The pool waits for ever for a process that ended with 0, as by os._exit in an environment.
    os._exit = lambda status: leave(status or 1)

    def watch() -> None:
        wait_for([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    for register in pickle.loads(own):  # noqa: S301  # of the parent process
        register()


def do_aside(function: Callable[..., Any], *args: Any) -> Any:
    """Call a function in a lasting process, so that this one need not import the libraries."""
    return _aside(registrations()).schedule(function, args=args).result()


@cache
def _aside(own: bytes) -> ProcessPool:
    return process_pool(1)


# --- doing runs -----------------------------------------------------------------------------------


def do_runs(
    runs: Sequence[PlannedRun], workers: Workers, command: str, console: Console, stop: Stop
) -> dict[Path, str]:
    """Do runs in their order, see `keep_busy`; tell the progress, and each failure in a line.

    Returns:
        The reason of each failure, by the folder of the run.
    """
    failures: dict[Path, str] = {}
    to_do = list(runs)[::-1]
    with progress(console, len(runs)) as advance:

        def ended(run: PlannedRun, reason: str) -> None:
            if reason:
                failures[run.path] = reason
                console.print(f"failed: {run.title}: {reason}", highlight=False)
            advance(len(failures))

        keep_busy(workers, lambda: to_do.pop() if to_do else None, ended, command, stop)
    return failures


def keep_busy(
    workers: Workers,
    next_run: Callable[[], PlannedRun | None],
    ended: Callable[[PlannedRun, str], None],
    command: str,
    stop: Stop,
) -> None:
    """Do runs until there is none to begin, and none under way.

    Args:
        workers: the workers.
        next_run: returns the next run; None if none can begin before another ends.
        ended: called after each run, with the reason if it has failed.
        command: the user's, for the run folders.
        stop: after a signal, running ones are stopped at their next safe moment.

    Raises:
        Stopped: after a signal.
    """
    under_way = dict[Future[None], PlannedRun]()
    try:
        while True:
            # No more than there are workers: what waits in a pool is begun even after a stop.
            while len(under_way) < workers.n_at_once and not stop.number and (run := next_run()):
                under_way[workers.submit(run, command)] = run
            done = wait(under_way, timeout=0.2, return_when=FIRST_COMPLETED).done
            stop.check()
            if not under_way:
                return
            for future in done:
                run, error = under_way.pop(future), future.exception()
                if error is not None:
                    _mark_interrupted([run])
                ended(run, "" if error is None else _in_words(error, run, workers.timeout))
    finally:
        if under_way:
            workers.end(under_way)
            _mark_interrupted(under_way.values())


def _mark_interrupted(runs: Iterable[PlannedRun]) -> None:
    """No run is left ``running`` by a worker that had to be killed."""
    for planned in runs:
        if planned.recorded().get("state") == RUNNING:
            planned.run.record(planned.spec, INTERRUPTED)


def _in_words(error: BaseException, run: PlannedRun, timeout: float | None) -> str:
    if isinstance(error, TimeoutError):
        return f"took longer than --run-timeout allows, {timeout:g} s"
    if isinstance(error, ProcessExpired):
        return f"its process died with code {error.exitcode}"
    return one_line(error)


@contextmanager
def progress(console: Console, total: int, what: str = "runs") -> Iterator[Callable[[int], None]]:
    """A bar on a terminal, and else a line now and then and at the end.

    Yields a function to call after each piece of work, with the number of those that have failed.
    """
    begun = told_at = time.monotonic()
    columns = TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    failures = TextColumn("{task.description}")
    is_live = console.is_terminal and total > 0
    with Progress(*columns, failures, console=console, transient=True, disable=not is_live) as bar:
        task, n_done = bar.add_task("", total=total), 0

        def advance(n_failed: int) -> None:
            nonlocal n_done, told_at
            n_done += 1
            words = f", {n_failed} failed" if n_failed else ""
            bar.update(task, advance=1, description=words.removeprefix(", "))
            now = time.monotonic()
            if not is_live and (n_done == total or now - told_at > SECONDS_BETWEEN_LINES):
                told_at, done = now, f"{n_done} of {total} {what}"
                console.print(f"{done} in {now - begun:.0f} s{words}", highlight=False)

        yield advance
