"""Between which returns the optimum lies where states are continuous, for `envs/brackets`.

    python benchmarks/optimum_brackets.py                       # a quarter of an hour
    python benchmarks/optimum_brackets.py --only Pendulum-v1
    python benchmarks/optimum_brackets.py --quick               # a few seconds each; writes nothing

The lower end is what a policy was seen to get in Gymnasium's environment: the mean return of its
episodes, less what chance may have added to it at a confidence of 99.9 %. The upper end no policy
exceeds. Both are means over the environment's own starts, under its own time limit.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
from _bracket_policies import blind_policies, policy_of, returns_of
from _double_pendulum import ENERGY_OF_BEING_UP, fewest_steps, greatest_energies
from _pushed_motion import (
    COST_FREE_RETURN,
    MOTIONS,
    STARTS,
    cells_of,
    mean_cost,
    optimistic_costs,
)

from envs.brackets import DATA, constants_of
from mdp.array_types import Floats
from verdicts.resampling import least_mean

LEVEL = 0.001
SEED = 0
BLIND_EPISODES, FEW_EPISODES, KEPT_RETURNS = 2000, 100, 5
DIGITS = 3  # after the point, rounded outward


@dataclass(frozen=True)
class Task:
    """How an environment's bracket is found.

    Attributes:
        n_episodes: of the policy that makes the lower end.
        returns: the least and the greatest that an episode can return.
        policy: what makes the lower end.
        bound: what makes the upper end.
        cells: positions and speeds that states are cut into; None where there are no cells.
        quick_cells: likewise, in a few seconds.
    """

    n_episodes: int
    returns: tuple[float, float]
    policy: str
    bound: str
    cells: tuple[int, int] | None = None
    quick_cells: tuple[int, int] | None = None


BY_CELLS = "no cost of a path over cells, each step of which may lead anywhere in the next cell"
TASKS = {
    "CartPole-v1": Task(
        20_000, (0.0, 500.0), "a weighted sum of what is observed", "a reward of 1 in each step"
    ),
    "MountainCar-v0": Task(
        20_000, (-200.0, 0.0), "planned on a grid", BY_CELLS, (8000, 8001), (500, 501)
    ),
    "MountainCarContinuous-v0": Task(
        10_000, (-99.9, 100.0), "planned on a grid", BY_CELLS, (2000, 2001), (500, 501)
    ),
    # A step costs 3.1416 squared, 0.1 times 8 squared, and 0.001 times 2 squared at most.
    "Pendulum-v1": Task(
        50_000, (-200 * 16.2737, 0.0), "planned on a grid", BY_CELLS, (4000, 4000), (500, 512)
    ),
    "Acrobot-v1": Task(
        10_000,
        (-500.0, 0.0),
        "a beam search from the first state",
        "the most energy that torques bring within 8 steps, sought on a grid of states with 5 % "
        "added: not proven",
    ),
}
# Acrobot's upper end: energies, steps, and angles on the grid. What the grid may miss is added.
N_LEVELS, ENERGY_STEPS, QUICK_STEPS, N_ANGLES, MISSED = 16, 8, 5, 32, 0.05
# All angles and speeds at 0.1, their bound.
MOST_START_ENERGY = 0.2174


def upper_end(env_id: str, *, quick: bool) -> float:
    """A return that no policy exceeds."""
    task = TASKS[env_id]
    if env_id == "Acrobot-v1":
        return energy_bound(QUICK_STEPS if quick else ENERGY_STEPS)
    cells = task.quick_cells if quick else task.cells
    if cells is None:
        return task.returns[1]
    motion = MOTIONS[env_id]
    grid = cells_of(motion, *cells)
    cost = mean_cost(motion, grid, optimistic_costs(motion, grid), *STARTS[env_id])
    return COST_FREE_RETURN[env_id] - cost


def energy_bound(n_steps: int) -> float:
    """Acrobot: as many steps as energy takes to rise; the last of them costs nothing."""
    levels = ENERGY_OF_BEING_UP * (np.arange(N_LEVELS + 1) / N_LEVELS) ** 2
    greatest = np.array([greatest_energies(level, n_steps, N_ANGLES) for level in levels])
    greatest += MISSED * (greatest - levels[:, None])
    return 1.0 - fewest_steps(levels, greatest, MOST_START_ENERGY, ENERGY_OF_BEING_UP)


def baseline(env_id: str, n_episodes: int) -> dict[str, Any]:
    """The best of random and constant actions, by episodes that the choice has not seen."""
    policies = blind_policies(env_id, SEED)
    few = {
        name: returns_of(env_id, policy, FEW_EPISODES, SEED).mean()
        for name, policy in policies.items()
    }
    best = max(few, key=few.__getitem__)
    returns = returns_of(env_id, policies[best], n_episodes, SEED + 1)
    error = returns.std(ddof=1) / math.sqrt(n_episodes)
    return {
        "mean": round(float(returns.mean()), DIGITS),
        "standard_error": round(float(error), DIGITS),
        "policy": best,
        "episodes": n_episodes,
    }


def bracket(env_id: str, *, quick: bool) -> dict[str, Any]:
    """All that is stored of an environment."""
    task, started = TASKS[env_id], time.process_time()
    n_episodes = FEW_EPISODES if quick else task.n_episodes
    returns = returns_of(env_id, policy_of(env_id), n_episodes, SEED)
    env = gym.make(env_id)
    assert env.spec is not None
    return {
        "id": env_id,
        "lower": _rounded(least_mean(returns, *task.returns, LEVEL), math.floor),
        "upper": _rounded(upper_end(env_id, quick=quick), math.ceil),
        "baseline": baseline(env_id, FEW_EPISODES if quick else BLIND_EPISODES),
        "played": _summary(returns),
        "how": {"lower": task.policy, "upper": task.bound, "cells": task.cells},
        "script": f"benchmarks/{Path(__file__).name}",
        "class": f"{type(env.unwrapped).__module__}:{type(env.unwrapped).__qualname__}",
        "time_limit": env.spec.max_episode_steps,
        "constants": constants_of(env.unwrapped),
        "versions": {name: importlib.metadata.version(name) for name in ("gymnasium", "numpy")},
        "processor_seconds": round(time.process_time() - started),
    }


def _rounded(value: float, outward: Any) -> float:
    return float(outward(value * 10**DIGITS) / 10**DIGITS)


def _summary(returns: Floats) -> dict[str, Any]:
    return {
        "mean": round(float(returns.mean()), DIGITS),
        "std": round(float(returns.std()), DIGITS),
        "least": round(float(returns.min()), DIGITS),
        "greatest": round(float(returns.max()), DIGITS),
        "episodes": len(returns),
        "seed": SEED,
        "level": LEVEL,
        "first_returns": np.round(returns[:KEPT_RETURNS], 6).tolist(),
    }


def write(path: Path, found: dict[str, Any]) -> None:
    """Put brackets into the file in the place of former ones."""
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    text = json.dumps({**known, **found}, indent=2, sort_keys=True)
    path.write_text(f"{text}\n", encoding="utf-8")


def main() -> None:
    """Print a line for each environment, and write the brackets down."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=TASKS, help="this environment alone")
    parser.add_argument("--quick", action="store_true", help="small grids and few episodes")
    request = parser.parse_args()
    for env_id in [request.only] if request.only else TASKS:
        found = bracket(env_id, quick=request.quick)
        print(
            f"{env_id:25} {found['lower']:10.3f} to {found['upper']:9.3f}, baseline "
            f"{found['baseline']['mean']:9.3f} ({found['baseline']['policy']}), "
            f"{found['processor_seconds']} s"
        )
        if not request.quick:
            write(DATA, {env_id: found})


if __name__ == "__main__":
    main()
