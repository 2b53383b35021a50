"""``train.py --list``: the agents, the environments, and how hard these are."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import gymnasium as gym
from rich.table import Table

from rl_yardstick import envs
from rl_yardstick.agents import ALGORITHMS, fitting_algorithms
from rl_yardstick.agents.registry import is_bandit
from rl_yardstick.commands.terminal import table_console
from rl_yardstick.envs.wrappers import has_masks
from rl_yardstick.pipeline.environments import make_env
from rl_yardstick.pipeline.settings import entry_names


def print_lists() -> None:
    """Print the agents, the environments with settings for some agent, and how hard these are."""
    console = table_console()
    agents = Table(box=None, padding=(0, 2, 0, 0))
    agents.add_column("agent (--algo)", style="bold", no_wrap=True)
    agents.add_column("what it is")
    for name, entry in ALGORITHMS.items():
        missing = "" if entry.is_installed else f"  needs: {entry.install_command}"
        agents.add_row(name, entry.summary + missing)
    tuned = {name: set(entry_names(name)) for name in ALGORITHMS}
    places = Table(box=None, padding=(0, 2, 0, 0))
    places.add_column("environment (--env)", style="bold", no_wrap=True)
    places.add_column("agents with hyperparameters for it; also: those that take the default ones")
    for env_id in sorted(set().union(*tuned.values()) & set(gym.registry)):
        with_entry = [name for name in ALGORITHMS if env_id in tuned[name]]
        with closing(make_env(env_id, {})) as env:
            spaces = env.observation_space, env.action_space
            fitting = fitting_algorithms(*spaces, is_bandit(env), has_masks(env))
        others = [name for name in fitting if name not in with_entry]
        also = "\nalso: " + " ".join(others) if others else ""
        places.add_row(env_id, " ".join(with_entry) + also)
    hardness = Table(box=None, padding=(0, 2, 0, 0))
    hardness.add_column("how hard it is", style="bold", no_wrap=True)
    heads = "states", "diameter", "effective horizon", "random actions to a reward"
    for head in heads:
        hardness.add_column(head, justify="right")
    stored = json.loads(Path(envs.__file__).with_name("hardness.json").read_text(encoding="utf-8"))
    for env_id, found in sorted(stored.items()):
        hardness.add_row(env_id, *(found[head] for head in heads))
    for table in (agents, places, hardness):
        console.print(table)
        console.print()
    console.print(
        "Any other environment registered with Gymnasium works where the spaces fit; "
        "--gym-packages imports modules that register more, and agents of your own."
    )
