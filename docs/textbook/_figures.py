"""Common code of the figures: agents with the book's settings, random walks, plots, statements."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.callbacks import CallbackList, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import BlockCallback, EpisodeBudget, Horizon
from rl_yardstick.mdp.transition_model import Floats

mpl.use("Agg")

IMAGES = Path(__file__).resolve().parent.parent / "images" / "textbook"
MOST_STEPS = 10**9  # no limit, because episodes are counted
WALK = "envs:RandomWalk-v0"
LARGEST_ERROR = 2.0  # larger errors mean that learning diverges


class Statement(NamedTuple):
    """A statement of the book, and whether our measurement confirms it."""

    text: str  # the statement in our words
    figures: str  # the measured figures
    holds: bool


class ValueErrors(BlockCallback):
    """Root mean square errors of the predicted values of nonterminal states after each episode."""

    def __init__(self, true_values: Floats) -> None:
        super().__init__()
        self.true_values = true_values[1:-1]
        self.errors: list[float] = []
        self._has_ended = False

    def horizon(self) -> Horizon:
        return Horizon(episodes=1)

    def _on_step(self) -> bool:
        self._has_ended = bool(self.locals["dones"].any())
        return True

    def _on_rollout_end(self) -> None:  # by now, the agent has learnt from the last step
        if self._has_ended:
            policy: Any = self.model.policy
            differences = policy.q_table[1:-1, 0] - self.true_values
            self.errors.append(float(np.sqrt(np.mean(differences**2))))


def arguments(description: str, n_runs: int) -> argparse.Namespace:
    """Parse the number of runs to average, and the folder of the picture."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=n_runs, help="seeds 0 to RUNS - 1")
    parser.add_argument("--folder", type=Path, default=IMAGES, help="where the picture goes")
    return parser.parse_args()


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


def true_values(env_kwargs: dict[str, Any]) -> Floats:
    """The values of the states, from their probability of ending right, shape (n_states + 2,)."""
    walk: Any = gym.make(WALK, **env_kwargs).unwrapped
    right = np.arange(walk.n_states + 2) / (walk.n_states + 1)
    return np.asarray(walk.left_reward + (walk.right_reward - walk.left_reward) * right)


def errors_of_runs(
    algo: str, seeds: Sequence[int], n_episodes: int, env_kwargs: dict[str, Any], **settings: Any
) -> Floats:
    """Root mean square errors over the states after each episode, shape (n_runs, n_episodes).

    There is only one action, so its value is the state's value.
    """
    values = true_values(env_kwargs)
    agent = agent_on(WALK, algo, 0, env_kwargs=env_kwargs, **settings)
    start = {name: table.clone() for name, table in agent.policy.state_dict().items()}
    runs = []
    for seed in seeds:
        # Resetting the agent takes a tenth of the time of making a new one.
        agent.policy.load_state_dict(start)
        agent.set_random_seed(seed)
        errors = ValueErrors(values)
        stop = StopTrainingOnMaxEpisodes(n_episodes)
        agent.learn(MOST_STEPS, callback=CallbackList([errors, stop]), log_interval=None)
        runs.append(errors.errors[:n_episodes])
    return np.array(runs)


def canvas(title: str, x: str, y: str) -> tuple[Figure, Any]:
    """Make an empty plot with title and axis labels."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)
    return figure, axes


def step_size_curves(
    name: str, algo: str, step_sizes: Floats, settings: dict[Any, dict[str, Any]], n_runs: int
) -> tuple[Figure, dict[Any, list[float]]]:
    """Plot errors over the first ten episodes on the walk of 19 states by step size and setting.

    Errors above `LARGEST_ERROR` are NaN.
    """
    figure, axes = canvas(
        "RandomWalk-v0, 19 states", "step size", "error over the first 10 episodes"
    )
    walk, curves = {"n_states": 19, "left_reward": -1}, {}
    for each, own in settings.items():
        curve = []
        for size in step_sizes:
            with np.errstate(over="ignore", invalid="ignore"):
                runs = errors_of_runs(algo, range(n_runs), 10, walk, learning_rate=size, **own)
            mean = float(runs.mean())
            curve.append(mean if mean < LARGEST_ERROR else float("nan"))
        axes.plot(step_sizes, curve, label=f"{name} = {each:g}")
        curves[each] = curve
    axes.set_ylim(0.25, 0.55)
    axes.legend(fontsize="small", ncols=2)
    return figure, curves


def finish(name: str, figure: Figure, folder: Path, statements: Sequence[Statement]) -> None:
    """Save the picture, and print the book's statements; exit with 1 if one of them fails."""
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
