"""One search of plain Optuna or of rl_zoo3, in the peers' environment; see timed_search.py.

    peer_search.py {Optuna,rl_zoo3} ENV ALGO N_TIMESTEPS N_ENVS SEED SECONDS FILE

It ends after SECONDS of processor time, writes the best trial's settings into FILE as rl_zoo3's
hyperparameters, and prints the processor time and the number of trials as its last line.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import optuna
import rl_zoo3.train
import torch
import yaml
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

AGENTS = {"dqn": DQN, "ppo": PPO}


def with_optuna(
    env_id: str, algo: str, n_timesteps: int, n_envs: int, seed: int, storage: str
) -> None:
    """The search of many tutorials: one seed a trial, TPE, and a median pruner that sees half."""

    def objective(trial: optuna.Trial) -> float:
        settings = HYPERPARAMS_SAMPLER[algo](trial, 0, n_envs, {"using_her_replay_buffer": False})
        envs = make_vec_env(env_id, n_envs, seed=seed)
        model = AGENTS[algo]("MlpPolicy", envs, seed=seed, device="cpu", **settings)
        value = 0.0
        for half in range(2):
            model.learn(n_timesteps // 2, reset_num_timesteps=half == 0)
            value = float(np.mean(evaluate_policy(model, gym.make(env_id), 20, warn=False)[0]))
            trial.report(value, half)
            if half == 0 and trial.should_prune():
                raise optuna.TrialPruned
        return value

    study = optuna.create_study(
        study_name="search",
        storage=storage,
        direction="maximize",
        sampler=optuna.samplers.TPESampler(seed=seed, multivariate=True, n_startup_trials=5),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=5),
    )
    study.optimize(objective)


def with_rl_zoo3(
    env_id: str, algo: str, n_timesteps: int, n_envs: int, seed: int, storage: str
) -> None:
    """rl_zoo3's ``-optimize`` with its own defaults, and two evaluations in a run."""
    folder = Path(storage.removeprefix("sqlite:///")).parent
    entry = {"n_envs": n_envs, "n_timesteps": n_timesteps, "policy": "MlpPolicy"}
    entries = folder / "entry.yml"
    entries.write_text(yaml.safe_dump({env_id: entry}))
    words = ["--algo", algo, "--env", env_id, "-n", n_timesteps, "--seed", seed, "-optimize"]
    words += ["--n-trials", 100_000, "--n-startup-trials", 5, "--n-evaluations", 2]
    words += ["--storage", storage, "--study-name", "search", "--conf-file", entries]
    words += ["--eval-episodes", 20, "--no-optim-plots", "--log-folder", folder]
    sys.argv = ["train.py", *map(str, words)]
    rl_zoo3.train.train()


def as_text(value: object) -> object:
    """A setting as it stands in a file of hyperparameters."""
    if isinstance(value, Mapping):
        return f"dict({', '.join(f'{name}={as_text(of)}' for name, of in value.items())})"
    return f"nn.{value.__name__}" if isinstance(value, type) else value


CONTENDERS: Mapping[str, Callable[..., None]] = {"Optuna": with_optuna, "rl_zoo3": with_rl_zoo3}


def main() -> None:
    """Search until the time is over, and tell what was found."""
    contender, env_id, algo, *numbers, file = sys.argv[1:]
    n_timesteps, n_envs, seed, seconds = map(int, numbers)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    torch.set_num_threads(1)
    storage = f"sqlite:///{Path(file).with_suffix('.db')}"
    started = time.process_time()
    # Whoever is started in the background ignores it.
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def watch() -> None:
        while time.process_time() - started < seconds:
            time.sleep(0.2)
        signal.raise_signal(signal.SIGINT)

    threading.Thread(target=watch, daemon=True).start()
    # A ValueError: rl_zoo3 asks for the best trial where none is complete.
    with contextlib.suppress(KeyboardInterrupt, ValueError):
        CONTENDERS[contender](env_id, algo, n_timesteps, n_envs, seed, storage)
    taken = time.process_time() - started
    study = optuna.load_study(study_name="search", storage=storage)
    counts = (optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED)
    done = study.get_trials(states=counts)
    if any(trial.state == optuna.trial.TrialState.COMPLETE for trial in done):
        settings: dict[str, Any] = HYPERPARAMS_CONVERTER[algo](study.best_trial.params)
        entry = {"n_timesteps": n_timesteps, "n_envs": n_envs, "policy": "MlpPolicy"}
        entry |= {name: as_text(value) for name, value in settings.items()}
        Path(file).write_text(yaml.safe_dump({env_id: entry}))
    print(f"\n{taken:.1f} {len(done)}")


if __name__ == "__main__":
    main()
