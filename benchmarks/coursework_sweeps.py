"""Times a coursework's three sweeps: 9 settings x 30 seeds x 1000 episodes on the warehouse.

    python benchmarks/coursework_sweeps.py                 # three rounds: half a minute
    python benchmarks/coursework_sweeps.py --rounds 5 --report
    python benchmarks/coursework_sweeps.py --thousand      # 1,000 seeds of one table instead

Each round is ``compare.py`` as a whole process, from its start to the tables on disk, in a fresh
folder. The settings are those of the three studies of learning rate, discount and epsilon, as
printed: shelf reward -1, ties on the first index. The thousand seeds are of Q-learning with our
settings on FrozenLake-v1, 200,000 steps each. Processor time is that of all processes.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from _process_trees import timed

from experiments.launching import available_cores
from experiments.study import read_study

ROOT = Path(__file__).resolve().parent.parent
STUDIES = ("warehouse-learning-rate", "warehouse-discount", "warehouse-epsilon")
N_SEEDS = 30
N_EPISODES = 1000
TARGET_SECONDS = {"sweeps": 6.0, "thousand": 20.0}


def sweeps() -> dict[str, Any]:
    """The three sweeps as one study, in the form of a study file."""
    agents = {
        f"{name} {agent.label}": {"algo": agent.algo, **agent.settings}
        for name in STUDIES
        for agent in read_study(ROOT / "studies" / f"{name}.yml").agents
        if agent.settings.get("tie_breaking") == "first"
    }
    return {
        "title": "The coursework's three sweeps",
        "seeds": N_SEEDS,
        "n_episodes": N_EPISODES,
        "tuned": False,
        "agents": agents,
        "environments": {"Warehouse-v0": {"env_kwargs": {"shelf_reward": -1}}},
    }


def thousand() -> dict[str, Any]:
    """A thousand seeds of one agent on one environment, in the form of a study file."""
    return {
        "title": "A thousand seeds",
        "seeds": 1000,
        "n_timesteps": 200_000,
        "agents": {"qlearning": {"algo": "qlearning"}},
        "environments": {"FrozenLake-v1": {}},
    }


def time_round(study: Path, folder: Path, *, report: bool) -> tuple[float, float]:
    """Wall and processor time of one round, in seconds."""
    command = [sys.executable, str(ROOT / "compare.py"), str(study), "-f", str(folder)]
    if not report:
        command.append("--no-report")
    return timed(command)


def training_seconds(folder: Path) -> float:
    """What all runs of a round spent on training and evaluations, one after the other."""
    with (folder / "summary.csv").open(newline="") as file:
        return sum(float(row["seconds"]) for row in csv.DictReader(file))


def main() -> None:
    """Time the rounds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--rounds", type=int, default=3, help="rounds to time")
    parser.add_argument("--report", action="store_true", help="draw figures and page as well")
    parser.add_argument("--thousand", action="store_true", help="the thousand seeds instead")
    args = parser.parse_args()
    name = "thousand" if args.thousand else "sweeps"
    asked = thousand() if args.thousand else sweeps()
    walls: list[float] = []
    with tempfile.TemporaryDirectory() as scratch:
        study = Path(scratch) / f"{name}.yml"
        study.write_text(json.dumps(asked))
        n_runs = len(asked["agents"]) * asked["seeds"]
        print(f"{asked['title']}: {n_runs} runs, on {available_cores()} cores", end="; ")
        print(f"load before: {os.getloadavg()[0]:.1f}")
        for number in range(args.rounds):
            folder = Path(scratch) / str(number)
            wall, processors = time_round(study, folder, report=args.report)
            walls.append(wall)
            training = training_seconds(folder / study.stem)
            print(
                f"round {number + 1}: {wall:.1f} s, of processors {processors:.1f} s; "
                f"sum over runs {training:.1f} s; load {os.getloadavg()[0]:.1f}",
                flush=True,
            )
    median = statistics.median(walls)
    verdict = "within" if median <= TARGET_SECONDS[name] else "over"
    print(f"median {median:.1f} s: {verdict} the target of {TARGET_SECONDS[name]:.0f} s")


if __name__ == "__main__":
    main()
