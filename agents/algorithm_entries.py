"""What is known of one agent: where its class lives, and what it can work with."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium import spaces


@dataclass(frozen=True)
class AlgorithmEntry:
    """One agent that can be trained.

    Attributes:
        entry_point: where the class lives, as ``"module:Class"``; imported only when needed.
        summary: what the agent is, in a few words.
        observations: names of the Gymnasium spaces that it can observe; none for any space, and
            the class itself says what it cannot do.
        actions: names of the Gymnasium spaces that it can act in, likewise.
        observation_shape: the one observation shape that it understands, or None for any.
        for_bandits: whether it looks no further than the next reward.
        needs_masks: whether the environment must say which actions are valid.
        package: the import name of an optional package that it needs, or None.
        extra: the extra of this distribution that installs that package.
        engines: words for its argument ``engine``, the default first; one or none where there is
            no such argument, since it has one engine alone.
    """

    entry_point: str
    summary: str
    observations: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    observation_shape: tuple[int, ...] | None = None
    for_bandits: bool = False
    needs_masks: bool = False
    package: str | None = None
    extra: str | None = None
    engines: tuple[str, ...] = ()

    @property
    def family(self) -> str:
        """The folder of `agents` that the class lives in; empty where it is in none."""
        package, *folders = self.entry_point.partition(":")[0].split(".")
        return folders[0] if package == "agents" and len(folders) > 1 else ""

    @property
    def is_installed(self) -> bool:
        """Whether the package that the agent needs is there."""
        return self.package is None or importlib.util.find_spec(self.package) is not None

    @property
    def install_command(self) -> str:
        """What to type where that package is missing."""
        what = f"'rl-yardstick[{self.extra}]'" if self.extra else self.package
        return f"pip install {what}"

    def misfit(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> str:
        """Say why the agent cannot work with these spaces; empty where it can."""
        for space, known, role in (
            (observation_space, self.observations, "observes"),
            (action_space, self.actions, "acts in"),
        ):
            if not known:
                continue
            if type(space).__name__ not in known:
                return f"it {role} {' or '.join(known)} spaces, not {space}"
            # The one-hot encoding of Stable-Baselines3 and every table count from zero.
            if isinstance(space, spaces.Discrete) and space.start != 0:
                return f"it needs Discrete spaces that start at 0, not {space}"
        shape = self.observation_shape
        if shape is not None and observation_space.shape != shape:
            return f"it needs observations of shape {shape}, not {observation_space.shape}"
        return ""

    def env_misfit(self, env: gym.Env[Any, Any]) -> str:
        """Say why the agent cannot work with the environment; empty where it can."""
        from envs.action_masks import has_masks

        if self.for_bandits and not is_bandit(env):
            return "it is for bandits, where a pull changes nothing but its own reward"
        if self.needs_masks and not has_masks(env):
            return (
                "it needs to be told which actions are valid, by a method action_masks() or by "
                "info['action_mask']"
            )
        return self.misfit(env.observation_space, env.action_space)


def is_bandit(env: gym.Env[Any, Any]) -> bool:
    """Whether the environment is one of `envs.bandits`."""
    from envs.bandits import Bandit

    return isinstance(env.unwrapped, Bandit)
