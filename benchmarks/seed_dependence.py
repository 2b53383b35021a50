"""How far runs of neighbouring seeds depend on each other, since they share environments' seeds.

    python benchmarks/seed_dependence.py             # tables: ten minutes on one core
    python benchmarks/seed_dependence.py --networks  # PPO and DQN: forty minutes

Environment i of a run with seed s is seeded with s + i, as Stable-Baselines3 does it. So with eight
environments the runs of seeds 0 and 1 have seven environment streams in common, in other places;
their agents' streams differ. Printed is what comes of that: the correlation of final scores at
lag 1, and by which factor lags 1 to 9 make the variance of a mean over ten seeds in a row larger
than that of ten independent runs. The same for seeds that lie 16 apart, which share nothing.
Budgets are cut so that scores differ between seeds. Errors are standard errors for independent
scores.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from mdp.array_types import Floats

SEEDS_OF_A_STUDY = 10
APART = 16  # the most environments that a shipped entry has
LAGS = np.arange(1, SEEDS_OF_A_STUDY)
WEIGHTS = 2 * (1 - LAGS / SEEDS_OF_A_STUDY)


@dataclass(frozen=True)
class Case:
    """Runs of an agent with the settings of its entry, but for what is named here."""

    algo: str
    env_id: str
    n_timesteps: int
    n_envs: int
    n_seeds: int


TABLES = (
    Case("qlearning", "GaussianBandit-v0", 8_000, 8, 500),
    Case("qlearning", "FrozenLake-v1", 5_000, 8, 1000),
    Case("qlearning", "FrozenLake-v1", 5_000, 16, 1000),
    Case("qlearning", "Taxi-v4", 20_000, 8, 400),
)
NETWORKS = (
    Case("dqn", "FrozenLake-v1", 10_000, 8, 200),
    Case("ppo", "FrozenLake-v1", 16_384, 16, 200),
)


def final_return(case: Case, seed: int) -> float:
    """Train with one seed; the exact return of the final policy, or on bandits the mean reward."""
    import torch as th

    from agents import load_algorithm
    from pipeline.agent_settings import resolved_spec
    from pipeline.environments import make_training_env
    from pipeline.evaluation.exact import exact_evaluator
    from pipeline.preparation import algorithm_kwargs
    from pipeline.settings.hyperparams import override, read_hyperparams

    th.set_num_threads(1)
    changes = {"n_timesteps": case.n_timesteps, "n_envs": case.n_envs}
    raw = override(read_hyperparams(case.algo, case.env_id), changes)
    spec = resolved_spec(raw, algo=case.algo, env_id=case.env_id, seed=seed)
    env = make_training_env(spec, None)
    algorithm: Any = load_algorithm(case.algo)
    agent = algorithm(env=env, device="cpu", seed=seed, **algorithm_kwargs(spec))
    agent.learn(case.n_timesteps)
    evaluator = exact_evaluator(spec)
    if evaluator is not None:
        return float(evaluator(agent, True).mean_return)
    return float(np.sum(env.env_method("get_episode_rewards")) / case.n_timesteps)


def dependence(scores: Floats) -> tuple[float, float, float]:
    """Correlation at lag 1, the factor on the variance of a mean of ten, and its standard error."""
    centred = scores - scores.mean()
    lagged = np.array([(centred[lag:] * centred[:-lag]).mean() for lag in LAGS]) / centred.var()
    error = float(np.sqrt((WEIGHTS**2).sum() / len(scores)))
    return float(lagged[0]), float(1 + (WEIGHTS * lagged).sum()), error


def main() -> None:
    """Print a line for each case and each way of spacing seeds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--networks", action="store_true", help="networks instead of tables")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count(), metavar="N", help="runs at once"
    )
    args = parser.parse_args()
    cases: Sequence[Case] = NETWORKS if args.networks else TABLES
    print(
        f"{'agent':10} {'environment':18} {'envs':>4} {'seeds':>13} {'mean':>8} {'sd':>7} "
        f"{'lag 1':>7} {'variance of a mean of ten':>27}"
    )
    with ProcessPoolExecutor(args.jobs) as pool:
        for step in (1, APART):
            for case in cases:
                seeds = range(10_000, 10_000 + step * case.n_seeds, step)
                scores = np.array(list(pool.map(partial(final_return, case), seeds, chunksize=8)))
                first, factor, error = dependence(scores)
                print(
                    f"{case.algo:10} {case.env_id:18} {case.n_envs:4} "
                    f"{case.n_seeds:6,} by {step:3} "
                    f"{scores.mean():8.3f} {scores.std():7.3f} {first:7.3f} "
                    f"{factor:14.2f} +- {error:.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
