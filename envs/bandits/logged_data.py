"""What was shown to whom, and what came of it: logged pulls in a CSV file.

Each row is one pull, under a header with the columns ``arm``, ``reward`` and, if it is known with
what probability the arm was chosen, ``propensity``. Every other column is part of the context.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.bandits.log_columns import ARM, PROPENSITY, REWARD, read_columns, some
from mdp.array_types import Floats, Ints


@dataclass(frozen=True, eq=False)
class LoggedData:
    """Pulls that somebody else made, in the order of the file.

    Attributes:
        source: the file, for messages.
        context_names: the columns that make up the context, d of them.
        contexts: what was known before each pull, shape (n, d). Text is given as its place in
            ``categories``.
        arms: the arms pulled, int64 of shape (n,).
        rewards: what they gave, shape (n,).
        propensities: the probability with which each was chosen, shape (n,); None if not known.
        categories: the values of a context of text, in alphabetical order; None for numbers.
    """

    source: str
    context_names: tuple[str, ...]
    contexts: Floats
    arms: Ints
    rewards: Floats
    propensities: Floats | None
    categories: tuple[str, ...] | None = None

    def __len__(self) -> int:
        return len(self.arms)

    @property
    def n_arms(self) -> int:
        """One more than the highest arm that was pulled."""
        return int(self.arms.max()) + 1

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """The space of the contexts.

        Discrete for no context, for one column of text, and for one that holds every whole number
        from 0 to its largest; otherwise a Box with the bounds of each column.
        """
        if not self.context_names:
            return spaces.Discrete(1)
        if self.categories is not None:
            return spaces.Discrete(len(self.categories))
        if len(self.context_names) == 1:
            values = np.unique(self.contexts)
            if np.array_equal(values, np.arange(len(values))):
                return spaces.Discrete(len(values))
        rounded = self.contexts.astype(np.float32)
        return spaces.Box(rounded.min(axis=0), rounded.max(axis=0), dtype=np.float32)

    def observations(self, space: spaces.Space[Any]) -> NDArray[Any]:
        """The contexts as an agent with a certain observation space is shown them.

        Args:
            space: Discrete, or a Box of one axis.

        Returns:
            int64 of shape (n,) for Discrete, float32 of shape (n, d) for a Box.

        Raises:
            ValueError: if the contexts do not fit into the space.
        """
        if isinstance(space, spaces.Discrete):
            return self._as_discrete(int(space.n))
        n_columns = len(self.context_names)
        if not isinstance(space, spaces.Box) or space.shape != (n_columns,) or self.categories:
            raise ValueError(f"{self.source} has {self._described()}, the agent observes {space}")
        return self.contexts.astype(np.float32)

    def _as_discrete(self, n_contexts: int) -> Ints:
        if n_contexts == 1 and not self.context_names:
            return np.zeros(len(self), np.int64)
        codes = self.contexts.astype(np.int64)
        fits = len(self.context_names) == 1 and np.array_equal(codes, self.contexts)
        if self.categories is not None:
            fits = len(self.categories) == n_contexts
        if not fits or codes.min() < 0 or codes.max() >= n_contexts:
            wanted = f"one column of whole numbers from 0 to {n_contexts - 1}"
            raise ValueError(f"{self.source} has {self._described()}, the agent observes {wanted}")
        return codes[:, 0]

    def _described(self) -> str:
        """The contexts in words."""
        if not self.context_names:
            return "no context"
        names = some(self.context_names)
        if self.categories is None:
            return f"the context {names}"
        return f"the context {names} with {len(self.categories)} values of text"


def read_log(path: str | Path) -> LoggedData:
    """Read logged pulls.

    Args:
        path: a CSV file, separated by commas, with a header; see the module.

    Raises:
        ValueError: if it cannot be read, a column is missing or there twice, a row is too short or
            too long, an arm is not a whole number from 0, a number not finite or beyond 1e15, or a
            propensity not from 1e-9 to 1. The message names file and line.
    """
    columns, words = read_columns(Path(path))
    names = tuple(name for name in columns if name not in {ARM, REWARD, PROPENSITY})
    contexts = np.empty((len(columns[ARM]), len(names)))
    for i, name in enumerate(names):
        contexts[:, i] = columns[name] if words is None else words.places()
    return LoggedData(
        source=str(path),
        context_names=names,
        contexts=contexts,
        arms=columns[ARM].astype(np.int64),
        rewards=columns[REWARD],
        propensities=columns.get(PROPENSITY),
        categories=None if words is None else words.sorted,
    )


def log_uniformly(env: gym.Env[Any, Any], n: int, seed: int, path: str | Path) -> None:
    """Pull arms uniformly at random and write what came of it, for `read_log` to read.

    Args:
        env: a bandit as `gymnasium.make` returns it; its observations are Discrete, or a Box of
            one axis.
        n: the number of pulls; episodes follow each other where one is too short.
        seed: of the environment and of the arms.
        path: the file to write.
    """
    assert isinstance(env.action_space, spaces.Discrete)
    n_arms = int(env.action_space.n)
    # A stream of its own: the environment draws from that of the seed itself.
    arms = np.random.default_rng([seed, 1]).integers(n_arms, size=n).tolist()
    space = env.observation_space
    if isinstance(space, spaces.Discrete):
        names = ["context"] if space.n > 1 else []
    else:
        assert isinstance(space, spaces.Box)
        names = [f"feature_{i}" for i in range(space.shape[0])]
    context, _ = env.reset(seed=seed)
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*names, ARM, REWARD, PROPENSITY])
        for arm in arms:
            shown = np.ravel(context).tolist()[: len(names)]
            context, reward, terminated, truncated, _ = env.step(arm)
            writer.writerow([*shown, arm, reward, 1 / n_arms])
            if terminated or truncated:
                context, _ = env.reset()
