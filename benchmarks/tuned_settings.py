"""Trains with the shipped hyperparameters over seeds 0 to n-1, and says how often that works.

    python benchmarks/tuned_settings.py                 # everything, ten seeds: more than an hour
    python benchmarks/tuned_settings.py --algos sarsa qlearning --seeds 3

Each run is `train.py` in a process of its own. Where the environment's model is known the results
are exact; on CartPole, Pendulum and MountainCarContinuous they are means of 100 episodes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABULAR = ("qlearning", "sarsa", "expected_sarsa", "double_qlearning")
FROZEN_LAKE_OPTIMUM = 0.7442


@dataclass(frozen=True)
class Goal:
    """What runs are expected to reach.

    Attributes:
        env: the environment.
        algo: the agent.
        least: the return that a run should reach.
        share: the share of the runs that should.
    """

    env: str
    algo: str
    least: float
    share: float


GOALS = [
    *(Goal("Warehouse-v0", algo, 79, 1.0) for algo in (*TABULAR, "ppo")),
    *(Goal("Warehouse-v0", algo, 79, 0.9) for algo in ("dqn", "double_dqn")),
    *(Goal("FrozenLake-v1", algo, 0.95 * FROZEN_LAKE_OPTIMUM, 0.9) for algo in TABULAR),
    *(
        Goal("FrozenLake-v1", algo, 0.95 * FROZEN_LAKE_OPTIMUM, 0.8)
        for algo in ("dqn", "double_dqn", "ppo")
    ),
    *(Goal("MineMaze-v0", algo, 91, 0.9) for algo in ("qlearning", "sarsa", "dqn", "ppo")),
    Goal("CartPole-v1", "ppo", 500, 0.9),
    Goal("CartPole-v1", "dqn", 475, 0.9),
    *(Goal("CartPole-v1", algo, 200, 0.9) for algo in ("qlearning", "sarsa")),
    Goal("CliffWalking-v1", "qlearning", -13, 1.0),
    Goal("CliffWalking-v1", "sarsa", -17, 1.0),
    Goal("Pendulum-v1", "sac", -200, 0.8),
    *(Goal("Pendulum-v1", algo, -200, 0.9) for algo in ("td3", "ppo")),
    *(Goal("MountainCarContinuous-v0", algo, 90, 0.9) for algo in ("sac", "ppo")),
]


def train(goal: Goal, seed: int, folder: Path) -> float:
    """The mean return of one run at its end; minus infinity where it failed."""
    own = folder / f"{goal.algo}-{goal.env}-{seed}"
    command = [sys.executable, str(ROOT / "train.py"), "--env", goal.env, "--algo", goal.algo]
    command += ["--seed", str(seed), "--verbose", "0", "-f", str(own)]
    # The evaluation at the end is what counts; those on the way take time and change nothing.
    command += ["--eval-freq", str(10**9)]
    result = subprocess.run(
        command,
        check=False,
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    if result.returncode != 0:
        print(f"{goal.algo} on {goal.env}, seed {seed}: {result.stderr.strip()}", file=sys.stderr)
        return float("-inf")
    (info,) = own.glob("*/*/run.json")
    return float(json.loads(info.read_text())["final"]["mean_return"])


def main() -> int:
    """Run what was asked for and print a line for each agent and environment; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="seeds 0 to N-1")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count(), metavar="N", help="runs at once"
    )
    parser.add_argument("--envs", nargs="+", metavar="ID", help="only these environments")
    parser.add_argument("--algos", nargs="+", metavar="NAME", help="only these agents")
    args = parser.parse_args()
    goals = [
        goal
        for goal in GOALS
        if (not args.envs or goal.env in args.envs) and (not args.algos or goal.algo in args.algos)
    ]
    failures = 0
    print(f"{'environment':24} {'agent':17} {'reached':>8}  returns of seeds 0 to {args.seeds - 1}")
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(args.jobs) as pool:
        for goal in goals:
            returns = list(
                pool.map(lambda seed, goal=goal: train(goal, seed, Path(folder)), range(args.seeds))
            )
            reached = sum(value >= goal.least - 1e-9 for value in returns)
            failures += reached < goal.share * args.seeds
            figures = " ".join(f"{value:.4g}" for value in returns)
            print(
                f"{goal.env:24} {goal.algo:17} {reached:>4}/{args.seeds:<3}  {figures}", flush=True
            )
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
