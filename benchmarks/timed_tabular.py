"""Tabular training, compared with loops written by hand; steps a second.

Our agents train in ``learn()``, with Monitor's CSV and a callback that reads the table twenty
times. The plain loops are in Python with Gymnasium, in Python without it, and in Numba on arrays;
they have no Monitor, callbacks, visit counts and schedules.
"""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numba
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon, calls_until_multiple
from rl_yardstick.agents.tabular.q_learning_and_sarsa import QLearning
from rl_yardstick.envs.known_models import time_limit, transition_model
from rl_yardstick.envs.warehouse import DEFAULT_MAP
from rl_yardstick.envs.wrappers import DiscretizeObservation
from timing import Benchmark, Contender, Rows, speed

EPSILON, STEP_SIZE, GAMMA = 0.1, 0.1, 0.99
COMPILED_STEPS = 3_000_000
PYTHON_STEPS = 40_000
BINS = partial(
    DiscretizeObservation,
    bins=50,
    low=[-0.41887903, -0.87266463],
    high=[0.41887903, 0.87266463],
    dims=[2, 3],
)
WRAPPERS: dict[str, Any] = {"CartPole-v1": BINS}
ENVS = ("FrozenLake-v1", "envs:Warehouse-v0", "CartPole-v1")
LARGE = ("envs:RandomWarehouse-v0", {"size": 100})


class Evaluation(BlockCallback):
    """Reads the table at regular steps, as an evaluation does."""

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


def agent(name: str, engine: str, env_id: str, folder: Path, **env_kwargs: Any) -> Any:
    """An agent after its first training, which compiles its code and has the longest episodes."""
    env = make_vec_env(
        env_id,
        seed=0,
        monitor_dir=tempfile.mkdtemp(dir=folder),
        wrapper_class=WRAPPERS.get(env_id),
        env_kwargs=env_kwargs,
    )
    algorithm: Any = load_algorithm(name)
    made = algorithm(
        env=env,
        seed=0,
        learning_rate=STEP_SIZE,
        gamma=GAMMA,
        exploration_initial_eps=EPSILON,
        exploration_decay="constant",
        engine=engine,
    )
    return made.learn(PYTHON_STEPS)


def ours(name: str, engine: str, env_id: str, folder: Path, log: int | None = None) -> Contender:
    """A training as in `train.py`, without the library's log if ``log`` is None."""
    n_steps = COMPILED_STEPS if engine == "compiled" else PYTHON_STEPS
    trained = agent(name, engine, env_id, folder)
    learn = partial(trained.learn, n_steps, log_interval=log)
    return speed(lambda: learn(callback=Evaluation(n_steps // 20)), n_steps)


def loop_over_gymnasium(env_id: str) -> None:
    """Q-learning as written by hand, one step at a time."""
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


def loop_without_gymnasium(
    make_table: Callable[[], Any], argmax: Callable[[Any], int], highest: Callable[[Any], float]
) -> None:
    """The same for the warehouse only; the table is indexed by row, column and action."""
    table, grid = make_table(), [list(row) for row in DEFAULT_MAP]
    moves = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    row, column, elapsed = 9, 0, 0
    for _ in range(PYTHON_STEPS):
        values = table[row][column]
        exploring = random.random() < EPSILON  # noqa: S311
        action = random.randrange(4) if exploring else argmax(values)  # noqa: S311
        next_row, next_column = row + moves[action][0], column + moves[action][1]
        inside = 0 <= next_row < len(grid) and 0 <= next_column < len(grid[0])
        reward = -100 if inside and grid[next_row][next_column] == "#" else -1
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


@numba.njit
def numba_loop(
    cumulative: Any, nexts: Any, rewards: Any, ends: Any, limit: int, table: Any, n_steps: int
) -> None:
    """Q-learning on arrays of shape (S, A, K), from the first state; first of equal actions."""
    state, elapsed, n_actions = 0, 0, table.shape[1]
    for _ in range(n_steps):
        action = 0
        if np.random.random() < EPSILON:  # noqa: NPY002
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
        following, done = nexts[state, action, k], ends[state, action, k]
        best = 0.0 if done else table[following].max()
        target = rewards[state, action, k] + GAMMA * best
        table[state, action] += STEP_SIZE * (target - table[state, action])
        elapsed += 1
        state = following
        if done or elapsed == limit:
            state, elapsed = 0, 0


def loop_in_numba(env_id: str, **env_kwargs: Any) -> Contender:
    """The compiled plain loop on an environment's model, from its start state."""
    env = gym.make(env_id, **env_kwargs)
    model, limit = transition_model(env), time_limit(env) or 0
    assert model is not None
    start = int(np.flatnonzero(model.initial)[0])
    order = np.r_[start, np.delete(np.arange(model.n_states), start)]
    place = np.argsort(order)
    arrays = (
        np.cumsum(model.prob, axis=2)[order],
        place[model.next_state][order],
        model.reward[order],
        model.terminated[order],
    )
    table = np.zeros((model.n_states, model.n_actions))
    numba_loop(*arrays, limit, table, 10)
    return speed(lambda: numba_loop(*arrays, limit, table, COMPILED_STEPS), COMPILED_STEPS)


class Actions(BaseCallback):
    """Records the actions of every step."""

    def __init__(self) -> None:
        super().__init__()
        self.taken: list[Any] = []

    def _on_step(self) -> bool:
        self.taken.append(self.locals["actions"].copy())
        return True


class Replay(QLearning):
    """Takes recorded actions and learns nothing."""

    recorded: Iterator[Any]

    def _choose_actions(self) -> Any:
        return next(self.recorded)

    def _learn_from(self, transitions: Any) -> None:
        pass


def replays(env_id: str, folder: Path) -> dict[str, Contender]:
    """Episodes without an agent: environment steps alone, and with the training loop."""
    trained, actions = agent("qlearning", "interpreted", env_id, folder), Actions()
    env = trained.env
    env.seed(0)
    trained.learn(PYTHON_STEPS, callback=actions)
    replay = Replay(env=env)

    def steps() -> None:
        env.seed(0)
        env.reset()
        for action in actions.taken:
            env.step(action)

    def loop() -> None:
        env.seed(0)
        replay.recorded = iter(actions.taken)
        replay.learn(PYTHON_STEPS, callback=Evaluation(PYTHON_STEPS // 20), log_interval=None)

    return {
        "DummyVecEnv and Monitor alone": speed(steps, PYTHON_STEPS),
        "training loop, no agent": speed(loop, PYTHON_STEPS),
    }


def rows(folder: Path) -> Rows:
    """Compiled agents beside plain loops, interpreted agents beside the environment alone."""
    made: Rows = {}
    for env_id in ENVS:
        name = env_id.removeprefix("envs:")
        made[name] = {
            "loop over gym.make": speed(partial(loop_over_gymnasium, env_id), PYTHON_STEPS),
            "Q-learning": ours("qlearning", "compiled", env_id, folder),
            "SARSA": ours("sarsa", "compiled", env_id, folder),
            "Q-learning, logged": ours("qlearning", "compiled", env_id, folder, log=100),
        }
        made[f"{name}, interpreted"] = {
            **replays(env_id, folder),
            "Q-learning": ours("qlearning", "interpreted", env_id, folder),
            "SARSA": ours("sarsa", "interpreted", env_id, folder),
        }
    q_learning = made["Warehouse-v0"]["Q-learning"]
    ways: dict[str, tuple[Any, ...]] = {  # lists are the fastest in plain Python here
        "NumPy": (lambda: np.zeros((10, 10, 4)), lambda q: int(np.argmax(q)), np.max),
        "lists": (lambda: np.zeros((10, 10, 4)).tolist(), lambda q: q.index(max(q)), max),
    }
    for name, way in ways.items():
        plain = speed(partial(loop_without_gymnasium, *way), PYTHON_STEPS)
        made[f"Warehouse-v0, by {name} alone"] = {"plain loop": plain, "Q-learning": q_learning}
    for env_id in ENVS[:2]:
        name = env_id.removeprefix("envs:")
        made[f"{name}, by Numba"] = {
            "plain loop": loop_in_numba(env_id),
            "Q-learning": made[name]["Q-learning"],
        }
    large = agent("qlearning", "compiled", LARGE[0], folder, **LARGE[1])
    made["RandomWarehouse-v0, 100 x 100, by Numba"] = {
        "plain loop": loop_in_numba(LARGE[0], **LARGE[1]),
        "Q-learning": speed(lambda: large.learn(COMPILED_STEPS, log_interval=None), COMPILED_STEPS),
    }
    return made


BENCHMARK = Benchmark("steps a second", rounds=5, rows=rows)
