"""What share of a training's time its evaluations take, and what callbacks and logs cost.

    python benchmarks/evaluation_share.py                  # as typed, some twenty minutes
    python benchmarks/evaluation_share.py -n 20000         # so many steps of each
    python benchmarks/evaluation_share.py --env CartPole-v1 --work "a2c, compiled" qlearning
    python benchmarks/evaluation_share.py --callbacks      # two minutes on an idle machine

Each training is a process of its own: settings from our files, the budget too unless ``-n`` says
another, and no flag for evaluation. Times are of processors. Evaluations go by steps, so that the
same seed gives the same files on any machine; what they take of the time is what is shown here.

With ``--callbacks``, compiled Q-learning and PPO train by ``learn`` with each of the things that
people put beside a training; reported is the time as a multiple of that without any, by medians
over rounds in which all take their turn. Evaluations are ten of 20 episodes.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from rich.console import Console
from rich.table import Table
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    LogEveryNTimesteps,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from agents import load_algorithm
from agents.common.callbacks import BlockCallback
from envs.wrappers import DiscretizeObservation

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENTS = ("CartPole-v1", "MountainCar-v0", "Acrobot-v1", "Pendulum-v1")
COMPILED = ("-params", "engine:compiled")
WORK: dict[str, tuple[str, ...]] = {
    "ppo": ("--algo", "ppo"),
    "ppo, compiled": ("--algo", "ppo", *COMPILED),
    "dqn": ("--algo", "dqn"),
    "dqn, compiled": ("--algo", "dqn", *COMPILED),
    "a2c": ("--algo", "a2c"),
    "a2c, compiled": ("--algo", "a2c", *COMPILED),
    "qlearning": ("--algo", "qlearning"),
    "semi_gradient_sarsa": ("--algo", "semi_gradient_sarsa"),
}
# In a process of its own: the command's flags, and what the outcome says that no file does.
TRAINING = """
import json
from rich.console import Console
from commands.train import build_parser
from commands.train import train_spec
from pipeline import training
during = []
finish = training._finish
def noted(made, *rest):
    during.append(made.evaluation.taken)  # the last evaluation is still to come
    return finish(made, *rest)
training._finish = noted
spec = train_spec(build_parser().parse_args())
done = training.train(spec, Console(quiet=True), {}, "")
print(json.dumps({
    "steps": done.n_steps,
    "evaluation_steps": done.evaluation_steps,
    "training": (done.taken - during[0]).cpu_seconds,
    "evaluating": done.evaluating.cpu_seconds,
}))
"""


def trained(env_id: str, work: str, n: int | None) -> dict[str, float] | None:
    """What one training has taken; None where such an agent does not fit the environment."""
    budget = () if n is None else ("-n", str(n))
    with tempfile.TemporaryDirectory() as folder:
        flags = ("--env", env_id, *WORK[work], *budget, "--seed", "0", "-f", folder)
        command = [sys.executable, "-c", TRAINING, *flags, "--num-threads", "1"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"{work} on {env_id}: {done.stderr.strip().splitlines()[-1]}", file=sys.stderr)
        return None
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


class EachStep(BaseCallback):
    """A user's own, which has to be asked after each step."""

    def _on_step(self) -> bool:
        return True


class EachThousand(BlockCallback):
    """One that says when it acts."""

    every_n_steps = 1000

    def _on_step(self) -> bool:
        return True


# Agent, environment, number of environments and steps; interpreted, a fiftieth of them.
TRAININGS = [
    ("qlearning", "FrozenLake-v1", 1, 3_000_000),
    ("qlearning", "envs:Warehouse-v0", 1, 3_000_000),
    ("qlearning", "CartPole-v1", 1, 3_000_000),
    ("ppo", "FrozenLake-v1", 16, 100_000),
    ("ppo", "envs:Warehouse-v0", 16, 100_000),
    ("ppo", "CartPole-v1", 16, 100_000),
]
PPO = {"n_steps": 128, "batch_size": 512, "n_epochs": 10, "learning_rate": 1e-3, "ent_coef": 0.01}
TABLE = {"learning_rate": 0.1, "exploration_initial_eps": 0.1, "exploration_decay": "constant"}
POLE_IN_BINS: dict[str, Any] = {
    "bins": 50,
    "low": [-0.41887903, -0.87266463],
    "high": [0.41887903, 0.87266463],
}
LOGS = {"TensorBoard": "tensorboard", "CSV logger": "csv"}
EACH_STEP = "own callback, each step"


def environments(algo: str, env_id: str, n: int, folder: str | None = None) -> VecEnv:
    """Those of a training or an evaluation; CartPole in bins for a table."""
    in_bins = partial(DiscretizeObservation, **POLE_IN_BINS, dims=[2, 3])
    wrapper: Any = in_bins if (algo, env_id) == ("qlearning", "CartPole-v1") else None
    return make_vec_env(env_id, n, seed=0, wrapper_class=wrapper, monitor_dir=folder)


def beside(
    algo: str, env_id: str, every: int, n_steps: int, folder: str
) -> dict[str, Callable[[], BaseCallback | None]]:
    """What is put beside a training, by name."""

    def evaluation(wrap: Callable[[VecEnv], VecEnv] = lambda env: env, **more: Any) -> EvalCallback:
        env = wrap(environments(algo, env_id, 1))
        return EvalCallback(env, n_eval_episodes=20, eval_freq=every, verbose=0, **more)

    threshold = partial(StopTrainingOnRewardThreshold, 1e9, verbose=0)
    patience = partial(StopTrainingOnNoModelImprovement, 1000)
    normalized = partial(VecNormalize, training=False, norm_obs=False, norm_reward=False)
    return {
        "none": lambda: None,
        "EvalCallback": evaluation,
        "with log and best model": partial(
            evaluation, log_path=folder, best_model_save_path=folder
        ),
        "with stop at a reward": lambda: evaluation(callback_on_new_best=threshold()),
        "with stop without improvement": lambda: evaluation(callback_after_eval=patience()),
        "on VecNormalize": lambda: evaluation(normalized),
        "CheckpointCallback, 10": lambda: CheckpointCallback(every, folder),
        "LogEveryNTimesteps, 10": lambda: LogEveryNTimesteps(n_steps // 10),
        **{name: lambda: None for name in LOGS},
        "BlockCallback, each 1000 steps": EachThousand,
        EACH_STEP: EachStep,
    }


def seconds_a_step(name: str, algo: str, env_id: str, n_envs: int, n_steps: int) -> float:
    """What a step of a training takes beside which that is put, once its loop is compiled."""
    every = n_steps // 10 // n_envs
    if name == EACH_STEP:
        n_steps //= 50
    with tempfile.TemporaryDirectory() as folder:
        settings: dict[str, Any] = {"policy": "MlpPolicy", **PPO} if algo == "ppo" else TABLE
        algorithm: Any = load_algorithm(algo)
        env = environments(algo, env_id, n_envs, folder)
        model = algorithm(env=env, seed=0, engine="auto", **settings)
        if name in LOGS:
            model.set_logger(configure(folder, [LOGS[name]]))
        interval = (1 if algo == "ppo" else 100) if name in LOGS else None
        model.learn(300 * n_envs, log_interval=interval)
        callback = beside(algo, env_id, every, n_steps, folder)[name]()
        began = time.process_time()
        model.learn(n_steps, callback=callback, log_interval=interval)
        taken = time.process_time() - began
        model.logger.close()
        return taken / n_steps


def callback_costs(n_rounds: int) -> Table:
    """The table of what is put beside a training: its time as a multiple of that without."""
    names = list(beside("", "", 1, 1, ""))
    table = Table("beside the training", *(f"{t[0]}, {t[1].rpartition(':')[2]}" for t in TRAININGS))
    columns = []
    for training in TRAININGS:
        taken: dict[str, list[float]] = {name: [] for name in names}
        for k in range(n_rounds + 1):
            for name in names:
                seconds = seconds_a_step(name, *training)
                # The first round compiles.
                if k:
                    taken[name].append(seconds)
        medians = {name: statistics.median(each) for name, each in taken.items()}
        columns.append([f"{medians[name] / medians['none']:,.2f}" for name in names])
        print(training[:2], dict(zip(names, columns[-1], strict=True)), file=sys.stderr)
    for name, *ratios in zip(names, *columns, strict=True):
        table.add_row(name, *ratios)
    return table


def main() -> None:
    """Train, and print the shares."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-n", type=int, help="environment steps of each, instead of its own")
    parser.add_argument("--env", nargs="+", default=ENVIRONMENTS)
    parser.add_argument("--work", nargs="+", default=list(WORK), choices=list(WORK))
    parser.add_argument("--callbacks", action="store_true", help="what callbacks and logs cost")
    parser.add_argument("--rounds", type=int, default=3, help="of --callbacks")
    args = parser.parse_args()
    if args.callbacks:
        Console(width=140).print(callback_costs(args.rounds))
        return
    table = Table(
        "environment",
        "agent",
        "steps",
        "evaluation's steps",
        "training, s",
        "evaluating, % of that",
    )
    for env_id in args.env:
        for work in args.work:
            found = trained(env_id, work, args.n)
            if found is not None:
                table.add_row(env_id, work, *_cells(found))
    Console(width=110).print(table)


def _cells(found: dict[str, float]) -> tuple[str, ...]:
    return (
        f"{found['steps']:,.0f}",
        f"{found['evaluation_steps']:,.0f}",
        f"{found['training']:.1f}",
        f"{100 * found['evaluating'] / found['training']:.1f}",
    )


if __name__ == "__main__":
    main()
