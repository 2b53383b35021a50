"""Common code of the figures: agents with the book's settings, plots, statements."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.env_util import make_vec_env

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import EpisodeBudget
from rl_yardstick.mdp.transition_model import Floats

mpl.use("Agg")

IMAGES = Path(__file__).resolve().parent.parent / "images" / "textbook"
MOST_STEPS = 10**9  # no limit, because episodes are counted


class Statement(NamedTuple):
    """A statement of the book, and whether our measurement confirms it."""

    text: str  # the statement in our words
    figures: str  # the measured figures
    holds: bool


# From a number of runs, or of episodes, to a figure and the book's statements on it.
Draw = Callable[[int], tuple[Figure, Sequence[Statement]]]


def agent_on(
    env_id: str | Callable[[], gym.Env[Any, Any]], algo: str, seed: int, **settings: Any
) -> Any:
    """Make an agent with the book's settings: no discount, constant epsilon, random ties."""
    env = make_vec_env(env_id, seed=seed, env_kwargs=settings.pop("env_kwargs", None))
    always = {"gamma": 1.0, "exploration_decay": "constant", "exploration_initial_eps": 0.1}
    return load_algorithm(algo)(env=env, seed=seed, **{**always, **settings})


def learn_episodes(agent: Any, n_episodes: int) -> tuple[Floats, Floats]:
    """Train for ``n_episodes``, by which schedules run too; returns their returns and lengths."""
    agent.learn(MOST_STEPS, callback=EpisodeBudget(n_episodes), log_interval=None)
    monitor = agent.env.envs[0]
    returns, lengths = monitor.get_episode_rewards(), monitor.get_episode_lengths()
    return np.array(returns[:n_episodes], dtype=float), np.array(lengths[:n_episodes], dtype=float)


def canvas(title: str, x: str, y: str) -> tuple[Figure, Any]:
    """Make an empty plot with title and axis labels."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)
    return figure, axes


def main(description: str | None, figures: Mapping[str, tuple[Draw, int]]) -> None:
    """Draw the figures that are named; exit with 1 if a statement of the book fails.

    Args:
        description: the docstring of the script.
        figures: by number in the book, what draws the figure, and the number of runs.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help=", ".join(figures))
    parser.add_argument("--runs", type=int, help="seeds 0 to RUNS - 1, or episodes")
    parser.add_argument("--folder", type=Path, default=IMAGES, help="where the pictures go")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    console, hold = Console(), True
    for number in args.figures or figures:
        draw, n_runs = figures[number]
        figure, statements = draw(args.runs or n_runs)
        path = args.folder / f"figure_{number.replace('.', '_')}.png"
        figure.savefig(path, dpi=110)
        table = Table("the book says", "measured", "holds")
        for each in statements:
            table.add_row(each.text, each.figures, "yes" if each.holds else "no")
        console.print(table)
        console.print(f"picture: {path}")
        hold &= all(each.holds for each in statements)
    if not hold:
        raise SystemExit(1)
