"""The agents, the environments, and which fit which."""

from __future__ import annotations

import gymnasium as gym
from rich.console import Console
from rich.table import Table

from agents import ALGORITHMS, fitting_algorithms
from agents.algorithm_entries import is_bandit
from commands.terminal import table_console
from envs.action_masks import has_masks
from pipeline.environments import make_env
from pipeline.settings.hyperparams import entry_names


def print_lists() -> None:
    """Print the table of agents and that of environments."""
    console = table_console(highlight=False)
    _print_agents(console)
    console.print()
    _print_environments(console)


def _print_agents(console: Console) -> None:
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("agent (--algo)", style="bold", no_wrap=True)
    table.add_column("what it is")
    for name, entry in ALGORITHMS.items():
        missing = "" if entry.is_installed else f"  needs: {entry.install_command}"
        table.add_row(name, entry.summary + missing)
    console.print(table)


def _print_environments(console: Console) -> None:
    """A row for each environment that some agent has hyperparameters of its own for."""
    tuned = {name: set(entry_names(name)) for name in ALGORITHMS}
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("environment (--env)", style="bold", no_wrap=True)
    table.add_column("agents with hyperparameters for it; also: those that take the default ones")
    for env_id in sorted(set().union(*tuned.values()) & set(gym.registry)):
        env = make_env(env_id, {})
        with_entry = [name for name in ALGORITHMS if env_id in tuned[name]]
        fitting = fitting_algorithms(
            env.observation_space, env.action_space, is_bandit(env), has_masks(env)
        )
        others = [name for name in fitting if name not in with_entry]
        env.close()
        also = "\nalso: " + " ".join(others) if others else ""
        table.add_row(env_id, " ".join(with_entry) + also)
    console.print(table)
    console.print(
        "\nAny other environment registered with Gymnasium works where the spaces fit; "
        "--gym-packages imports modules that register more, and agents of your own."
    )
