"""Agents that are told which actions are valid, played like any other."""

from __future__ import annotations

import inspect
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv


def takes_masks(model: Any) -> bool:
    """Whether the agent can be told which actions are valid."""
    return "action_masks" in inspect.signature(model.predict).parameters


def player(model: BaseAlgorithm, env: VecEnv) -> Any:
    """What to ask by ``predict`` on ``env``: the agent, told the masks where it takes them."""
    return MaskTold(model, env) if takes_masks(model) and env.has_attr("action_masks") else model


class MaskTold:
    """An agent, and the environments that tell it each time which actions are valid.

    Args:
        model: an agent whose ``predict`` takes ``action_masks``.
        env: environments with a method ``action_masks()``, which it is played on.
    """

    def __init__(self, model: Any, env: VecEnv) -> None:
        self.model = model
        self.env = env

    def predict(self, observation: Any, **kwargs: Any) -> tuple[Any, Any]:
        """The agent's own, for what the environments show right now."""
        from sb3_contrib.common.maskable.utils import get_action_masks

        masks = get_action_masks(self.env)
        actions, state = self.model.predict(observation, action_masks=masks, **kwargs)
        return actions, state
