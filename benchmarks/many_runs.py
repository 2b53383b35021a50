"""Measures studies of 1,000, 10,000 and 100,000 runs with ``--keep figures``.

Runs are tiny: 20 episodes of Q-learning and SARSA on FrozenLake. Up to ``--really`` runs are done.
A larger study is made of the rows of that study, repeated for other seeds: so its file, memory and
page are measured, and not its training. The few runs whose agents are kept are made again in both
cases; where rows were repeated, they come out otherwise than these, and the command says so.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from experiments.figures_store import SUFFIX, checksum_of

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "docs" / "scripts"))

from measured_tables import publish  # noqa: E402

PAGE = ROOT / "docs/measured/many-runs.json"
SIZES = (1_000, 10_000, 100_000)
AGENTS = ("qlearning", "sarsa")
STUDY = ["--env", "FrozenLake-v1", "--algos", *AGENTS, "--n-episodes", "20", "--keep", "figures"]
NAME = "many"


def drive(words: list[str]) -> None:
    """Do a command, and write what its process took: the driver's own memory and time."""
    began = time.monotonic()
    sys.argv = ["compare.py", *words]
    from commands.compare import main

    code = main()
    taken = {
        "code": code,
        "MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
        "processor": time.process_time(),
        "seconds": time.monotonic() - began,
    }
    Path(os.environ["TAKEN"]).write_text(json.dumps(taken), encoding="utf-8")


def measured(folder: Path, n_runs: int) -> dict[str, float]:
    """What the command takes that does the missing runs of a study, and writes its page."""
    taken = folder / "taken.json"
    seeds = str(n_runs // len(AGENTS))
    words = [*STUDY, "--name", NAME, "-f", str(folder), "-j", "1", "--seeds", seeds]
    command = [sys.executable, str(Path(__file__).resolve()), "--drive", *words]
    env = {**os.environ, "TAKEN": str(taken), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, cwd=ROOT, env=env, check=True, stdout=subprocess.DEVNULL)
    found: dict[str, float] = json.loads(taken.read_text(encoding="utf-8"))
    return found


def repeat_rows(path: Path, n_seeds: int) -> None:
    """Repeat the rows of a file for further seeds, up to so many."""
    database = sqlite3.connect(path)
    origins = dict(database.execute("SELECT id, content FROM origins"))
    rows = database.execute("SELECT * FROM runs ORDER BY seed").fetchall()
    places = ", ".join("?" * len(rows[0]))
    with database:
        for seed in range(len(rows), n_seeds):
            _, origin, *content, _ = rows[seed % len(rows)]
            row = [seed, origin, *content, checksum_of(seed, origins[origin], content)]
            database.execute(f"INSERT INTO runs VALUES ({places})", row)  # noqa: S608
    database.close()


def row(folder: Path, n_runs: int, n_really: int) -> list[str]:
    """Do or make a study of so many runs, and measure it."""
    study = folder / NAME
    driving = None
    if n_runs <= n_really or not study.exists():
        driving = measured(folder, min(n_runs, n_really))
    if n_runs > n_really:
        for path in study.glob(f"runs/*/*{SUFFIX}"):
            repeat_rows(path, n_runs // len(AGENTS))
    page = measured(folder, n_runs)
    files = [path.stat().st_size for path in study.glob(f"runs/*/*{SUFFIX}")]
    n_inodes = sum(1 for _ in (study / "runs").rglob("*"))
    return [
        f"{n_runs:,}",
        f"{min(n_runs, n_really):,}",
        f"{sum(files) / n_runs:.0f}",
        f"{n_inodes:,}",
        "-" if driving is None else f"{driving['MB']:.0f}",
        f"{page['MB']:.0f}",
        f"{page['processor']:.0f}",
        f"{page['seconds']:.0f}",
    ]


def extrapolated(first: list[str], second: list[str]) -> list[str]:
    """The row of a million runs, on the line through two others."""
    (n, *one), (m, *other) = (
        [float(row[k].replace(",", "")) for k in (0, 5, 6)] for row in (first, second)
    )
    memory, processor = (y + (y - x) / (m - n) * (1e6 - m) for x, y in zip(one, other, strict=True))
    return [
        "1,000,000",
        "extrapolated",
        second[2],
        "-",
        "-",
        f"{memory:.0f}",
        f"{processor:.0f}",
        "-",
    ]


def table(rows: list[list[str]]) -> str:
    """The table in Markdown."""
    headings = [
        "runs",
        "really done",
        "bytes of the files per run",
        "files and folders, all runs together",
        "MB of the driver that does them",
        "MB of the driver to the page",
        "processor seconds to the page",
        "seconds to the page",
    ]
    lines = [headings, ["---:"] * len(headings), *rows]
    if len(rows) > 1:
        lines.append(extrapolated(*rows[-2:]))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def main() -> None:
    """Measure all sizes, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--really", type=int, default=1_000, help="the most runs that are done")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="numbers of runs")
    parser.add_argument("--publish", action="store_true", help=f"write {PAGE.relative_to(ROOT)}")
    parser.add_argument("--folder", type=Path, help="an empty folder, which stays")
    args = parser.parse_args()
    folder = args.folder or Path(tempfile.mkdtemp())
    rows = []
    for n_runs in sorted(args.sizes):
        rows.append(row(folder, n_runs, args.really))
        print(" | ".join(rows[-1]), flush=True)
    if args.folder is None:
        shutil.rmtree(folder)
    text = table(rows)
    print(text)
    if args.publish:
        publish(PAGE, text)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--drive"]:
        drive(sys.argv[2:])
    else:
        main()
