"""Networks trained on the library's loop and on compiled code, and by SBX where it is installed.

    python benchmarks/network_speed.py                  # three rounds: ten minutes
    python benchmarks/network_speed.py --sbx PATH       # with a Python that has sbx-rl

Environment steps a second of processor time, one thread, Monitor on, nothing logged, nothing
evaluated; all contenders take their turn in each round, and ratios are those of medians. SBX
compiles with JAX and runs in a virtual environment of its own: `pip install sbx-rl`.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torch as th
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the warehouse
from agents import load_algorithm

LAKE = {"n_steps": 128, "batch_size": 512, "n_epochs": 10, "learning_rate": 1e-3, "ent_coef": 0.01}
ZOO_PPO = {
    "n_steps": 32,
    "batch_size": 256,
    "gae_lambda": 0.8,
    "gamma": 0.98,
    "n_epochs": 20,
    "ent_coef": 0.0,
    "learning_rate": 1e-3,
}
SMALL_DQN = {
    "learning_rate": 1e-3,
    "batch_size": 32,
    "buffer_size": 10_000,
    "learning_starts": 1_000,
    "train_freq": 4,
    "target_update_interval": 250,
    "policy_kwargs": {"net_arch": [64, 64]},
}
ZOO_DQN = {
    "learning_rate": 2.3e-3,
    "batch_size": 64,
    "buffer_size": 100_000,
    "learning_starts": 1_000,
    "target_update_interval": 10,
    "train_freq": 256,
    "gradient_steps": 128,
    "exploration_fraction": 0.16,
    "exploration_final_eps": 0.04,
    "policy_kwargs": {"net_arch": [256, 256]},
}

# Name, agent, environment, number of environments, settings; steps compiled and otherwise, and the
# least that compiled is to be ahead of the library.
Task = tuple[str, str, str, int, dict[str, Any], int, int, float]
TASKS: list[Task] = [
    ("PPO, rl_zoo3's settings", "ppo", "CartPole-v1", 8, ZOO_PPO, 100_000, 12_000, 10),
    ("PPO, 16 x 128", "ppo", "FrozenLake-v1", 16, LAKE, 200_000, 20_000, 10),
    ("PPO, 16 x 128", "ppo", "Warehouse-v0", 16, LAKE, 200_000, 20_000, 10),
    ("A2C, 8 x 5", "a2c", "CartPole-v1", 8, {}, 100_000, 8_000, 0),
    ("DQN [64, 64]", "dqn", "CartPole-v1", 1, SMALL_DQN, 200_000, 20_000, 50),
    ("DQN [64, 64]", "dqn", "FrozenLake-v1", 1, SMALL_DQN, 200_000, 20_000, 50),
    ("DQN [256, 256], rl_zoo3's", "dqn", "CartPole-v1", 1, ZOO_DQN, 20_000, 20_000, 7),
]

LIBRARY, COMPILED, LEARNING, SBX = (
    "Stable-Baselines3",
    "compiled",
    "compiled but for the environment",
    "SBX",
)

# Run by the other Python; SBX takes the networks' sizes and all else under the same names.
SBX_PROGRAM = """
import json, sys, time
import sbx
from stable_baselines3.common.env_util import make_vec_env
agent, env_id, n_envs, settings, n_steps = json.loads(sys.argv[1])
env = make_vec_env(env_id, n_envs, seed=0)
model = getattr(sbx, agent.upper())("MlpPolicy", env, seed=0, **settings)
model.learn(4_000)
started = time.process_time()
model.learn(n_steps, reset_num_timesteps=False)
print(n_steps / (time.process_time() - started))
"""


class AskedEachStep(BaseCallback):
    """What keeps an environment from being compiled."""

    def _on_step(self) -> bool:
        return True


def speed(task: Task, engine: str, callback: BaseCallback | None = None) -> float:
    """Steps a second of a new agent, whose loop has been compiled before."""
    _, name, env_id, n_envs, settings, compiled_steps, other_steps, _ = task
    algorithm: Any = load_algorithm(name)

    def make() -> Any:
        env = make_vec_env(env_id, n_envs, seed=0)
        return algorithm("MlpPolicy", env, seed=0, device="cpu", engine=engine, **settings)

    make().learn(1_500, callback=callback, log_interval=None)
    agent = make()
    n_steps = compiled_steps if engine == "compiled" and callback is None else other_steps
    started = time.process_time()
    agent.learn(n_steps, callback=callback, log_interval=None)
    return float(agent.num_timesteps / (time.process_time() - started))


def sbx_speed(task: Task, python: Path) -> float | None:
    """SBX's, from a process of its own; None where it has no such agent or environment."""
    _, name, env_id, n_envs, settings, _, n_steps, _ = task
    given = json.dumps([name, env_id, n_envs, settings, n_steps])
    done = subprocess.run(
        [python, "-c", SBX_PROGRAM, given], check=False, capture_output=True, text=True
    )
    return float(done.stdout.split()[-1]) if done.returncode == 0 else None


def contenders(task: Task, python: Path | None) -> dict[str, Callable[[], float | None]]:
    """What is timed, by its name."""
    known: dict[str, Callable[[], float | None]] = {
        LIBRARY: lambda: speed(task, "library"),
        COMPILED: lambda: speed(task, "compiled"),
        LEARNING: lambda: speed(task, "compiled", AskedEachStep()),
    }
    if python is not None:
        known[SBX] = lambda: sbx_speed(task, python)
    return known


def main() -> None:
    """Time all contenders and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="rounds (default 3)")
    parser.add_argument("--sbx", type=Path, metavar="PATH", help="a Python with sbx-rl")
    args = parser.parse_args()
    th.set_num_threads(1)
    table = Table("task", "environment", "contender", "steps/s", "against the library", "target")
    for task in TASKS:
        known = contenders(task, args.sbx)
        rounds = [{name: run() for name, run in known.items()} for _ in range(args.repeats)]
        library = statistics.median(each[LIBRARY] or 0.0 for each in rounds)
        for name in known:
            speeds = [each[name] for each in rounds]
            if None in speeds:
                table.add_row(task[0], task[2], name, "does not run")
                continue
            median = statistics.median(value for value in speeds if value is not None)
            target = f"{task[-1]:g} x" if name == COMPILED and task[-1] else ""
            row = (f"{median:,.0f}", f"{median / library:.1f} x", target)
            table.add_row(task[0] if name == LIBRARY else "", task[2], name, *row)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
