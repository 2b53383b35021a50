"""Speed of tabular training, in environment steps a second of processor time.

    python benchmarks/tabular_speed.py                  # everything, five times: about two minutes
    python benchmarks/tabular_speed.py --repeats 1

Each contender is timed once in every round, so that a machine whose speed changes slows all of them
down alike; reported are medians over the rounds. The training runs inside `learn()`, with Monitor
writing its CSV files and a callback that evaluates at regular steps. The plain loops are what one
writes by hand in Python. The clock is that of the process (`time.process_time`): what other
programs do on the same machine counts as little as it can.
"""

from __future__ import annotations

import argparse
import os
import random
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from agents import load_algorithm
from agents.common.callbacks import BlockCallback, Horizon, calls_until_multiple
from agents.tabular.one_step import QLearning
from envs.warehouse import DEFAULT_MAP
from envs.wrappers import DiscretizeObservation

EPSILON, STEP_SIZE, GAMMA = 0.1, 0.1, 0.99
ANGLE, VELOCITY, BINS = 0.41887903, 0.87266463, 50
COMPILED_STEPS = 3_000_000
PYTHON_STEPS = 40_000

discretize = partial(
    DiscretizeObservation,
    bins=BINS,
    low=[-ANGLE, -VELOCITY],
    high=[ANGLE, VELOCITY],
    dims=[2, 3],
)
WRAPPERS: dict[str, Any] = {"CartPole-v1": discretize}
ALONE, LOOP = "DummyVecEnv + Monitor alone", "training loop without an agent"
ENVS = ("FrozenLake-v1", "envs:Warehouse-v0", "CartPole-v1")

# Steps a second of one timing.
Contender = Callable[[], float]


class Evaluation(BlockCallback):
    """Looks at the table at regular steps, as an evaluation does."""

    def __init__(self, every_n_calls: int) -> None:
        super().__init__()
        self.every_n_calls = every_n_calls
        self.values: list[float] = []

    def horizon(self) -> Horizon:
        return Horizon(calls=calls_until_multiple(self.n_calls, self.every_n_calls))

    def _on_step(self) -> bool:
        if self.n_calls % self.every_n_calls == 0:
            policy: Any = self.model.policy
            self.values.append(float(policy.q_table.max()))
        return True


class ActionRecorder(BaseCallback):
    """Keeps the actions of every step."""

    def __init__(self) -> None:
        super().__init__()
        self.actions: list[Any] = []

    def _on_step(self) -> bool:
        self.actions.append(self.locals["actions"].copy())
        return True


def practised(engine: str, name: str, env_id: str, folder: str) -> Any:
    """An agent that has been compiled, and has the first clumsy episodes behind it."""
    own = tempfile.mkdtemp(dir=folder)
    wrapper = WRAPPERS.get(env_id)
    env = make_vec_env(env_id, seed=0, monitor_dir=own, wrapper_class=wrapper)
    algorithm: Any = load_algorithm(name)
    agent = algorithm(
        env=env,
        seed=0,
        learning_rate=STEP_SIZE,
        gamma=GAMMA,
        exploration_initial_eps=EPSILON,
        exploration_decay="constant",
        engine=engine,
    )
    return agent.learn(PYTHON_STEPS)


def trained(
    engine: str, name: str, env_id: str, folder: str, log_interval: int | None = None
) -> Contender:
    """Training as `train.py` starts it, which by default writes no log of the library's."""
    n_steps = COMPILED_STEPS if engine == "compiled" else PYTHON_STEPS
    agent = practised(engine, name, env_id, folder)

    def learn() -> None:
        agent.learn(n_steps, callback=Evaluation(n_steps // 20), log_interval=log_interval)

    return timed(learn, n_steps)


def timed(work: Callable[[], object], n_steps: int) -> Contender:
    """A contender that does ``work`` of ``n_steps``."""

    def measure() -> float:
        started = time.process_time()
        work()
        return n_steps / (time.process_time() - started)

    return measure


def plain_loop(env_id: str) -> None:
    """Q-learning as it is written by hand over Gymnasium, one step at a time."""
    env: Any = gym.make(env_id)
    if env_id in WRAPPERS:
        env = WRAPPERS[env_id](env)
    table = np.zeros((env.observation_space.n, env.action_space.n))
    state, _ = env.reset(seed=0)
    for _ in range(PYTHON_STEPS):
        if random.random() < EPSILON:  # noqa: S311
            action = env.action_space.sample()
        else:
            action = int(np.argmax(table[state]))
        next_state, reward, terminated, truncated, _ = env.step(action)
        best = 0.0 if terminated else np.max(table[next_state])
        table[state, action] += STEP_SIZE * (reward + GAMMA * best - table[state, action])
        state = next_state
        if terminated or truncated:
            state, _ = env.reset()


def bare_loop(table: Any, argmax: Callable[[Any], int], highest: Callable[[Any], float]) -> None:
    """Q-learning on a list of lists, without Gymnasium.

    Args:
        table: action values, indexed by row, column and action.
        argmax: index of the highest of some values.
        highest: the highest itself.
    """
    grid = [list(row) for row in DEFAULT_MAP]
    moves = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    row, column, elapsed = 9, 0, 0
    for _ in range(PYTHON_STEPS):
        values = table[row][column]
        exploring = random.random() < EPSILON  # noqa: S311
        action = random.randrange(4) if exploring else argmax(values)  # noqa: S311
        next_row, next_column = row + moves[action][0], column + moves[action][1]
        inside = 0 <= next_row < len(grid) and 0 <= next_column < len(grid[0])
        reward = -1
        if inside and grid[next_row][next_column] == "#":
            reward = -100
        if not inside or grid[next_row][next_column] == "#":
            next_row, next_column = row, column
        done = grid[next_row][next_column] == "G"
        if done:
            reward = 100
        best = 0.0 if done else highest(table[next_row][next_column])
        values[action] += STEP_SIZE * (reward + GAMMA * best - values[action])
        row, column, elapsed = next_row, next_column, elapsed + 1
        if done or elapsed == 1000:
            row, column, elapsed = 9, 0, 0


def bare_loop_with_numpy() -> None:
    """The table as a NumPy array, as it is mostly written."""
    bare_loop(np.zeros((10, 10, 4)), lambda values: int(np.argmax(values)), np.max)


def bare_loop_with_lists() -> None:
    """The table as lists, which is the fastest that plain Python does here."""
    table = [[[0.0] * 4 for _ in range(10)] for _ in range(10)]
    bare_loop(table, lambda values: values.index(max(values)), max)


class Replay(QLearning):
    """Takes recorded actions and learns nothing."""

    recorded: Iterator[Any]

    def _choose_actions(self) -> Any:
        return next(self.recorded)

    def _learn_from(self, transitions: Any) -> None:
        pass


def replays(env_id: str, folder: str) -> dict[str, Contender]:
    """An agent's episodes once more without the agent: by `step` alone, and by the training loop.

    The loop's share is the order of events that every algorithm of Stable-Baselines3 keeps:
    callbacks, counters, statistics.
    """
    agent, recorder = practised("interpreted", "qlearning", env_id, folder), ActionRecorder()
    env = agent.env
    env.seed(0)
    agent.learn(PYTHON_STEPS, callback=recorder)
    replay = Replay(env=env)

    def steps() -> None:
        env.seed(0)
        env.reset()
        for action in recorder.actions:
            env.step(action)

    def loop() -> None:
        env.seed(0)
        replay.recorded = iter(recorder.actions)
        replay.learn(PYTHON_STEPS, callback=Evaluation(PYTHON_STEPS // 20), log_interval=None)

    return {ALONE: timed(steps, PYTHON_STEPS), LOOP: timed(loop, PYTHON_STEPS)}


def contenders(folder: str) -> dict[tuple[str, str], Contender]:
    """Everything that is timed, by environment and name."""
    made: dict[tuple[str, str], Contender] = {}
    for env_id in ENVS:
        for name in ("qlearning", "sarsa"):
            for engine in ("compiled", "interpreted"):
                made[env_id, f"{engine} {name}"] = trained(engine, name, env_id, folder)
            made[env_id, f"compiled {name}, log of every 100 episodes"] = trained(
                "compiled", name, env_id, folder, log_interval=100
            )
        made.update({(env_id, work): each for work, each in replays(env_id, folder).items()})
        made[env_id, "plain loop over gym.make"] = timed(partial(plain_loop, env_id), PYTHON_STEPS)
    for work, loop in (("NumPy", bare_loop_with_numpy), ("lists", bare_loop_with_lists)):
        made["envs:Warehouse-v0", f"bare loop on {work}"] = timed(loop, PYTHON_STEPS)
    return made


def report(speeds: dict[tuple[str, str], float]) -> Table:
    """The table of all medians, with the compiled engine's as multiples of each."""
    table = Table("environment", "work", "steps/s", "compiled qlearning is", "compiled sarsa is")
    for (env_id, work), speed in sorted(speeds.items()):
        ratios = [
            f"{speeds[env_id, f'compiled {name}'] / speed:,.1f} x"
            for name in ("qlearning", "sarsa")
        ]
        table.add_row(env_id.removeprefix("envs:"), work, f"{speed:,.0f}", *ratios)
    return table


def overheads(speeds: dict[tuple[str, str], float]) -> list[str]:
    """How much time the training loop and the interpreted agents add to that of environments."""
    lines = []
    for env_id in ENVS:
        alone = speeds[env_id, ALONE]
        for work in (LOOP, "interpreted qlearning", "interpreted sarsa"):
            added = alone / speeds[env_id, work] - 1
            lines.append(f"{env_id.removeprefix('envs:')}: {work} adds {added:.0%}")
    return lines


def main() -> None:
    """Time everything and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5, metavar="N", help="rounds (default 5)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        made = contenders(folder)
        rounds = [{key: measure() for key, measure in made.items()} for _ in range(args.repeats)]
    speeds = {key: statistics.median(each[key] for each in rounds) for key in made}
    Console(width=110).print(report(speeds))
    print("Time that the interpreted engine adds to that of DummyVecEnv and Monitor:")
    print("\n".join(overheads(speeds)))


if __name__ == "__main__":
    main()
