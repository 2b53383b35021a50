"""Compares tune.py with plain Optuna and Stable-Baselines3, with equal processor time.

    python benchmarks/timed_search.py --env CartPole-v1 -n 6000 --seconds 40 --searches 3

Each contender searches for settings of PPO, several times, with other seeds each time. What it
proposes is trained again on seeds that no search has seen, all with ``--engine auto``, and judged
by the mean score. tune.py has its re-test within the budget: its search ends after
``SEARCH_SHARE`` of it. It proposes the shipped settings if nothing is shown to be better. Optuna
proposes its best trial. Its search is that of many tutorials, with rl_zoo3's ranges: one seed a
trial, TPE, and a median pruner that sees an evaluation of 20 episodes half-way.

The processor time is that of training and evaluation alone, and not of loading the libraries. What
each search really took stands in the table: a trial that has begun ends.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parent.parent
SEARCH_SHARE = 0.5
FIRST_UNSEEN = 2000
ENVIRON = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}


def processor_seconds(root: Path) -> float:
    """What the runs in a folder have taken that have ended."""
    files = root.glob("runs/*/*/run.json")
    return sum(json.loads(path.read_text()).get("cpu_seconds") or 0.0 for path in files)


def run(words: Sequence[object], root: Path = ROOT, budget: float = float("inf")) -> None:
    """Run a command of the project until it ends, or the runs in a folder have taken a budget."""
    command = [sys.executable, *map(str, words)]
    with subprocess.Popen(
        command, cwd=ROOT, env=ENVIRON, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as child:
        while child.poll() is None:
            if processor_seconds(root) > budget:
                child.send_signal(signal.SIGTERM)
                budget = float("inf")
            time.sleep(0.2)


def tuned(args: argparse.Namespace, number: int, folder: Path) -> tuple[Path | None, float, int]:
    """A search of tune.py: the winner's file, its processor time and its number of trials."""
    first = 100 * number
    words: list[object] = ["tune.py", "--env", args.env, "--algo", "ppo", "-n", args.n_timesteps]
    words += ["--engine", "auto", "--trials", 1000, "--seed", number, "--first-seed", first]
    words += ["--seeds-per-trial", 3, "--n-startup-trials", 5, "--retest", 2, "--retest-seeds", 8]
    words += ["-j", 1, "--no-report", "-f", folder, "--name", f"tune-{number}"]
    root = folder / f"tune-{number}"
    run(words, root, SEARCH_SHARE * args.seconds)
    run([*words, "--timeout", "1s"])
    taken = processor_seconds(root) + processor_seconds(root / "retest")
    record = json.loads((folder / f"tune-{number}" / "tuning.json").read_text())
    n_trials = sum(trial["state"] in ("complete", "pruned") for trial in record["trials"])
    winner = folder / f"tune-{number}" / "winner.yml"
    return winner if winner.exists() else None, taken, n_trials


def with_optuna(args: argparse.Namespace, number: int, folder: Path) -> tuple[Path, float, int]:
    """The same of Optuna, in this process."""
    import gymnasium as gym
    import optuna
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    torch.set_num_threads(1)
    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def objective(trial: optuna.Trial) -> float:
        settings = {
            "n_steps": 2 ** trial.suggest_int("log2_n_steps", 5, 10),
            "batch_size": 2 ** trial.suggest_int("log2_batch_size", 5, 9),
            "gamma": 1 - trial.suggest_float("one_minus_gamma", 1e-4, 0.1, log=True),
            "learning_rate": trial.suggest_float("learning_rate", 1e-5, 1e-2, log=True),
            "ent_coef": trial.suggest_float("ent_coef", 1e-8, 0.1, log=True),
            "clip_range": trial.suggest_categorical("clip_range", [0.1, 0.2, 0.3, 0.4]),
            "n_epochs": trial.suggest_categorical("n_epochs", [1, 5, 10, 20]),
            "gae_lambda": 1 - trial.suggest_float("one_minus_lambda", 1e-3, 0.2, log=True),
            "max_grad_norm": trial.suggest_float("max_grad_norm", 0.3, 5.0, log=True),
        }
        settings["batch_size"] = min(settings["batch_size"], 8 * settings["n_steps"])
        trial.set_user_attr("settings", {**settings, "n_envs": 8})
        envs = make_vec_env(args.env, 8, seed=100 * number)
        model = PPO("MlpPolicy", envs, seed=100 * number, device="cpu", **settings)
        value = 0.0
        for half in range(2):
            model.learn(args.n_timesteps // 2, reset_num_timesteps=half == 0)
            value = float(np.mean(evaluate_policy(model, gym.make(args.env), 20, warn=False)[0]))
            trial.report(value, half)
            if half == 0 and trial.should_prune():
                raise optuna.TrialPruned
        return value

    sampler = optuna.samplers.TPESampler(seed=number, multivariate=True, n_startup_trials=5)
    pruner = optuna.pruners.MedianPruner(n_startup_trials=5)
    study = optuna.create_study(direction="maximize", sampler=sampler, pruner=pruner)
    started = time.process_time()
    while time.process_time() - started < args.seconds:
        study.optimize(objective, n_trials=1)
    path = folder / f"optuna-{number}.yml"
    entry = {"policy": "MlpPolicy", **study.best_trial.user_attrs["settings"]}
    taken = time.process_time() - started
    path.write_text(yaml.safe_dump({args.env: {"n_timesteps": args.n_timesteps, **entry}}))
    return path, taken, len(study.trials)


def score(args: argparse.Namespace, name: str, file: Path | None, folder: Path) -> float:
    """The mean score of settings on the unseen seeds; None are the shipped settings."""
    import pandas as pd

    words: list[object] = ["compare.py", "--env", args.env, "--algos", "ppo", "--engine", "auto"]
    words += ["-n", args.n_timesteps, "--seeds", args.seeds, "--first-seed", FIRST_UNSEEN, "-j", 1]
    words += ["--no-report", "--name", name, "-f", folder]
    run([*words, *(() if file is None else ("--conf-file", file))])
    table = pd.read_csv(folder / name / "summary.csv")
    assert len(table) == args.seeds, f"{name}: {len(table)} of {args.seeds} runs"
    return float(table["score"].clip(0, 1).mean())


def main() -> int:
    """Do the searches, judge what they propose, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    add = parser.add_argument
    add("--env", default="CartPole-v1", help="an environment of Gymnasium")
    add("-n", "--n-timesteps", type=int, default=6000, metavar="N", help="steps of a run")
    add("--seconds", type=float, default=40, help="processor time of each search")
    add("--searches", type=int, default=3, help="searches of each contender")
    add("--seeds", type=int, default=20, help="unseen seeds that judge")
    add(
        "--folder", type=Path, default=Path("logs/timed-search"), help="for runs, which must be new"
    )
    args = parser.parse_args()
    args.folder.mkdir(parents=True)
    folder = args.folder.resolve()
    print(f"PPO on {args.env}, {args.n_timesteps:,} steps, {args.seconds:.0f} s a search\n")
    print(
        "| contender | search | processor time | trials | proposes | score |\n" + "|---" * 6 + "|"
    )
    print(f"| shipped | | | | | {score(args, 'shipped', None, folder):.3f} |", flush=True)
    contenders: Mapping[str, Any] = {"tune.py": tuned, "Optuna": with_optuna}
    for number in range(args.searches):
        for name, search in contenders.items():
            file, taken, n_trials = search(args, number, folder)
            found = score(args, f"{name.removesuffix('.py')}-judged-{number}", file, folder)
            what = "shipped settings" if file is None else "a trial"
            print(f"| {name} | {number} | {taken:.0f} s | {n_trials} | {what} | {found:.3f} |")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
