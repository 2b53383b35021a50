"""What the figures share: agents with a book's settings, drawings, and the book's statements."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.env_util import make_vec_env

from agents import load_algorithm
from agents.common.callbacks import BlockCallback, EpisodeBudget, Horizon
from mdp.array_types import Bools, Floats

mpl.use("Agg")

IMAGES = Path(__file__).resolve().parent.parent / "images" / "textbook"
MOST_STEPS = 10**9  # where episodes are counted


@dataclass(frozen=True)
class Statement:
    """Something that the book says, and whether it came out.

    Attributes:
        text: what it says, in our words.
        figures: what was measured.
        holds: whether that agrees.
    """

    text: str
    figures: str
    holds: bool


class ValueErrors(BlockCallback):
    """The root mean square error of predicted values after each episode, over the states given.

    Args:
        true_values: of all observations, shape (S,).
        counted: which observations count, bool of shape (S,).
    """

    def __init__(self, true_values: Floats, counted: Bools) -> None:
        super().__init__()
        self.true_values, self.counted = true_values[counted], counted
        self.errors: list[float] = []
        self._has_ended = False

    def horizon(self) -> Horizon:
        return Horizon(episodes=1)

    def _on_step(self) -> bool:
        self._has_ended = bool(self.locals["dones"].any())
        return True

    def _on_rollout_end(self) -> None:  # what the last step says has been learnt by now
        if self._has_ended:
            policy: Any = self.model.policy
            differences = policy.q_table[self.counted, 0] - self.true_values
            self.errors.append(float(np.sqrt(np.mean(differences**2))))


def arguments(description: str, n_runs: int) -> argparse.Namespace:
    """How many runs to average over, and where the picture goes."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=n_runs, help="seeds 0 to RUNS - 1")
    parser.add_argument("--folder", type=Path, default=IMAGES, help="where the picture goes")
    return parser.parse_args()


def agent_on(
    env_id: str | Callable[[], gym.Env[Any, Any]], algo: str, seed: int, **settings: Any
) -> Any:
    """An agent as the book has them: no discount, a constant epsilon, ties broken at random."""
    env = make_vec_env(env_id, seed=seed, env_kwargs=settings.pop("env_kwargs", None))
    always = {"gamma": 1.0, "exploration_decay": "constant", "exploration_initial_eps": 0.1}
    return load_algorithm(algo)(env=env, seed=seed, **{**always, **settings})


def learn_episodes(agent: Any, n_episodes: int) -> tuple[Floats, Floats]:
    """Train for so many episodes, by which schedules run too.

    Returns:
        Their returns and their lengths, shapes (n_episodes,).
    """
    agent.learn(MOST_STEPS, callback=EpisodeBudget(n_episodes), log_interval=None)
    monitor = agent.env.envs[0]
    returns, lengths = monitor.get_episode_rewards(), monitor.get_episode_lengths()
    return np.array(returns[:n_episodes], dtype=float), np.array(lengths[:n_episodes], dtype=float)


def mean_and_error(values: Floats, axis: int = 0) -> tuple[Floats, Floats]:
    """Means over runs, and their standard errors."""
    n = values.shape[axis]
    return values.mean(axis=axis), values.std(axis=axis, ddof=1) / np.sqrt(n)


def canvas(title: str, x: str, y: str) -> tuple[Figure, Any]:
    """An empty picture with its words."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)
    return figure, axes


def finish(name: str, figure: Figure, folder: Path, statements: Sequence[Statement]) -> None:
    """Save the picture, and print what the book says beside what was measured.

    Raises:
        SystemExit: with 1 if a statement does not hold.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    figure.savefig(path, dpi=110)
    table = Table("the book says", "measured", "holds")
    for each in statements:
        table.add_row(each.text, each.figures, "yes" if each.holds else "no")
    console = Console()
    console.print(table)
    console.print(f"picture: {path}")
    if not all(each.holds for each in statements):
        raise SystemExit(1)
