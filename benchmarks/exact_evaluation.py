"""Exact against sampled evaluation: what each costs, and how sure one can be of it.

    python benchmarks/exact_evaluation.py

A Q-learning agent that explores with probability 0.1 is evaluated on Warehouse-v0 and on
FrozenLake-v1, exactly and by episodes. From the exact variance of an episode's return follows how
many episodes give a mean whose standard error is 1 % of the range between the baseline and the
optimum. Times are medians, of the process alone (`time.process_time`), everything compiled.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from pipeline.environments import make_evaluation_env, make_training_env
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.sampled import evaluate
from pipeline.evaluation.yardstick import Yardstick
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec

EPISODES = 100
TRAINING_STEPS = 200_000
# Standard error that is asked for, as a share of the range from baseline to optimal.
PRECISION = 0.01
ENVS = ("Warehouse-v0", "FrozenLake-v1")


def seconds(work: Callable[[], object], repeats: int) -> float:
    """The median time of ``work``, after a first time that does not count."""
    times = []
    work()
    for _ in range(repeats):
        started = time.process_time()
        work()
        times.append(time.process_time() - started)
    return statistics.median(times)


def episodes_needed(std: float, yardstick: Yardstick) -> int:
    """Episodes whose mean return has the standard error that is asked for."""
    return math.ceil((std / (PRECISION * (yardstick.optimum - yardstick.baseline))) ** 2)


def measure(env_id: str, deterministic: bool) -> dict[str, Any]:
    """Times and figures of both evaluations on one environment."""
    from agents import load_algorithm

    entry = {"n_timesteps": TRAINING_STEPS}
    spec = TrainSpec("qlearning", env_id, split(entry), entry, seed=0)
    evaluator = exact_evaluator(spec)
    assert evaluator is not None
    algorithm: Any = load_algorithm("qlearning")
    agent = algorithm(env=make_training_env(spec, None), seed=0, exploration_final_eps=0.1).learn(
        TRAINING_STEPS
    )
    env = make_evaluation_env(spec, 1)
    sample = partial(evaluate, agent, env, EPISODES, 0, deterministic)
    exact = evaluator(agent, deterministic)
    return {
        "exact": exact.mean_return,
        "std": exact.std_return,
        "sampled": sample().mean_return,
        "exact seconds": seconds(partial(evaluator, agent, deterministic), 25),
        "sampled seconds": seconds(sample, 5),
        "episodes": episodes_needed(exact.std_return, evaluator.yardstick),
    }


def main() -> None:
    """Print a line for each environment and way of acting."""
    print(
        f"{'environment':14} {'acting':10} {'exact return':>13} {'its time':>10} "
        f"{f'mean of {EPISODES}':>12} {'its time':>10} {'ratio':>7} {'episodes for 1 %':>17}"
    )
    for env_id in ENVS:
        for deterministic in (True, False):
            row = measure(env_id, deterministic)
            exact_ms, sampled_ms = 1e3 * row["exact seconds"], 1e3 * row["sampled seconds"]
            print(
                f"{env_id:14} {'greedy' if deterministic else 'exploring':10} "
                f"{row['exact']:13.4f} {exact_ms:7.2f} ms {row['sampled']:12.4f} "
                f"{sampled_ms:7.0f} ms {sampled_ms / exact_ms:6.0f}x {row['episodes']:17,}"
            )


if __name__ == "__main__":
    main()
