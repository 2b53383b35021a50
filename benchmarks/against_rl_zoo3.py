"""PPO on CartPole as a whole process: `train.py` beside `python -m rl_zoo3.train`.

    python benchmarks/against_rl_zoo3.py                # five rounds, two to five minutes
    python benchmarks/against_rl_zoo3.py --repeats 1

Both take rl_zoo3's own hyperparameters for CartPole-v1, 20,000 steps and the same interval between
evaluations; all else is as each has it by default, the number of torch threads above all. Once
alone, and once two at a time, as one trains several seeds; then the time is that until both are
done. Wall-clock time and the processors' time, medians over the rounds. rl_zoo3 has an environment
of its own, which is made first where it is not there.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.peers.peer_environment import peer_folder, peer_python

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = ("--algo", "ppo", "--env", "CartPole-v1", "-n", "20000", "--eval-freq", "25000")
CONTENDERS = ("train.py", "rl_zoo3")
# Set by whoever runs this; each contender is to choose for itself.
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def command(contender: str, seed: int, folder: str) -> list[str]:
    """One training, with its files in ``folder``."""
    hyperparams = peer_folder("rl_zoo3") / "hyperparams" / "ppo.yml"
    ours, theirs = [sys.executable, "train.py"], [peer_python(), "-m", "rl_zoo3.train"]
    settings = [*SETTINGS, "--conf-file", str(hyperparams), "--seed", str(seed), "-f", folder]
    return [*(ours if contender == "train.py" else theirs), *settings]


def times(contender: str, at_once: int, folder: str) -> tuple[float, float]:
    """Seconds of the clock and of the processors that some trainings at once take together."""
    environ = {name: value for name, value in os.environ.items() if name not in THREADS}
    used_before, started = _seconds_of_children(), time.perf_counter()
    processes = [
        subprocess.Popen(
            command(contender, seed, folder),
            cwd=ROOT,
            env=environ,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for seed in range(at_once)
    ]
    exit_codes = [process.wait() for process in processes]
    if any(exit_codes):
        raise SystemExit(f"{contender} failed: {' '.join(command(contender, 0, folder))}")
    return time.perf_counter() - started, _seconds_of_children() - used_before


def _seconds_of_children() -> float:
    used = os.times()
    return used.children_user + used.children_system


def main() -> None:
    """Time both and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5, metavar="N", help="rounds (default 5)")
    repeats = parser.parse_args().repeats
    peer_python()  # so that making its environment counts for nobody
    table = Table("trainings at once", "program", "wall, s", "processors, s", "rl_zoo3 takes")
    with tempfile.TemporaryDirectory() as folder:
        for at_once in (1, 2):
            rounds = [
                {contender: times(contender, at_once, folder) for contender in CONTENDERS}
                for _ in range(repeats)
            ]
            wall, processors = (
                {name: statistics.median(each[name][k] for each in rounds) for name in CONTENDERS}
                for k in (0, 1)
            )
            for name in CONTENDERS:
                ratio = f"{wall['rl_zoo3'] / wall[name]:.1f} x" if name != "rl_zoo3" else ""
                table.add_row(
                    str(at_once), name, f"{wall[name]:.1f}", f"{processors[name]:.1f}", ratio
                )
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
