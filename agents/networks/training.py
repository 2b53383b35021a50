"""What an agent of the library and compiled code hand to each other while it trains."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import update_learning_rate

from agents.common.callback_horizons import NEVER, Horizon
from agents.networks.observations import Numbers
from agents.networks.perceptron import Inputs


class NetworkTraining(ABC):
    """An agent of the library in training.

    Args:
        agent: the agent.
        seen: how its networks see compiled environments.

    Attributes:
        learner: the agent as compiled functions see it.
        place: how far the training is, a record alone in an array.
    """

    learner: Any
    place: Any

    def __init__(self, agent: Any, seen: Any) -> None:
        self.agent = agent
        self.seen = seen

    @abstractmethod
    def in_loop(self) -> Any:
        """What the compiled loop asks."""

    @abstractmethod
    def schedules(self) -> dict[str, Schedule]:
        """What compiled code works out after each step, by the names in its record."""

    @abstractmethod
    def read(self) -> None:
        """Begin where the agent is."""

    def write(self) -> None:
        """Let the agent know where compiled code is."""
        learning_rate = float(self.place["learning_rate"][0])
        if learning_rate > 0:
            update_learning_rate(self.agent.policy.optimizer, learning_rate)

    def until_end(self, total_timesteps: int) -> int:
        """Steps of every environment until the training is over."""
        left: int = total_timesteps - self.agent.num_timesteps
        return -(-left // int(self.agent.n_envs))

    def until_log(self, log_interval: int | None) -> Horizon:
        """When something is logged next."""
        return Horizon(NEVER, NEVER)

    @abstractmethod
    def count_episodes(self, n_episodes: int, log_interval: int | None) -> None:
        """Let the agent know of episodes that have ended, and log where it is time to."""

    @abstractmethod
    def before_last_step(self, log_interval: int | None) -> None:
        """What comes between the callbacks and learning from the last step of a block."""

    @abstractmethod
    def record(self) -> None:
        """Hand what the last training has given to the agent's logger."""


def row_of(inputs: Inputs, seen: Any) -> Any:
    """The memory of a single observation, as the row that it is written to."""
    return inputs.indices if isinstance(seen, Numbers) else inputs.vectors[0]


def room_for_rows(inputs: Inputs, seen: Any, n: int) -> Any:
    """Room for ``n`` observations of environments in Python, shape (n, d)."""
    row = row_of(inputs, seen)
    return np.zeros((n, len(row)), row.dtype)


def record_of(kind: np.dtype[np.void], **values: Any) -> Any:
    """A record, alone in an array."""
    records = np.zeros(1, dtype=kind)
    for name, value in values.items():
        records[name] = value
    return records
