"""Q-learning here and in MushroomRL, on MushroomRL's grid of 10 x 10 cells.

    python benchmarks/against_mushroomrl.py                      # installs it: several minutes
    python benchmarks/against_mushroomrl.py --python PATH        # where it is installed already

MushroomRL 1.10 is of the time of NumPy 1.24, and so gets a virtual environment of its own, in a
temporary folder. The task is the same in both: from one corner to the other, reward 10 there, at
most 100 steps, discount 0.9, epsilon 0.1, step size 0.1. MushroomRL keeps no log of episodes; ours
write Monitor's files. Steps a second of processor time, medians over the rounds.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import tempfile
import time
import venv
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from rich.console import Console
from rich.table import Table
from stable_baselines3.common.env_util import make_vec_env

from agents import load_algorithm

PEER = "MushroomRL 1.10.1"
REQUIREMENTS = ("mushroom_rl==1.10.1", "numpy==1.24.4", "torch==2.13.0")
SIDE, HORIZON, GAMMA, EPSILON, STEP_SIZE = 10, 100, 0.9, 0.1, 0.1
STEPS = {"compiled": 3_000_000, "interpreted": 50_000, PEER: 50_000}

# The first training brings the episodes down to the length that they keep.
PROGRAM = f"""
import time
from mushroom_rl.algorithms.value import QLearning
from mushroom_rl.core import Core
from mushroom_rl.environments import GridWorld
from mushroom_rl.policy import EpsGreedy
from mushroom_rl.utils.parameters import Parameter
grid = GridWorld(width={SIDE}, height={SIDE}, goal=({SIDE - 1}, {SIDE - 1}))
assert (grid.info.horizon, grid.info.gamma) == ({HORIZON}, {GAMMA})
policy = EpsGreedy(epsilon=Parameter(value={EPSILON}))
agent = QLearning(grid.info, policy, learning_rate=Parameter(value={STEP_SIZE}))
core = Core(agent, grid)
core.learn(n_steps={STEPS[PEER]}, n_steps_per_fit=1, quiet=True)
started = time.process_time()
core.learn(n_steps={STEPS[PEER]}, n_steps_per_fit=1, quiet=True)
print({STEPS[PEER]} / (time.process_time() - started))
"""


def installed(folder: Path) -> Path:
    """A Python that has MushroomRL, in a new virtual environment."""
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    done = subprocess.run(
        [python, "-m", "pip", "install", "--quiet", *REQUIREMENTS],
        check=False,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise SystemExit(f"pip cannot install {PEER} here:\n{done.stderr[-2000:]}")
    return python


def peer_speed(python: Path) -> float:
    """MushroomRL's steps a second, from a process of its own."""
    done = subprocess.run([python, "-c", PROGRAM], check=True, capture_output=True, text=True)
    return float(done.stdout)


def practised(engine: str, folder: str) -> Any:
    """An agent on the same grid, after as many steps as MushroomRL's first training."""
    rows = ["F" * SIDE for _ in range(SIDE)]
    grid = ["S" + rows[0][1:], *rows[1:-1], rows[-1][:-1] + "G"]
    env = make_vec_env(
        "FrozenLake-v1",
        seed=0,
        env_kwargs={
            "desc": grid,
            "is_slippery": False,
            "reward_schedule": (10, 0, 0),
            "max_episode_steps": HORIZON,
        },
        monitor_dir=tempfile.mkdtemp(dir=folder),
    )
    algorithm: Any = load_algorithm("qlearning")
    agent = algorithm(
        env=env,
        seed=0,
        learning_rate=STEP_SIZE,
        gamma=GAMMA,
        exploration_decay="constant",
        exploration_initial_eps=EPSILON,
        engine=engine,
    )
    return agent.learn(STEPS[PEER])


def speed(agent: Any) -> float:
    """Our steps a second."""
    n_steps = STEPS[agent.engine]
    started = time.process_time()
    agent.learn(n_steps, log_interval=None, reset_num_timesteps=False)
    return n_steps / (time.process_time() - started)


def main() -> None:
    """Time all three and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5, metavar="N", help="rounds (default 5)")
    parser.add_argument("--python", type=Path, metavar="PATH", help="a Python with MushroomRL")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        python = args.python or installed(Path(folder) / "mushroomrl")
        ours = {engine: practised(engine, folder) for engine in ("compiled", "interpreted")}
        rounds = [
            {PEER: peer_speed(python)} | {engine: speed(agent) for engine, agent in ours.items()}
            for _ in range(args.repeats)
        ]
    speeds = {name: statistics.median(each[name] for each in rounds) for name in STEPS}
    table = Table("Q-learning", "steps/s", f"against {PEER}")
    for name, value in speeds.items():
        table.add_row(name, f"{value:,.0f}", f"{value / speeds[PEER]:.1f} x")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
