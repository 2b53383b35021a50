"""Networks on the library's loop and on compiled code; steps a second.

With Monitor, without logs and evaluations. Code is compiled before the measurement.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

import rl_yardstick.envs  # noqa: F401  # registers the warehouse
from rl_yardstick.agents import load_algorithm
from timing import Benchmark, Rows

LAKE = {"n_steps": 128, "batch_size": 512, "n_epochs": 10, "learning_rate": 1e-3, "ent_coef": 0.01}
ZOO_PPO = {"n_steps": 32, "batch_size": 256, "gae_lambda": 0.8, "gamma": 0.98, "n_epochs": 20}
ZOO_PPO |= {"ent_coef": 0.0, "learning_rate": 1e-3}
SMALL_DQN: dict[str, Any] = {"policy_kwargs": {"net_arch": [64, 64]}, "learning_rate": 1e-3}
SMALL_DQN |= {"batch_size": 32, "buffer_size": 10_000, "learning_starts": 1_000}
SMALL_DQN |= {"train_freq": 4, "target_update_interval": 250}
ZOO_DQN: dict[str, Any] = {"policy_kwargs": {"net_arch": [256, 256]}, "learning_rate": 2.3e-3}
ZOO_DQN |= {"batch_size": 64, "buffer_size": 100_000, "learning_starts": 1_000}
ZOO_DQN |= {"train_freq": 256, "gradient_steps": 128, "target_update_interval": 10}
ZOO_DQN |= {"exploration_fraction": 0.16, "exploration_final_eps": 0.04}
# By name: agent, environment, number of environments, settings, steps compiled and otherwise.
TASKS: dict[str, tuple[str, str, int, dict[str, Any], int, int]] = {
    "PPO, CartPole, rl_zoo3's settings": ("ppo", "CartPole-v1", 8, ZOO_PPO, 100_000, 12_000),
    "PPO, FrozenLake, 16 x 128 steps": ("ppo", "FrozenLake-v1", 16, LAKE, 200_000, 20_000),
    "PPO, Warehouse, 16 x 128 steps": ("ppo", "Warehouse-v0", 16, LAKE, 200_000, 20_000),
    "A2C, CartPole, 8 x 5 steps": ("a2c", "CartPole-v1", 8, {}, 100_000, 8_000),
    "DQN [64, 64], CartPole": ("dqn", "CartPole-v1", 1, SMALL_DQN, 200_000, 20_000),
    "DQN [64, 64], FrozenLake": ("dqn", "FrozenLake-v1", 1, SMALL_DQN, 200_000, 20_000),
    "DQN [256, 256], CartPole, rl_zoo3's": ("dqn", "CartPole-v1", 1, ZOO_DQN, 20_000, 20_000),
}


class AskedEachStep(BaseCallback):
    """A callback that keeps an environment from being compiled."""

    def _on_step(self) -> bool:
        return True


def steps_a_second(task: str, engine: str, callback: BaseCallback | None = None) -> float:
    """Steps a second of a new agent, after its loop has been compiled."""
    name, env_id, n_envs, settings, compiled_steps, other_steps = TASKS[task]
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


def rows(folder: Path) -> Rows:
    """The library's loop, and ours, fully compiled and with the environment in Python."""
    th.set_num_threads(1)
    return {
        task: {
            "Stable-Baselines3": partial(steps_a_second, task, "library"),
            "compiled": partial(steps_a_second, task, "compiled"),
            "environment in Python": partial(steps_a_second, task, "compiled", AskedEachStep()),
        }
        for task in TASKS
    }


BENCHMARK = Benchmark("steps a second", rounds=3, rows=rows)
