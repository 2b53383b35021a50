"""The cost of evaluations, callbacks and logs in a training; seconds of processor time.

The trainings are those of `train.py`, without evaluation flags and with a shorter budget, and
`learn()` with common callbacks and logs. The first contender is the training alone.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import BlockCallback
from rl_yardstick.commands.train import build_parser, spec_from_flags
from rl_yardstick.envs.wrappers import DiscretizeObservation
from rl_yardstick.pipeline.run import Run
from rl_yardstick.pipeline.training import train
from timing import Benchmark, Contender, Rows

N_STEPS = 20_000
EVALUATED, CHECKPOINTS = "EvalCallback with log and best model", "CheckpointCallback, ten zips"
BLOCKS = "BlockCallback every 1,000 steps"
TRAININGS = (
    "--env CartPole-v1 --algo ppo",
    "--env CartPole-v1 --algo ppo --engine compiled",
    "--env CartPole-v1 --algo dqn",
    "--env CartPole-v1 --algo a2c --engine compiled",
    "--env CartPole-v1 --algo qlearning",
    "--env Acrobot-v1 --algo semi_gradient_sarsa",
    "--env Pendulum-v1 --algo ppo",
)
# Agent, environment, number of environments and steps.
BESIDE = (
    ("qlearning", "FrozenLake-v1", 1, 3_000_000),
    ("qlearning", "CartPole-v1", 1, 3_000_000),
    ("ppo", "CartPole-v1", 16, 100_000),
)
PPO = {"n_steps": 128, "batch_size": 512, "n_epochs": 10, "learning_rate": 1e-3, "ent_coef": 0.01}
TABLE = {"learning_rate": 0.1, "exploration_initial_eps": 0.1, "exploration_decay": "constant"}
IN_BINS = partial(
    DiscretizeObservation,
    bins=50,
    low=[-0.41887903, -0.87266463],
    high=[0.41887903, 0.87266463],
    dims=[2, 3],
)


def typed(words: str, *more: str) -> Contender:
    """A whole training of `train.py` with these arguments."""

    def measure() -> float:
        with tempfile.TemporaryDirectory() as folder:
            flags = [*words.split(), "-n", str(N_STEPS), "--seed", "0", "-f", folder, *more]
            spec = spec_from_flags(build_parser().parse_args([*flags, "--num-threads", "1"]))
            started = time.process_time()
            with Run.claim(Path(folder), spec) as run:
                train(spec, run)
            return time.process_time() - started

    return measure


class EachThousand(BlockCallback):
    """A callback that acts every thousand steps."""

    every_n_steps = 1000

    def _on_step(self) -> bool:
        return True


def environments(algo: str, env_id: str, n: int, folder: str | None = None) -> VecEnv:
    """Environments of a training or an evaluation; CartPole in bins for a table."""
    in_bins: Any = IN_BINS if (algo, env_id) == ("qlearning", "CartPole-v1") else None
    return make_vec_env(env_id, n, seed=0, wrapper_class=in_bins, monitor_dir=folder)


def beside(algo: str, env_id: str, n_envs: int, n_steps: int, name: str) -> float:
    """Seconds of a training with the named callback or log, after its loop is compiled."""
    every = n_steps // 10 // n_envs
    with tempfile.TemporaryDirectory() as folder:
        evaluated = partial(EvalCallback, n_eval_episodes=20, eval_freq=every, verbose=0)
        callbacks: dict[str, Callable[[], BaseCallback]] = {
            EVALUATED: lambda: evaluated(
                environments(algo, env_id, 1), log_path=folder, best_model_save_path=folder
            ),
            CHECKPOINTS: lambda: CheckpointCallback(every, folder),
            BLOCKS: EachThousand,
        }
        settings: dict[str, Any] = {"policy": "MlpPolicy", **PPO} if algo == "ppo" else TABLE
        algorithm: Any = load_algorithm(algo)
        env = environments(algo, env_id, n_envs, folder)
        model = algorithm(env=env, seed=0, engine="auto", **settings)
        interval = None
        if name == "TensorBoard":
            model.set_logger(configure(folder, ["tensorboard"]))
            interval = 1 if algo == "ppo" else 100
        model.learn(300 * n_envs, log_interval=interval)
        callback = callbacks[name]() if name in callbacks else None
        started = time.process_time()
        model.learn(n_steps, callback=callback, log_interval=interval)
        return time.process_time() - started


def rows(folder: Path) -> Rows:
    """Trainings with and without evaluations, and with callbacks and logs."""
    made: Rows = {
        f"train.py {words}": {
            "--eval-freq -1 --eval-episodes 1": typed(
                words, "--eval-freq", "-1", "--eval-episodes", "1"
            ),
            "as typed": typed(words),
        }
        for words in TRAININGS
    }
    names = ("nothing", EVALUATED, "TensorBoard", CHECKPOINTS, BLOCKS)
    for training in BESIDE:
        label = f"learn(), {training[0]} compiled, {training[1]}"
        made[label] = {name: partial(beside, *training, name) for name in names}
    return made


BENCHMARK = Benchmark("seconds", rounds=3, rows=rows, is_speed=False, warms_up=True)
