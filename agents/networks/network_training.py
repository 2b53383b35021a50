"""What an agent of the library and compiled code hand to each other while it trains."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.type_aliases import Schedule

from agents.common.callback_horizons import NEVER, Horizon
from agents.compiled.generators import handles_of
from agents.networks.observations import Numbers
from agents.networks.references import Reference, address_of
from agents.networks.shared_tensors import SharedTensors

# An address that is filled in once there is a reference to what it belongs to.
NOWHERE = np.uintp(0)


class NetworkTraining(ABC):
    """An agent of the library in training.

    Args:
        agent: the agent.
        seen: how its networks see compiled environments.
        tensors: of its networks and its optimizer.

    Attributes:
        learner: the agent as compiled functions see it, by reference.
        held: the same itself.
        shown: observations of environments in Python, shape (n_envs, d).
        waits: whether rollouts are learnt from by `learn_from_rollout`, and not by the loop.
        heeds_budgets: whether a number of episodes to train for moves the schedules.
        improves_by: the compiled function that learns from a minibatch.
    """

    held: Any
    heeds_budgets: ClassVar[bool]
    improves_by: ClassVar[Callable[[Any, float, float], int]]

    def __init__(self, agent: Any, seen: Any, tensors: SharedTensors) -> None:
        self.agent = agent
        self.seen = seen
        self.tensors = tensors
        self.waits = False
        # A handle does not keep it alive.
        self.generator = agent.rng
        self.held = self._make_learner()
        self.learner = Reference(self.held)
        self.hold(improve=address_of(type(self).improves_by, self.learner))
        width = 1 if isinstance(seen, Numbers) else int(tensors.networks[0].layers.sizes[0])
        self.shown = np.zeros((agent.n_envs, width))

    @abstractmethod
    def _make_learner(self) -> Any:
        """The agent as compiled functions see it."""

    @abstractmethod
    def in_loop(self) -> Any:
        """What the compiled loop asks."""

    @abstractmethod
    def schedules(self) -> dict[str, Schedule]:
        """What compiled code works out after each step, by the names in its record."""

    @abstractmethod
    def read_settings(self) -> None:
        """Take over what a callback has changed."""

    def read_tensors(self) -> None:
        """Go on with the weights and the optimizer that a callback may have put there.

        Raises:
            ValueError: if the optimizer has become one that compiled code does not know.
        """
        optimizer = self.tensors.take_over()
        if optimizer is not self.held.optimizer:
            self.hold(optimizer=optimizer)

    def hold(self, **parts: Any) -> None:
        """Put other parts in the place of the learner's."""
        self.held = self.held._replace(**parts)
        self.learner.hold(self.held)

    def read_generator(self) -> None:
        """Draw from the agent's generator, which a callback may have replaced."""
        if self.agent.rng is not self.generator:
            self.generator = self.agent.rng
            self.held.rng[:] = handles_of([self.generator])

    def show(self, observations: Any) -> None:
        """Take observations of environments in Python, of as many numbers as there is room for.

        Raises:
            ValueError: if one lies outside of its space, where no weights are.
        """
        self.shown[:] = np.reshape(observations, self.shown.shape)
        self.check_numbers(self.shown)

    def check_numbers(self, shown: Any) -> None:
        """Make sure that numbers of states are within their space; anything goes for vectors.

        Raises:
            ValueError: if they are not.
        """
        if isinstance(self.seen, Numbers) and not (shown.min() >= 0 and shown.max() < self.seen.n):
            wrong = int(shown[(shown < 0) | (shown >= self.seen.n)][0])
            raise ValueError(f"observation {wrong} is not in {self.agent.observation_space}")

    @abstractmethod
    def take_over_progress(self, remaining: float) -> None:
        """Let the agent know how much of the training remains, at the moments when it finds out."""

    @abstractmethod
    def give_up_rollout(self) -> None:
        """Forget how much was collected since the last training."""

    @abstractmethod
    def read(self) -> None:
        """Begin where the agent is."""

    @abstractmethod
    def write(self) -> None:
        """Let the agent know where compiled code is."""

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

    @property
    @abstractmethod
    def is_rollout_over(self) -> bool:
        """Whether a rollout waits to be learnt from, be it that nothing is learnt yet."""

    @abstractmethod
    def until_rollout_end(self) -> Horizon:
        """When a rollout ends that is to wait."""

    @abstractmethod
    def learn_from_rollout(self, remaining: float) -> None:
        """Learn from the rollout that waits, with that share of the training left."""

    @abstractmethod
    def before_training(self, log_interval: int | None) -> None:
        """What comes before learning from a rollout that ends with the last step of a block."""

    @abstractmethod
    def record(self) -> None:
        """Hand what the last training has given to the agent's logger."""


def record_of(kind: np.dtype[np.void], **values: Any) -> Any:
    """A record, alone in an array."""
    records = np.zeros(1, dtype=kind)
    for name, value in values.items():
        records[name] = value
    return records
