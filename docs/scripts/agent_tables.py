"""Tables of the agents and of the spaces that they support, from the registry of agents."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from gymnasium import spaces

from rl_yardstick.agents.registry import ALGORITHMS, fitting_algorithms

PAGES = Path(__file__).resolve().parents[1] / "algorithms"
BOX = spaces.Box(-1, 1, (3,), np.float32)
# Observations and actions in words, and their spaces.
CASES = (
    ("a number", "a number", spaces.Discrete(4), spaces.Discrete(3)),
    ("a vector or an image", "a number", BOX, spaces.Discrete(3)),
    ("a vector or an image", "a vector", BOX, BOX),
    ("several numbers", "a number", spaces.MultiDiscrete([3, 4]), spaces.Discrete(3)),
    ("a dictionary", "a number", spaces.Dict({"seen": BOX}), spaces.Discrete(3)),
    ("a vector or an image", "several numbers", BOX, spaces.MultiDiscrete([3, 4])),
)


def by_spaces_block() -> str:
    """A row for each pair of spaces, with the agents that fit."""
    lines = ["| you observe | you act by | agents |", "|---|---|---|"]
    for seen, done, observation, action in CASES:
        names = linked(fitting_algorithms(observation, action, masks=True))
        kinds = f"{seen} (`{kind(observation)}`) | {done} (`{kind(action)}`)"
        lines.append(f"| {kinds} | {names} |")
    for seen, observation in (("nothing, or a number", spaces.Discrete(2)), ("a vector", BOX)):
        fitting = fitting_algorithms(observation, spaces.Discrete(3), bandit=True)
        names = linked([name for name in fitting if ALGORITHMS[name].for_bandits])
        lines.append(
            f"| a bandit: {seen} (`{kind(observation)}`) | a number (`Discrete`) | {names} |"
        )
    return "\n".join(lines) + "\n"


def agents_block() -> str:
    """A row for each agent."""
    lines = ["| agent | what it is | observes → acts in |", "|---|---|---|"]
    for name, entry in ALGORITHMS.items():
        needs = [
            "action masks" if entry.needs_masks else "",
            f"observations of shape {entry.observation_shape}" if entry.observation_shape else "",
            f"the extra `{entry.extra}`" if entry.extra else "",
        ]
        told = ", ".join(filter(None, needs))
        what = f"{entry.summary} (needs {told})" if told else entry.summary
        spaces_of = f"{'/'.join(entry.observations)} → {'/'.join(entry.actions)}"
        lines.append(f"| {linked([name])} | {what} | {spaces_of} |")
    return "\n".join(lines) + "\n"


def linked(names: list[str]) -> str:
    """The names of agents, each a link to its page if there is one."""
    return ", ".join(
        f"[`{name}`](algorithms/{name}.md)" if (PAGES / f"{name}.md").exists() else f"`{name}`"
        for name in names
    )


def kind(space: spaces.Space[object]) -> str:
    """The name of a space's class."""
    return type(space).__name__
