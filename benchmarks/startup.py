"""How long the commands take before they do anything, and where a short training spends its time.

    python benchmarks/startup.py                # five rounds, two minutes
    python benchmarks/startup.py --repeats 1

Whole processes one after the other, in rounds, each command once in a round; reported are medians
of the wall clock, and of the processors' time, which says more on a busy machine: of all processes,
also of the one that a study's runs are forked from, which nobody waits for. The first round, in
which compiled code is cached, does not count. A short training is compared with importing
Stable-Baselines3 alone, which no program can do without that trains with it.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
TRAINING = ("--algo", "qlearning", "--env", "Warehouse-v0", "--n-episodes", "1000")
TABLE = ("--algo", "qlearning", "--env", "FrozenLake-v1")
NETWORKS = ("--algo", "ppo", "--env", "CartPole-v1", "-params", "engine:compiled", "-n", "4096")
STUDY = ("--algos", "qlearning", "sarsa", "--env", "FrozenLake-v1", "--seeds", "2", "-n", "1000")
PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
IMPORT = "import stable_baselines3"
INSTALLED = "from commands import main; main()"
COMMANDS: dict[str, tuple[str, ...]] = {
    "train.py --help": ("train.py", "--help"),
    "yardstick train --help": ("-c", INSTALLED, "train", "--help"),
    "train.py --list": ("train.py", "--list"),
    "train.py --env Warehose-v0": ("train.py", "--env", "Warehose-v0"),
    f"train.py {' '.join(TABLE)}": ("train.py", *TABLE),
    f"train.py {' '.join(NETWORKS)}": ("train.py", *NETWORKS),
    f"compare.py {' '.join(STUDY)}": ("compare.py", *STUDY),
    IMPORT: ("-c", IMPORT),
    f"train.py {' '.join(TRAINING)}": ("train.py", *TRAINING),
}
# Of processor time for a table and a study; of the last, for what it takes beyond the import.
LIMITS = dict(
    zip(COMMANDS, ("0.3", "0.3", "0.3", "0.3", "1.9", None, "4.0", None, "1.0 beyond"), strict=True)
)

# A line of `-X importtime`: microseconds of the module alone, of all that it imports, its name.
IMPORTED = re.compile(r"import time: +(\d+) \| +\d+ \| +([\w.]+)")


def process(arguments: tuple[str, ...], folder: str) -> subprocess.CompletedProcess[str]:
    """Run Python in the project's root; runs go into ``folder``, a study into a new one there."""
    where: tuple[str, ...] = ()
    if arguments[0] == "train.py":
        where = ("--log-folder", folder)
    elif arguments[0] == "compare.py":
        where = ("--log-folder", tempfile.mkdtemp(dir=folder))
    return subprocess.run(
        [sys.executable, *arguments, *where],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def seconds(arguments: tuple[str, ...], folder: str) -> tuple[float, float]:
    """Time of a whole process, by the clock and of the processors."""
    started, before = time.perf_counter(), os.times()
    process(arguments, folder)
    taken = time.perf_counter() - started
    with contextlib.suppress(ChildProcessError):
        while True:  # what the command left behind, which ends by itself
            os.wait()
    after = os.times()
    system = after.children_system - before.children_system
    return taken, after.children_user - before.children_user + system


def import_times(folder: str) -> Counter[str]:
    """Seconds that the training spends on importing, by top-level package.

    Asking for them slows importing down, so that they tell of shares more than of seconds.
    """
    done = process(("-X", "importtime", "train.py", *TRAINING, "--log-folder", folder), folder)
    spent: Counter[str] = Counter()
    for microseconds, module in IMPORTED.findall(done.stderr):
        spent[module.partition(".")[0]] += int(microseconds)
    return spent


def main() -> None:
    """Time everything and print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5, metavar="N", help="rounds (default 5)")
    repeats = parser.parse_args().repeats
    # Orphans become this process's children, so that their time is counted.
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    with tempfile.TemporaryDirectory() as folder:
        rounds = [
            {name: seconds(arguments, folder) for name, arguments in COMMANDS.items()}
            for _ in range(repeats + 1)
        ]
        imports = import_times(folder)
    wall, processors = (
        {name: statistics.median(each[name][k] for each in rounds[1:]) for name in COMMANDS}
        for k in (0, 1)
    )
    table = Table("command", "wall, s", "processors, s", "limit, s")
    for name in COMMANDS:
        table.add_row(name, f"{wall[name]:.2f}", f"{processors[name]:.2f}", LIMITS.get(name))
    Console(width=110).print(table)
    beyond = [each[f"train.py {' '.join(TRAINING)}"] - each[IMPORT] for each in (wall, processors)]
    print(f"Beyond the import the training takes {beyond[0]:.2f} s, {beyond[1]:.2f} of processors.")
    print("Packages that the training spends most time on importing, in milliseconds:")
    print(", ".join(f"{name} {spent / 1000:.0f}" for name, spent in imports.most_common(12)))


if __name__ == "__main__":
    main()
