"""Times contenders side by side, and publishes the results for the pages.

    python benchmarks/timing.py tabular                  # one table, with its own number of rounds
    python benchmarks/timing.py tabular networks --rounds 1 --only FrozenLake
    python benchmarks/timing.py processes --publish      # docs/measured/processes.json

In each round every contender of a row has its turn, so that changes of the machine's speed affect
all of them alike. The tables show medians over the rounds, and speeds relative to the first
contender of the row. Unless stated otherwise, times are processor times with one thread, to reduce
the influence of other programs.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from rich.console import Console
from rich.table import Table

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # before libraries are imported
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent.parent
MEASURED = ROOT / "docs" / "measured"
TABLES = ("tabular", "networks", "bandits", "evaluation", "planning", "processes")

# One measurement, in the table's unit.
Contender = Callable[[], float]
# By work, the contenders by name; the others are compared with the first.
Rows = dict[str, dict[str, Contender]]


@dataclass(frozen=True)
class Benchmark:
    """A table that can be measured."""

    unit: str
    rounds: int
    rows: Callable[[Path], Rows]  # takes a folder for files that the work writes
    is_speed: bool = True  # more is better
    warms_up: bool = False  # does one round first that does not count


def speed(work: Callable[[], object], n: int) -> Contender:
    """A contender that does ``n`` steps or pulls, measured per second of processor time."""
    once = seconds(work)
    return lambda: n / once()


def seconds(work: Callable[[], object], repeats: int = 1) -> Contender:
    """A contender measured in seconds of processor time, as a mean over ``repeats``."""

    def measure() -> float:
        started = time.process_time()
        for _ in range(repeats):
            work()
        return (time.process_time() - started) / repeats

    return measure


def measured(benchmark: Benchmark, rounds: int, only: str) -> dict[str, dict[str, float]]:
    """Medians by work and contender, of the rows that match ``only``."""
    with tempfile.TemporaryDirectory() as folder:
        rows = {w: of for w, of in benchmark.rows(Path(folder)).items() if re.search(only, w)}
        found: dict[tuple[str, str], list[float]] = {}
        for k in range(rounds + benchmark.warms_up):
            for work, contenders in rows.items():
                for name, contender in contenders.items():
                    value = contender()
                    if k >= benchmark.warms_up:
                        found.setdefault((work, name), []).append(value)
    return {
        work: {name: statistics.median(found[work, name]) for name in contenders}
        for work, contenders in rows.items()
    }


def shown(title: str, benchmark: Benchmark, medians: dict[str, dict[str, float]]) -> Table:
    """The table for a terminal."""
    table = Table(title, "contender", benchmark.unit, "times as fast as the first")
    for work, row in medians.items():
        anchor = next(iter(row.values()))
        for k, (name, value) in enumerate(row.items()):
            ratio = value / anchor if benchmark.is_speed else anchor / value
            cells = (
                f"{value:,.0f}" if value >= 1000 else f"{value:.3g}",
                f"{ratio:.3g}" if k else "",
            )
            table.add_row("" if k else work, name, *cells)
    return table


def publish(
    name: str, benchmark: Benchmark, rounds: int, rows: dict[str, dict[str, float]]
) -> None:
    """Write the medians, with commit, day and machine, for docs/benchmarks.md."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    MEASURED.mkdir(exist_ok=True)
    content = {
        "commit": commit.stdout.strip(),
        "day": time.strftime("%Y-%m-%d"),
        "python": sys.version.split()[0],
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[2], 1),
        "rounds": rounds,
        "unit": benchmark.unit,
        "is_speed": benchmark.is_speed,
        "rows": {
            work: {k: float(f"{v:.4g}") for k, v in row.items()} for work, row in rows.items()
        },
    }
    (MEASURED / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Measure and print the named tables, and publish them with ``--publish``."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "tables", nargs="+", choices=TABLES, metavar="TABLE", help=", ".join(TABLES)
    )
    parser.add_argument("--rounds", type=int, help="of each table, instead of its own number")
    parser.add_argument("--only", default="", metavar="REGEX", help="rows that match")
    parser.add_argument("--publish", action="store_true", help="write docs/measured/TABLE.json")
    args = parser.parse_args()
    if args.publish and args.only:
        parser.error("--publish writes whole tables: leave out --only")
    for name in args.tables:
        benchmark: Benchmark = import_module(f"timed_{name}").BENCHMARK
        rounds = args.rounds or benchmark.rounds
        rows = measured(benchmark, rounds, args.only)
        Console(width=160).print(shown(name, benchmark, rows))
        if args.publish:
            publish(name, benchmark, rounds, rows)


if __name__ == "__main__":
    main()
