"""PPO on CartPole as a whole process: `train.py` beside `python -m rl_zoo3.train`.

    python benchmarks/against_rl_zoo3.py                # three rounds, eight minutes
    python benchmarks/against_rl_zoo3.py --repeats 1
    python benchmarks/against_rl_zoo3.py --only "equal evaluation, one thread"

Both take rl_zoo3's own hyperparameters for CartPole-v1 and 20,000 steps, in five comparisons:

- default against default: no flag that is not needed;
- equal evaluation: five episodes every 5,000 steps in both, and ours at the end too;
- each of the two with one thread of PyTorch in both, instead of each one's default;
- default against default, two at a time, as one trains several seeds; the time until both are done.

Wall-clock time and the processors' time, medians over the rounds. On a busy machine only those with
one thread tell anything: elsewhere, threads of one process wait for each other. rl_zoo3 has an
environment of its own, which is made first where it is not there.
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
SETTINGS = ("--algo", "ppo", "--env", "CartPole-v1", "-n", "20000")
EQUAL = ("--eval-freq", "5000", "--eval-episodes", "5", "--n-eval-envs", "1")
ONE_THREAD = ("--num-threads", "1")
# What is compared: further settings of both, and how many trainings run at once.
COMPARISONS: dict[str, tuple[tuple[str, ...], int]] = {
    "defaults": ((), 1),
    "equal evaluation": (EQUAL, 1),
    "defaults, one thread": (ONE_THREAD, 1),
    "equal evaluation, one thread": ((*EQUAL, *ONE_THREAD), 1),
    "defaults, two at once": ((), 2),
}
CONTENDERS = ("train.py", "rl_zoo3")
# Set by whoever runs this; each contender is to choose for itself.
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def command(contender: str, further: tuple[str, ...], seed: int, folder: str) -> list[str]:
    """One training, with its files in ``folder``."""
    hyperparams = peer_folder("rl_zoo3") / "hyperparams" / "ppo.yml"
    ours, theirs = [sys.executable, "train.py"], [peer_python(), "-m", "rl_zoo3.train"]
    where = ["--conf-file", str(hyperparams), "--seed", str(seed), "-f", folder]
    return [*(ours if contender == "train.py" else theirs), *SETTINGS, *further, *where]


def times(contender: str, comparison: str, folder: str) -> tuple[float, float]:
    """Seconds of the clock and of the processors that a comparison's trainings take together."""
    further, at_once = COMPARISONS[comparison]
    environ = {name: value for name, value in os.environ.items() if name not in THREADS}
    commands = [command(contender, further, seed, folder) for seed in range(at_once)]
    used_before, started = _seconds_of_children(), time.perf_counter()
    null = subprocess.DEVNULL
    processes = [
        subprocess.Popen(words, cwd=ROOT, env=environ, stdout=null, stderr=null)
        for words in commands
    ]
    exit_codes = [process.wait() for process in processes]
    if any(exit_codes):
        raise SystemExit(f"{contender} failed: {' '.join(commands[0])}")
    return time.perf_counter() - started, _seconds_of_children() - used_before


def _seconds_of_children() -> float:
    used = os.times()
    return used.children_user + used.children_system


def main() -> None:
    """Time both and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="rounds (default 3)")
    parser.add_argument("--only", nargs="+", default=list(COMPARISONS), choices=list(COMPARISONS))
    args = parser.parse_args()
    peer_python()  # so that making its environment counts for nobody
    table = Table("comparison", "program", "wall, s", "processors, s", "rl_zoo3 takes")
    with tempfile.TemporaryDirectory() as folder:
        for comparison in args.only:
            rounds = [
                {contender: times(contender, comparison, folder) for contender in CONTENDERS}
                for _ in range(args.repeats)
            ]
            wall, processors = (
                {name: statistics.median(each[name][k] for each in rounds) for name in CONTENDERS}
                for k in (0, 1)
            )
            for name in CONTENDERS:
                ratios = [figures["rl_zoo3"] / figures[name] for figures in (wall, processors)]
                ratio = "" if name == "rl_zoo3" else f"{ratios[0]:.2f} x, {ratios[1]:.2f} x"
                table.add_row(
                    comparison, name, f"{wall[name]:.1f}", f"{processors[name]:.1f}", ratio
                )
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
