"""Agents that have to be told what the environment allows, played as any other."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from agents.common.mask_reading import check_masks_exist, present_masks
from pipeline.errors import UserError


def takes_masks(model: Any) -> bool:
    """Whether `predict` takes ``action_masks``, and the agent goes by them."""
    predict = getattr(model.predict, "__func__", model.predict)
    return _knows_masks(predict) and bool(getattr(model, "mask_actions", True))


@lru_cache(maxsize=64)
def _knows_masks(predict: Callable[..., Any]) -> bool:
    return "action_masks" in inspect.signature(predict).parameters


def player(model: BaseAlgorithm, env: VecEnv) -> Any:
    """What to ask by ``predict`` on ``env``: the agent, told the masks where it takes them.

    Raises:
        UserError: if it takes them and the environment has none.
    """
    if not takes_masks(model):
        return model
    try:
        check_masks_exist(env)
    except ValueError as error:
        raise UserError(
            f"{type(model).__name__} has to be told which actions are valid, and the environment "
            "has no action masks"
        ) from error
    return MaskTold(model, env)


class MaskTold:
    """An agent, and the environments that tell it what may be done.

    Args:
        model: the agent.
        env: the environments that it is played on.
    """

    def __init__(self, model: Any, env: VecEnv) -> None:
        self.model = model
        self.env = env

    def predict(self, observation: Any, **kwargs: Any) -> tuple[Any, Any]:
        """The agent's own, for what the environments show now."""
        masks = present_masks(self.env, observation)
        actions, state = self.model.predict(observation, action_masks=masks, **kwargs)
        return actions, state
