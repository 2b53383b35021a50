"""The log of a training that goes on: the same folder, and iterations counted on.

On-policy algorithms of the library count iterations from 1 at each `learn`.
"""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

ITERATIONS = "time/iterations"


class IterationInterval(int):
    """A number of iterations between two log records, counted on from an earlier `learn`.

    The library takes an iteration's number modulo the interval; this adds those that went before.
    """

    before: int

    @classmethod
    def after(cls, before: int, interval: int) -> IterationInterval:
        """An interval, where so many iterations went before."""
        result = cls(interval)
        result.before = before
        return result

    def __rmod__(self, iteration: int) -> int:
        return (iteration + self.before) % int(self)


class IterationLogger(Logger):
    """A logger that adds the iterations of an earlier `learn` to those that it is told."""

    before = 0

    def record(self, key: str, value: Any, *args: Any, **kwargs: Any) -> None:
        """As in the library, but for the number of iterations."""
        super().record(key, value + self.before if key == ITERATIONS else value, *args, **kwargs)


def iterations_before(model: BaseAlgorithm, note: dict[str, Any]) -> int:
    """How many an algorithm that counts from 1 has behind it in a saved state."""
    return int(note["rollouts"]) if isinstance(model, OnPolicyAlgorithm) else 0


def resumed_logger(model: BaseAlgorithm, note: dict[str, Any]) -> Logger:
    """A logger that goes on where that of a saved state was, with the same outputs."""
    folder = note["log_folder"]
    names = ["stdout"] if model.verbose > 0 or folder is None else []
    names += [] if folder is None else ["tensorboard"]
    logger = IterationLogger(folder, [make_output_format(name, folder or "") for name in names])
    logger.before = iterations_before(model, note)
    return logger
