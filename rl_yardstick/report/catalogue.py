"""Which agents fit which environments: the lists of ``train.py --list``, and a run's rival.

Apart from other tables, because it has to be printed before anything heavy is loaded.
"""

from __future__ import annotations

from contextlib import closing, suppress
from typing import Any

import gymnasium as gym
from rich.console import Console
from rich.table import Column, Table

from rl_yardstick.agents.registry import ALGORITHMS, fitting_algorithms, is_bandit
from rl_yardstick.envs.wrappers import has_masks
from rl_yardstick.pipeline.environments import MISTAKES, check_env_id, make_env
from rl_yardstick.pipeline.settings import entry_names
from rl_yardstick.pipeline.spec import TrainSpec

# Agents for a comparison with a run, the first that fits; these train quickly.
RIVALS = ("thompson", "ucb", "qlearning", "sarsa", "semi_gradient_sarsa", "sac", "ppo")


def rival(spec: TrainSpec) -> str:
    """An agent to compare with, of those with hyperparameters for the environment if possible."""
    with suppress(*MISTAKES):  # of an environment that cannot be made a second time
        for names in fitting(spec.env_id, spec.env_kwargs):
            for name in RIVALS:
                if name in names and name != spec.algo:
                    return name
    return "random"


def fitting(env_id: str, env_kwargs: dict[str, Any]) -> tuple[list[str], list[str]]:
    """The agents with hyperparameters for an environment, and the others that fit it."""
    with closing(make_env(env_id, env_kwargs)) as env:
        spaces = env.observation_space, env.action_space
        found = fitting_algorithms(*spaces, is_bandit(env), has_masks(env))
    tuned = [name for name in ALGORITHMS if env_id in entry_names(name)]
    return tuned, [name for name in found if name not in tuned]


def print_lists(console: Console, env_id: str) -> None:
    """Print agents, and environments with settings for some agent; of one, what fits it."""
    ids = {one.id for one in gym.registry.values() if "rl_yardstick" in str(one.entry_point)}
    ids = ids.union(*map(entry_names, ALGORITHMS)) & set(gym.registry)
    ids -= {"ReplayBandit-v0"}  # its arms are those of a log
    if env_id:
        check_env_id(env_id)
        ids = {env_id}
    fit = {each: fitting(each, {}) for each in sorted(ids)}
    told = "agents with hyperparameters for it; also: those that take the default ones"
    places = [("environment (--env)", told)]
    for each, (tuned, others) in fit.items():
        lines = [" ".join(tuned), "also: " + " ".join(others) if others else ""]
        places.append((each, "\n".join(filter(None, lines))))
    agents = [("agent (--algo)", "what it is")]
    for name in [name for names in fit[env_id] for name in names] if env_id else ALGORITHMS:
        entry = ALGORITHMS[name]
        missing = "" if entry.is_installed else f"  needs: {entry.install_command}"
        agents.append((name, entry.summary + missing))
    for (first, second), *rows in (agents, places):
        table = Table(Column(first, no_wrap=True), second, box=None, padding=(0, 2, 0, 0))
        for row in rows:
            table.add_row(*row)
        console.print(table)
        console.print()
    console.print("Any environment of Gymnasium works where the spaces fit; see --gym-packages.")
