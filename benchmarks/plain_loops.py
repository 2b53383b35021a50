"""Tabular training beside a plain Numba loop without any bookkeeping, in steps a second.

    python benchmarks/plain_loops.py                  # five rounds: half a minute
    python benchmarks/plain_loops.py --repeats 11

The plain loop is Q-learning over arrays as one writes it by hand for Numba: epsilon falls as the
default settings say, ties go to the first action, and where nothing is random nothing is drawn.
Ours is `QLearning(env).learn(n)` with its defaults, on an environment from `make_vec_env` with
Monitor writing its CSV. Both begin with an untrained table in every round, one after the other; the
clock is the process's own. Ratios are medians over the rounds.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numba
import numpy as np
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the environments
from agents.tabular.one_step import QLearning
from envs.known_models import time_limit, transition_model
from mdp import TransitionModel

STEP_SIZE, GAMMA = 0.1, 0.99
FIRST_EPSILON, LAST_EPSILON, FALLS_OVER = 1.0, 0.05, 0.5
N_STEPS = 3_000_000
PYTHON_STEPS = 60_000
LIMIT = 0.5

ENVS: dict[str, tuple[str, dict[str, Any]]] = {
    "FrozenLake-v1": ("FrozenLake-v1", {}),
    "Warehouse-v0": ("Warehouse-v0", {}),
    "RandomWarehouse-v0, 100 x 100": ("RandomWarehouse-v0", {"size": 100}),
    "RandomWarehouse-v0, 1000 x 1000": ("RandomWarehouse-v0", {"size": 1000}),
}


@numba.njit
def plain_loop(
    cumulative: Any,
    next_states: Any,
    rewards: Any,
    ends: Any,
    start: int,
    limit: int,
    table: Any,
    n_steps: int,
) -> None:
    """Q-learning over arrays of shape (S, A, K)."""
    state, elapsed, n_actions = start, 0, table.shape[1]
    for t in range(n_steps):
        fallen = (FIRST_EPSILON - LAST_EPSILON) * t / (FALLS_OVER * n_steps)
        action = 0
        if np.random.random() < max(LAST_EPSILON, FIRST_EPSILON - fallen):  # noqa: NPY002
            action = np.random.randint(n_actions)  # noqa: NPY002
        else:
            for other in range(1, n_actions):
                if table[state, other] > table[state, action]:
                    action = other
        k = 0
        if cumulative.shape[2] > 1:
            drawn = np.random.random()  # noqa: NPY002
            while k < cumulative.shape[2] - 1 and cumulative[state, action, k] <= drawn:
                k += 1
        next_state, done = next_states[state, action, k], ends[state, action, k]
        best = 0.0
        if not done:
            best = table[next_state, 0]
            for other in range(1, n_actions):
                best = max(best, table[next_state, other])
        target = rewards[state, action, k] + GAMMA * best
        table[state, action] += STEP_SIZE * (target - table[state, action])
        elapsed += 1
        state = next_state
        if done or elapsed == limit:
            state, elapsed = start, 0


def python_loop(env_id: str) -> float:
    """Steps a second of Q-learning as it is written by hand over Gymnasium, with NumPy."""
    env: Any = gym.make(env_id)
    rng = np.random.default_rng(0)
    table = np.zeros((env.observation_space.n, env.action_space.n))
    state, _ = env.reset(seed=0)
    started = time.process_time()
    for t in range(PYTHON_STEPS):
        fallen = (FIRST_EPSILON - LAST_EPSILON) * t / (FALLS_OVER * PYTHON_STEPS)
        if rng.random() < max(LAST_EPSILON, FIRST_EPSILON - fallen):
            action = int(env.action_space.sample())
        else:
            action = int(np.argmax(table[state]))
        next_state, reward, terminated, truncated, _ = env.step(action)
        best = 0.0 if terminated else np.max(table[next_state])
        table[state, action] += STEP_SIZE * (reward + GAMMA * best - table[state, action])
        state = next_state
        if terminated or truncated:
            state, _ = env.reset()
    return PYTHON_STEPS / (time.process_time() - started)


def plain_speed(model: TransitionModel, limit: int) -> float:
    """Steps a second of the plain loop."""
    table = np.zeros((model.n_states, model.n_actions))
    arrays = (np.cumsum(model.prob, axis=2), model.next_state, model.reward, model.terminated)
    start = int(np.flatnonzero(model.initial)[0])
    plain_loop(*arrays, start, limit, table, 10)
    table[:] = 0.0
    started = time.process_time()
    plain_loop(*arrays, start, limit, table, N_STEPS)
    return N_STEPS / (time.process_time() - started)


def our_speed(vec_env: Any, seed: int) -> float:
    """Steps a second of `learn` by a new agent."""
    agent = QLearning(env=vec_env, seed=seed)
    started = time.process_time()
    agent.learn(N_STEPS)
    return N_STEPS / (time.process_time() - started)


def compare(name: str, repeats: int, folder: str) -> list[str]:
    """A row of the table."""
    env_id, kwargs = ENVS[name]
    env = gym.make(env_id, **kwargs)
    model, limit = transition_model(env), time_limit(env) or 0
    assert model is not None
    own = tempfile.mkdtemp(dir=folder)
    vec_env = make_vec_env(env_id, seed=0, env_kwargs=kwargs, monitor_dir=own)
    first = QLearning(env=vec_env, seed=0)
    started = time.process_time()
    first.learn(1000)
    first_seconds = time.process_time() - started
    rounds = [(plain_speed(model, limit), our_speed(vec_env, i)) for i in range(repeats)]
    plain, ours = (statistics.median(speeds) for speeds in zip(*rounds, strict=True))
    ratio = statistics.median(mine / its for its, mine in rounds)
    verdict = "yes" if ratio >= LIMIT else "no"
    row = [name, f"{plain / 1e6:.1f}", f"{LIMIT * plain / 1e6:.1f}", f"{ours / 1e6:.1f}"]
    return [*row, f"{ratio:.2f}", verdict, f"{first_seconds:.2f}"]


def main() -> None:
    """Time everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--repeats", type=int, default=5, metavar="N", help="rounds (default 5)")
    args = parser.parse_args()
    headings = ("plain loop, M/s", "limit", "ours, M/s", "ratio", "met", "first learn(1000), s")
    table = Table("environment", *headings)
    print(f"load before: {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        for name in ENVS:
            table.add_row(*compare(name, args.repeats, folder))
        lake = make_vec_env("FrozenLake-v1", seed=0, monitor_dir=folder)
        pairs = [(python_loop("FrozenLake-v1"), our_speed(lake, i)) for i in range(args.repeats)]
    Console(width=120).print(table)
    times = statistics.median(ours / python for python, ours in pairs)
    print(f"FrozenLake-v1: {times:.0f} times the loop in Python over gym.make")


if __name__ == "__main__":
    main()
