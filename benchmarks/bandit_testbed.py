"""Times the ten-armed testbed: 2000 runs x 1000 pulls of the six classic agents.

    python benchmarks/bandit_testbed.py                 # three rounds each: about a minute
    python benchmarks/bandit_testbed.py --rounds 5

Each round is ``compare.py`` as a whole process, from its start to its files on disk, in a fresh
folder: once with tables alone, and once with figures and the page as well. What is compiled has
been compiled before.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from experiments.launching import available_cores

ROOT = Path(__file__).resolve().parent.parent
N_RUNS = 2000
N_PULLS = 1000
TARGET_SECONDS = 10.0

AGENTS: dict[str, dict[str, Any]] = {
    "greedy": {"algo": "epsilon_greedy", "exploration_initial_eps": 0.0},
    "epsilon 0.01": {"algo": "epsilon_greedy", "exploration_initial_eps": 0.01},
    "epsilon 0.1": {"algo": "epsilon_greedy", "exploration_initial_eps": 0.1},
    "optimistic": {
        "algo": "epsilon_greedy",
        "exploration_initial_eps": 0.0,
        "initial_q": 5.0,
        "learning_rate": 0.1,
    },
    "UCB c=2": {"algo": "ucb", "variant": "sutton_barto", "c": 2.0},
    "gradient 0.1": {"algo": "gradient_bandit", "learning_rate": 0.1},
}


def testbed(n_runs: int) -> dict[str, Any]:
    """The study, in the form of a study file."""
    return {
        "title": "The ten-armed testbed",
        "environments": {"testbed": {"id": "GaussianBandit-v0"}},
        "agents": AGENTS,
        "tuned": False,
        "n_timesteps": N_PULLS,
        "seeds": n_runs,
        "metric": "regret",
    }


def time_round(study: Path, folder: Path, *, report: bool) -> float:
    """Wall time of one round, in seconds."""
    command = [sys.executable, str(ROOT / "compare.py"), str(study), "-f", str(folder)]
    if not report:
        command.append("--no-report")
    started = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, cwd=ROOT)
    seconds = time.perf_counter() - started
    n_done = len(list(folder.glob("*/runs/*/*/pull_statistics.npz")))
    if n_done != len(AGENTS):
        raise SystemExit(f"only {n_done} of {len(AGENTS)} batches finished")
    return seconds


def main() -> None:
    """Time some rounds of either kind and say what they took."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3, metavar="N")
    parser.add_argument("--runs", type=int, default=N_RUNS, metavar="N", help="of each agent")
    args = parser.parse_args()
    pulls = len(AGENTS) * args.runs * N_PULLS
    print(f"{len(AGENTS)} agents x {args.runs} runs x {N_PULLS} pulls, {available_cores()} cores")
    with tempfile.TemporaryDirectory() as folder:
        study = Path(folder, "testbed.yml")
        study.write_text(json.dumps(testbed(args.runs)), encoding="utf-8")
        time_round(study, Path(folder, "warm-up"), report=True)
        for report in (False, True):
            times = [
                time_round(study, Path(folder, f"{report}-{number}"), report=report)
                for number in range(args.rounds)
            ]
            median = statistics.median(times)
            each = ", ".join(f"{seconds:.1f}" for seconds in times)
            print(
                f"{'with figures and page' if report else 'tables alone':22} {median:5.1f} s "
                f"(rounds {each}; target {TARGET_SECONDS:.0f} s), "
                f"{pulls / median / 1e6:.1f} million pulls/s"
            )


if __name__ == "__main__":
    main()
