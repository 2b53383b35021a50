"""What a cluster takes for each run, and how many workers one scheduler could keep at work.

    python benchmarks/cluster.py --runs 100 1000      # docs/benchmarks.md
    python benchmarks/cluster.py                      # 10,000 too: an hour and more

Runs are tiny, a few steps of Q-learning, so that what is left is what every run takes: imports are
over, since the first runs of each worker are not counted. The same runs are done embedded, with as
many processes. Everything shares one machine; so beside the time by the clock stands the processor
time of each part, which another machine would have for itself. The projection is what one core can
do: as many runs a second as the busiest part's processor time allows, and so many workers at work
with runs of a given length.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest import mock

from rich.console import Console
from rich.table import Table

from experiments.cluster import cluster_launcher as launching_there
from experiments.cluster.cluster_launcher import cluster_launcher
from experiments.cluster.schedulers import SchedulerAddress
from experiments.cluster.working import Probe, probing
from experiments.launching import Launchers, execute, local_launcher
from experiments.plan import PlannedRun, plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec

N_WORKERS = 2
N_UNCOUNTED = 5 * N_WORKERS
TICKS = os.sysconf("SC_CLK_TCK")
LENGTHS = (10, 60, 600)  # seconds


@dataclass
class Cost:
    """What runs took.

    Attributes:
        n_runs: how many were counted.
        wall: seconds by the clock.
        parts: processor seconds by part.
        memory: of the driver at its most, in bytes.
    """

    n_runs: int
    wall: float
    parts: dict[str, float]
    memory: int


def tiny_runs(root: Path, n_runs: int) -> list[PlannedRun]:
    """As many runs of a few steps."""
    lake = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 10})
    agent = AgentSpec("q", "qlearning", tuned=False)
    study = StudySpec("s", "S", (agent,), (lake,), n_seeds=n_runs, eval_freq=-1)
    return plan(study, root)


def processor_seconds(pid: int) -> float:
    """What a process has taken of processors."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def most_memory() -> int:
    """The most that this process has taken of memory."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    (line,) = [line for line in status.splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) * 1024


def cost(
    runs: Sequence[PlannedRun], root: Path, launchers: Launchers, pids: dict[str, int]
) -> Cost:
    """Do runs, and see what all but the first took."""
    before: dict[str, float] = {}
    begun, n_ended = 0.0, 0

    def listen(planned: PlannedRun, failure: object) -> None:
        nonlocal begun, n_ended
        if failure is not None:
            raise SystemExit(f"{planned.path}: {failure}")
        n_ended += 1
        if n_ended == N_UNCOUNTED:
            begun = time.perf_counter()
            before.update({name: processor_seconds(pid) for name, pid in pids.items()})

    execute(runs, root, launchers, listen)
    wall = time.perf_counter() - begun
    parts = {name: processor_seconds(pid) - before[name] for name, pid in pids.items()}
    return Cost(len(runs) - N_UNCOUNTED, wall, parts, most_memory())


@contextlib.contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, dict[str, int]]]:
    """A scheduler and workers in processes of their own; its file, and numbers of processes."""
    file = folder / "scheduler.json"
    with contextlib.ExitStack() as stack:

        def started(words: str) -> int:
            common = ["--scheduler-file", str(file), "--dashboard-address", "127.0.0.1:0"]
            command = [sys.executable, "-m", *words.split(), *common]
            quiet = subprocess.DEVNULL
            process = subprocess.Popen(command, stdout=quiet, stderr=quiet, cwd=folder)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process.pid

        pid = started("distributed.cli.dask_scheduler --host 127.0.0.1 --port 0")
        while not file.exists():
            time.sleep(0.1)
        started(f"distributed.cli.dask_worker --nworkers {N_WORKERS} --nthreads 1")
        yield str(file), {"scheduler": pid, "driver": os.getpid()}


@contextlib.contextmanager
def nowhere(root: Path) -> Iterator[Probe]:
    """A probe that no worker finds."""
    yield Probe(Path("/nowhere"), root, ".probe", "x")


def measured(n_runs: int, folder: Path, file: str, pids: dict[str, int]) -> dict[str, Cost]:
    """That many runs, embedded, on workers that share the folder, and on others."""
    there = SchedulerAddress("", Path(file))
    costs = {}
    for name in ("embedded", "shared folder", "files sent back"):
        root = folder / name.replace(" ", "-") / str(n_runs)
        root.mkdir(parents=True)
        launchers: Launchers = partial(cluster_launcher, there, root, "c")
        if name == "embedded":
            launchers = partial(local_launcher, root, "c", N_WORKERS)
        with mock.patch.object(launching_there, "probing", nowhere if "sent" in name else probing):
            mine = pids if name != "embedded" else {"driver": pids["driver"]}
            costs[name] = cost(tiny_runs(root, n_runs + N_UNCOUNTED), root, launchers, mine)
    return costs


def show(costs: dict[str, Cost]) -> None:
    """Print what runs took, beside those that were embedded, and what one core can do."""
    table = Table("runs", "where", "ms a run", "driver ms", "scheduler ms", "driver MB")
    for name, each in costs.items():
        parts = [each.parts.get(part, 0.0) / each.n_runs * 1e3 for part in ("driver", "scheduler")]
        cells = [f"{value:.1f}" for value in (each.wall / each.n_runs * 1e3, *parts)]
        table.add_row(f"{each.n_runs:,}", name, *cells, f"{each.memory / 1e6:.0f}")
    Console(width=100).print(table)
    here, there = costs["embedded"], costs["shared folder"]
    over = N_WORKERS * (there.wall / there.n_runs - here.wall / here.n_runs) * 1e3
    print(f"overhead a run, of its worker: {over:.1f} ms")
    for name in ("shared folder", "files sent back"):
        part, seconds = max(costs[name].parts.items(), key=lambda item: item[1])
        rate = costs[name].n_runs / seconds
        words = ", ".join(f"{rate * length:,.0f} of {length} s" for length in LENGTHS)
        print(f"{name}: the {part} is full at {rate:.0f} runs a second: workers with runs {words}")


def main() -> None:
    """Measure, for each number of runs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, nargs="+", default=[100, 1000, 10_000])
    args = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory(prefix="cluster-benchmark-") as name:
        folder = Path(name)
        with cluster(folder) as (file, pids):
            for n_runs in args.runs:
                show(measured(n_runs, folder, file, pids))


if __name__ == "__main__":
    main()
