"""Draws the curves of the lessons, and evaluates their agents exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from rl_yardstick.agents.common.callbacks import BlockCallback
from rl_yardstick.mdp import TransitionModel, policy_return


def draw_curves(
    curves: Mapping[str, Any], x: Any = None, dashed: Mapping[str, Any] | None = None, **axes: Any
) -> None:
    """Draw a line for each entry, and dashed ones for comparison.

    Args:
        curves: the heights, by label.
        x: where they lie; without it, 0, 1, 2 and so forth.
        dashed: further heights by label, or single numbers.
        **axes: properties of the axes, such as ``xlabel`` and ``ylim``.
    """
    figure, drawn = plt.subplots(figsize=(8, 4), layout="constrained")
    places = np.arange(len(next(iter(curves.values())))) if x is None else np.asarray(x)
    for label, curve in curves.items():
        drawn.plot(places, curve, label=label)
    for label, curve in (dashed or {}).items():
        drawn.plot(places, np.broadcast_to(curve, places.shape), "k--", label=label)
    drawn.set(**axes)
    figure.legend(loc="outside right upper")
    plt.show()


def greedy_return(agent: BaseAlgorithm, model: TransitionModel, horizon: int) -> float:
    """The exact return of an agent's greedy policy."""
    actions, _ = agent.predict(np.arange(model.n_states), deterministic=True)
    return policy_return(model, actions, horizon).expected_return


class Measure(BlockCallback):
    """Measures the agent during training, and keeps the results.

    Args:
        every_n_steps: after how many steps.
        measure: called with the agent.
    """

    def __init__(self, every_n_steps: int, measure: Callable[[BaseAlgorithm], Any]) -> None:
        super().__init__()
        self.every_n_steps = every_n_steps
        self.measure = measure
        self.found: list[Any] = []

    def _on_step(self) -> bool:
        self.found.append(self.measure(self.model))
        return True
