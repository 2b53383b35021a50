"""A study on a cluster whose workers, nodes, scheduler and driver are killed at random moments.

    python benchmarks/cluster_faults.py --runs 40 --workers 3 --nodes 1     # a look, some minutes
    python benchmarks/cluster_faults.py                                     # docs/reliability.md

The study is done once embedded, in peace. Then a scheduler and two nodes with two workers each are
started on this machine, and the same study is done there, while processes get SIGKILL: at counts
of finished runs that are drawn beforehand. A node or scheduler is started again two seconds later,
as a cluster's own supervision would do it, a driver at once; workers are started again by their
nodes. In the end all runs must be there, and what they and the tables say must be what the embedded
study says.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from distributed import Client

from _run_contents import contents

ROOT = Path(__file__).resolve().parents[1]
SECONDS_UNTIL_RESTART = 2.0
MOST_SECONDS = 3600.0
STUDY = "--env FrozenLake-v1 --algos qlearning sarsa --name study --no-report"


class Processes:
    """A scheduler, two nodes and a driver, each in a session of its own.

    Args:
        folder: of all that they leave.
        words: the driver's.
    """

    def __init__(self, folder: Path, words: list[str]) -> None:
        self.folder = folder
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        node = f"dask_worker {self.address} --nworkers 2 --nthreads 1"
        self.commands = {
            "scheduler": self._dask(f"dask_scheduler --host 127.0.0.1 --port {port}"),
            "node 0": self._dask(f"{node} --local-directory {folder / 'a'}"),
            "node 1": self._dask(f"{node} --local-directory {folder / 'b'}"),
            "driver": [sys.executable, *words, "--cluster", self.address],
        }
        self.running: dict[str, subprocess.Popen[bytes]] = {}

    def _dask(self, words: str) -> list[str]:
        command, *rest = words.split()
        page = ["--dashboard-address", "127.0.0.1:0"]
        return [sys.executable, "-m", f"distributed.cli.{command}", *rest, *page]

    def start(self, name: str) -> None:
        """Start one of them."""
        with (self.folder / f"{name}.log").open("ab") as log:
            self.running[name] = subprocess.Popen(
                self.commands[name],
                cwd=self.folder,
                env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def kill(self, name: str) -> None:
        """Kill one of them with all that it has started, and start it again."""
        process = self.running[name]
        if name == "driver":
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGKILL)
            time.sleep(SECONDS_UNTIL_RESTART)
        process.wait()
        self.start(name)

    def kill_worker(self, draw: random.Random) -> None:
        """Kill one worker; its node starts another."""
        with Client(self.address, timeout=30, set_as_default=False) as client:
            pids = sorted(client.run(os.getpid).values())
        if pids:
            os.kill(draw.choice(pids), signal.SIGKILL)

    def end(self) -> None:
        """End all that runs."""
        for process in self.running.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def n_done(study: Path) -> int:
    """How many runs are there."""
    return sum(1 for _ in study.glob("runs/*/*/run.json"))


def disturb(processes: Processes, study: Path, faults: list[tuple[int, str]], seed: int) -> None:
    """Kill what is to be killed, each when so many runs are done; until the driver has ended."""
    draw, until = random.Random(seed), time.monotonic() + MOST_SECONDS  # noqa: S311
    faults = list(faults)
    while processes.running["driver"].poll() is None and time.monotonic() < until:
        time.sleep(0.1)
        for name in ("node 0", "node 1"):  # which mostly end when their scheduler is killed
            if processes.running[name].poll() is not None:
                processes.start(name)
        if faults and n_done(study) >= faults[0][0]:
            count, victim = faults.pop(0)
            print(f"{count:5d} runs: {victim}", flush=True)
            if victim == "worker":
                processes.kill_worker(draw)
            else:
                processes.kill(victim)
    if faults:
        print(f"came too late: {faults}")


def drawn_faults(args: argparse.Namespace) -> list[tuple[int, str]]:
    """At which counts of runs what is killed."""
    draw = random.Random(args.seed)  # noqa: S311  # to be repeated, not kept secret
    victims = ["worker"] * args.workers + [f"node {n % 2}" for n in range(args.nodes)]
    victims += ["scheduler"] * args.schedulers + ["driver"] * args.drivers
    last = int(0.9 * args.runs)
    return sorted((draw.randrange(1, max(last, 2)), victim) for victim in victims)


def report(processes: Processes, folder: Path, n_runs: int) -> bool:
    """Print what there is and what differs; whether all is as it must be."""
    whole, found = contents(folder / "embedded"), contents(folder / "cluster")
    left, missing = found.keys() - whole.keys(), whole.keys() - found.keys()
    differing = [name for name in found.keys() & whole.keys() if found[name] != whole[name]]
    said = (folder / "driver.log").read_text(encoding="utf-8", errors="replace")
    code = processes.running["driver"].wait()
    done = n_done(folder / "cluster" / "study")
    print(f"exit code {code}, {done} of {n_runs} runs, tracebacks {said.count('Traceback')}")
    print(f"files left {sorted(left)}, missing {sorted(missing)[:5]}, differing {differing[:5]}")
    is_whole = code == 0 and done == n_runs and not (left or missing or differing)
    return is_whole and "Traceback" not in said


def arguments() -> argparse.Namespace:
    """The flags."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add = parser.add_argument
    add("--runs", type=int, default=500)
    add("--steps", type=int, default=2000, help="of each run")
    add("--workers", type=int, default=20, help="kills of workers")
    add("--nodes", type=int, default=2, help="of nodes")
    add("--schedulers", type=int, default=1, help="of the scheduler")
    add("--drivers", type=int, default=1, help="of the driver")
    add("--seed", type=int, default=0)
    return parser.parse_args()


def embedded(folder: Path, study: list[str]) -> None:
    """Do the study in peace."""
    begun = time.monotonic()
    command = [sys.executable, *study, "-f", "embedded", "-j", "4"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    quiet = subprocess.DEVNULL
    subprocess.run(command, cwd=folder, check=True, stdout=quiet, env=environment)
    print(f"embedded: {time.monotonic() - begun:.0f} s", flush=True)


def main() -> int:
    """Do the campaign; 1 where something was lost."""
    args, folder = arguments(), Path(tempfile.mkdtemp(prefix="cluster-faults-"))
    n_runs = args.runs // 2 * 2
    study = [str(ROOT / "compare.py"), *STUDY.split(), "-n", str(args.steps)]
    study += ["--seeds", str(n_runs // 2)]
    embedded(folder, study)
    processes, faults = Processes(folder, [*study, "-f", "cluster"]), drawn_faults(args)
    begun = time.monotonic()
    try:
        for name in ("scheduler", "node 0", "node 1", "driver"):
            processes.start(name)
        disturb(processes, folder / "cluster" / "study", faults, args.seed)
        print(f"with {dict(Counter(v for _, v in faults))}: {time.monotonic() - begun:.0f} s")
        is_well = report(processes, folder, n_runs)
    finally:
        processes.end()
    if is_well:
        shutil.rmtree(folder)
    else:
        print(f"what is left: {folder}")
    return int(not is_well)


if __name__ == "__main__":
    sys.exit(main())
