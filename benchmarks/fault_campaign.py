"""Trainings and studies that are stopped and killed at random moments, until they are done.

    python benchmarks/fault_campaign.py --kills 30       # a look, a minute or two
    python benchmarks/fault_campaign.py --kills 1000     # docs/reliability.md: half an hour

Every agent is trained once in peace. Then the same command is started again and again, and gets a
signal at a moment drawn uniformly from the time that it takes: SIGKILL, SIGTERM, SIGINT, or SIGINT
twice. When a process has come to the end, its files are held against those of the undisturbed run,
bit for bit, but for moments and durations. A study is treated likewise, the signal going to the
driver, to one of its workers, or to all its processes. Counted are results that differ, files that
are damaged, processes that are left, and files that are left. All must be none.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from _run_contents import contents

ROOT = Path(__file__).resolve().parents[1]
SIGNALS = ("SIGKILL", "SIGTERM", "SIGINT", "SIGINT twice")
TARGETS = ("driver", "worker", "all")
MOST_STARTS = 200  # of one command: it should have come to its end by then
SMALL = "n_steps:64 batch_size:32 n_envs:2 n_epochs:2"
EAGER = "learning_starts:50 buffer_size:2000 batch_size:16 n_envs:1"
TRAININGS = (
    ("Warehouse-v0", "qlearning", 6_000_000, "engine:compiled"),
    ("FrozenLake-v1", "sarsa", 40_000, "engine:interpreted"),
    ("FrozenLake-v1", "expected_sarsa", 8_000_000, "engine:compiled n_envs:3"),
    ("CartPole-v1", "double_qlearning", 40_000, "engine:interpreted"),
    ("Warehouse-v0", "value_iteration", 40_000, ""),
    ("Warehouse-v0", "optimal", 40_000, ""),
    ("CartPole-v1", "random", 40_000, ""),
    ("CartPole-v1", "angle", 40_000, ""),
    ("CartPole-v1", "dqn", 2500, EAGER),
    ("Warehouse-v0", "double_dqn", 2000, EAGER),
    ("Warehouse-v0", "deep_qlearning", 2000, ""),
    ("CartPole-v1", "ppo", 5000, SMALL),
    ("Pendulum-v1", "ppo", 4000, f"{SMALL} use_sde:True normalize:True frame_stack:2"),
    ("CartPole-v1", "a2c", 5000, ""),
    ("Pendulum-v1", "sac", 600, EAGER),
    ("Pendulum-v1", "td3", 600, f"{EAGER} noise_type:normal noise_std:0.1"),
    ("Pendulum-v1", "ddpg", 600, EAGER),
    ("CartPole-v1", "qrdqn", 2500, EAGER),
    ("Pendulum-v1", "tqc", 400, EAGER),
    ("Pendulum-v1", "crossq", 400, EAGER),
    ("CartPole-v1", "trpo", 4000, "n_steps:128 batch_size:32 n_envs:1"),
    ("Pendulum-v1", "ars", 20_000, "n_delta:4 n_top:2"),
    ("CartPole-v1", "ppo_lstm", 2000, SMALL),
    ("Warehouse-v0", "ppo_mask", 3000, SMALL),
    ("BernoulliBandit-v0", "thompson", 20_000, ""),
    ("LinearBandit-v0", "linucb", 10_000, ""),
    ("BernoulliBandit-v0", "mabwiser_ucb1", 3000, ""),
)
STUDY = "--env CartPole-v1 FrozenLake-v1 --algos dqn qlearning --seeds 3 -n 1500 -j 2 --no-report"


@dataclass
class Case:
    """One command, in peace and disturbed.

    Attributes:
        name: what is shown.
        command: its words.
        folder: below it the command writes into ``logs``.
        whole: the files of the undisturbed one.
        seconds: what that took.
        counts: what became of the disturbed ones.
    """

    name: str
    command: list[str]
    folder: Path
    whole: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)

    @property
    def is_study(self) -> bool:
        """Whether it has workers."""
        return "compare.py" in self.command[1]

    def start(self, logs: Path) -> subprocess.Popen[str]:
        """Start the command in a session of its own, so that what it leaves can be found."""
        with (self.folder / "output").open("a") as output:
            return subprocess.Popen(
                [*self.command, "-f", str(logs)],
                cwd=self.folder,
                env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
                stdout=output,
                stderr=output,
                text=True,
                start_new_session=True,
            )


def cases(folder: Path) -> list[Case]:
    """All trainings, and the study."""
    found = []
    for number, (env_id, algo, steps, settings) in enumerate(TRAININGS):
        words = f"--env {env_id} --algo {algo} -n {steps} --seed 1 --resume-or-start".split()
        words += ["--verbose", "0", *(["-params", *settings.split()] if settings else [])]
        place = folder / str(number)
        name = f"{algo} on {env_id}"
        found.append(Case(name, [sys.executable, str(ROOT / "train.py"), *words], place))
    study = [sys.executable, str(ROOT / "compare.py"), *STUDY.split(), "--name", "study"]
    found.append(Case("a study of 12 runs", study, folder / "study"))
    for case in found:
        case.folder.mkdir(parents=True)
    return found


def in_peace(case: Case) -> None:
    """Run the command undisturbed; the second time counts, when all is compiled."""
    for logs in (case.folder / "warm", case.folder / "whole"):
        begun = time.monotonic()
        code = case.start(logs).wait()
        case.seconds = time.monotonic() - begun
        if code:
            raise SystemExit(f"{case.name} ends with {code}: see {case.folder / 'output'}")
    case.whole = contents(case.folder / "whole")


def disturbed(case: Case, seed: int) -> int:
    """Run the command until it is done, with a signal each time; the number of signals."""
    draw = random.Random(f"{case.name} {seed}")  # noqa: S311  # to be repeated, not kept secret
    logs = case.folder / f"disturbed {seed}"
    signals = 0
    for _ in range(MOST_STARTS):
        process = case.start(logs)
        try:
            process.wait(draw.uniform(0.0, case.seconds))
        except subprocess.TimeoutExpired:
            signals += 1
            _disturb(case, process, draw)
        code = process.wait()
        case.counts["orphans"] += _orphans(process.pid)
        case.counts["tracebacks"] += _has_traceback(case)
        if code == 0:
            break
    else:
        case.counts["never done"] += 1
    _judge(case, logs)
    return signals


def _disturb(case: Case, process: subprocess.Popen[str], draw: random.Random) -> None:
    how = draw.choice(SIGNALS)
    target = draw.choice(TARGETS) if case.is_study else "driver"
    pids = [process.pid] if target == "driver" else _group(process.pid)
    if target == "worker":
        pids, how = draw.sample([pid for pid in pids if pid != process.pid] or pids, 1), "SIGKILL"
    case.counts[how] += 1
    for pid in pids:
        _send(pid, getattr(signal, how.partition(" ")[0]))
    if how == "SIGINT twice":
        time.sleep(draw.uniform(0.0, 1.0))
        _send(process.pid, signal.SIGINT)


def _send(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def _group(session: int) -> list[int]:
    """The processes of a session that are there, zombies not counted."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] not in "ZX":
            found.append(int(stat.parent.name))
    return found


def _orphans(session: int) -> int:
    """How many processes are left some seconds after the one that was started."""
    until = time.monotonic() + 5.0
    while (left := _group(session)) and time.monotonic() < until:
        time.sleep(0.05)
    for pid in left:
        _send(pid, signal.SIGKILL)
    return len(left)


def _has_traceback(case: Case) -> int:
    output = case.folder / "output"
    text = output.read_text(encoding="utf-8", errors="replace")
    output.write_text("")
    found = "Traceback" in text
    if found:
        print(f"{case.name}:\n{text}", file=sys.stderr)
    return int(found)


def _judge(case: Case, logs: Path) -> None:
    """Hold what the disturbed command has left against the undisturbed one."""
    case.counts["done"] += 1
    try:
        found = contents(logs)
    except Exception as error:  # noqa: BLE001  # of whatever kind: a damaged file
        case.counts["damaged files"] += 1
        print(f"{case.name}: {logs}: {error!r}", file=sys.stderr)
        return
    left, missing = found.keys() - case.whole.keys(), case.whole.keys() - found.keys()
    differing = [n for n in found.keys() & case.whole.keys() if found[n] != case.whole[n]]
    case.counts["files left"] += len(left)
    case.counts["differing results"] += bool(differing or missing)
    if left or missing or differing:
        print(f"{case.name}: {logs}: {left=} {missing=} {differing=}", file=sys.stderr)


ENDS = ("done", "differing results", "damaged files", "orphans", "files left", "tracebacks")


def table(found: list[Case]) -> Table:
    """The counts."""
    shown = Table("command", "s", "signals", *SIGNALS, *ENDS, "never done")
    totals: Counter[str] = Counter()
    for case in found:
        totals += case.counts
    for name, seconds, counts in [
        *((case.name, f"{case.seconds:.1f}", case.counts) for case in found),
        ("all", "", totals),
    ]:
        signals = sum(counts[how] for how in SIGNALS)
        cells = [counts[key] for key in (*SIGNALS, *ENDS, "never done")]
        shown.add_row(name, seconds, f"{signals:,}", *(f"{n:,}" for n in cells))
    return shown


def main() -> int:
    """Do the campaign; 1 where something is not none."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=30, help="signals in all, at least")
    parser.add_argument("--jobs", type=int, default=max((os.cpu_count() or 2) // 2, 1))
    parser.add_argument("--only", nargs="+", default=[], help="names of the commands to try")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fault-campaign-") as folder:
        os.environ["XDG_CONFIG_HOME"] = str(Path(folder) / "config")
        chosen = [case for case in cases(Path(folder)) if case.name in args.only or not args.only]
        signals, seed = 0, 0
        with ThreadPoolExecutor(args.jobs) as pool:
            list(pool.map(in_peace, chosen))
            while signals < args.kills:
                signals += sum(pool.map(disturbed, chosen, [seed] * len(chosen)))
                seed += 1
                print(f"{signals:,} signals", flush=True)
                Console(width=180).print(table(chosen))
    bad = ("differing results", "damaged files", "orphans", "files left", "tracebacks")
    return int(any(case.counts[key] for case in chosen for key in (*bad, "never done")))


if __name__ == "__main__":
    sys.exit(main())
