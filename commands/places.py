"""Where runs are done, as the command line says it: on this machine, or on a cluster."""

from __future__ import annotations

import _thread
import argparse
import contextlib
import importlib.util
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from commands.flag_values import JOBS, RUN_MEMORY, RUN_TIMEOUT, filled
from pipeline.errors import UserError

if TYPE_CHECKING:
    from experiments.cluster.addresses import Cluster
    from experiments.launching import Launcher, Launchers
    from experiments.plan import PlannedRun
    from experiments.run_limits import RunLimits


@dataclass(frozen=True)
class Place:
    """Where runs are done.

    Attributes:
        launchers: opens it.
        words: what it is, in words.
        get_ready: called with the runs that are planned, before it is opened: what they compile is
            compiled once.
        n_workers: how many processes may work on this machine at once.
        expected: seconds of a run by agent and environment, where something is known of them.
    """

    launchers: Launchers
    words: str
    get_ready: Callable[[Sequence[PlannedRun]], None]
    n_workers: int = 1
    expected: Mapping[tuple[str, str], float] = field(default_factory=dict)


def add_place_flags(group: argparse._ArgumentGroup) -> None:
    """The flags that say where."""
    add = group.add_argument
    add("-j", "--jobs", type=JOBS, default=0, metavar="N", help="runs at once (default: all cores)")
    add(
        "--cluster",
        type=filled,
        metavar="WHERE",
        help="do runs on a cluster: a Dask scheduler's address or file, a YAML of dask-jobqueue, "
        "or local:N",
    )
    add(
        "--insecure-cluster",
        action="store_true",
        help="also on a cluster without TLS: anybody who can connect to it can run code",
    )


def add_limit_flags(group: argparse._ArgumentGroup) -> None:
    """The flags that say what each run may take there."""
    add = group.add_argument
    add(
        "--run-timeout",
        type=RUN_TIMEOUT,
        metavar="TIME",
        help="end a run after this time, e.g. 10m",
    )
    add("--run-memory", type=RUN_MEMORY, metavar="SIZE", help="end a run that takes more, e.g. 4GB")


def place_of(
    args: argparse.Namespace,
    root: Path,
    command: str,
    limits: RunLimits,
    say: Callable[[str], object],
) -> Place:
    """The place that the flags ask for.

    Args:
        args: with those of `add_place_flags`.
        root: the folder of what is done there.
        command: the command, as runs note it.
        limits: what each run may take.
        say: told in a line what there is to know.

    Raises:
        UserError: if there is no such place, or it is open to others.
    """
    if args.cluster is not None:
        return _cluster(args, root, command, limits, say)
    if args.insecure_cluster:
        raise UserError("--insecure-cluster belongs to --cluster: give --cluster too")
    from experiments.launching import available_cores, local_launcher

    n_workers = max(args.jobs, 0) or available_cores()
    launchers = partial(local_launcher, root, command, n_workers, limits)
    return Place(launchers, f"{n_workers} at once", _start_server, n_workers)


def _start_server(planned: Sequence[PlannedRun]) -> None:
    from experiments.child_processes import start_server

    start_server(_warm_ups(planned))  # it imports the libraries while this process does


def _warm_ups(planned: Sequence[PlannedRun]) -> str:
    """What the server is to compile once for all runs: only of users' own modules."""
    if not any(run.spec.user_modules for run in planned):
        return "[]"
    from experiments.warm_ups import warm_ups

    return warm_ups(planned)


def _cluster(
    args: argparse.Namespace,
    root: Path,
    command: str,
    limits: RunLimits,
    say: Callable[[str], object],
) -> Place:
    for library in ("distributed", "cryptography", "dask_jobqueue"):
        if importlib.util.find_spec(library) is None:
            raise UserError("--cluster needs Dask: pip install 'rl-yardstick[cluster]'")
    from experiments.cluster.schedulers import checked_cluster

    cluster = checked_cluster(args.cluster, args.insecure_cluster)
    _check_jobs(cluster, args.jobs)
    compiled = ["[]"]

    def launchers() -> contextlib.AbstractContextManager[Launcher]:
        from experiments.cluster.cluster_launcher import cluster_launcher

        return cluster_launcher(
            cluster,
            root,
            command,
            limits,
            n_runs=args.jobs,
            is_told=args.insecure_cluster,
            warm_ups=compiled[0],
            tell=say,
        )

    def get_ready(planned: Sequence[PlannedRun]) -> None:
        compiled[0] = _warm_ups(planned)

    return Place(launchers, f"on the cluster {args.cluster}", get_ready)


def _check_jobs(cluster: Cluster, n_jobs: int) -> None:
    from experiments.cluster.addresses import JobQueue

    if isinstance(cluster, JobQueue):
        if n_jobs < 1:
            raise UserError(f"{cluster.file}: say how many runs to do at once: --jobs N")
    elif n_jobs > 0:
        raise UserError("--jobs is for this machine or a queue of jobs; a cluster has its workers")


@contextlib.contextmanager
def held(launchers: Launchers) -> Iterator[Launchers]:
    """Launchers that open the place once, and leave it when the ``with`` statement ends."""
    with contextlib.ExitStack() as stack:
        there: list[Launcher] = []

        @contextlib.contextmanager
        def again() -> Iterator[Launcher]:
            if not there:
                there.append(stack.enter_context(launchers()))
            yield there[0]

        yield again


def give_way() -> None:
    """Stop, since the study's folder is another driver's, or gone."""
    from experiments.child_processes import stop_all

    stop_all()
    _thread.interrupt_main(signal.SIGTERM)
