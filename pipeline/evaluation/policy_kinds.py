"""What a policy needs to act beside the observation: a memory, or to be told what is valid."""

from __future__ import annotations

import inspect
import sys
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv


def has_memory(agent: BaseAlgorithm) -> bool:
    """Whether the agent's policy is recurrent, and acts by what it saw before as well."""
    return _is_policy(agent, "recurrent", "RecurrentActorCriticPolicy")


def needs_masks(agent: BaseAlgorithm) -> bool:
    """Whether the agent's policy is one that has to be told which actions are valid."""
    return _is_policy(agent, "maskable", "MaskableActorCriticPolicy")


def _is_policy(agent: BaseAlgorithm, package: str, class_name: str) -> bool:
    # Where sb3-contrib is not imported, no policy can be of its classes.
    module = sys.modules.get(f"sb3_contrib.common.{package}.policies")
    return module is not None and isinstance(
        getattr(agent, "policy", None), getattr(module, class_name)
    )


def takes_masks(agent: BaseAlgorithm) -> bool:
    """Whether the agent can be told which actions are valid."""
    return "action_masks" in inspect.signature(agent.predict).parameters


class MaskedActor:
    """Acts like an agent that is told, each time, which actions the environments say are valid.

    Args:
        agent: one whose ``predict`` takes ``action_masks``.
        env: environments with a method ``action_masks()``, which are being played on.
    """

    def __init__(self, agent: BaseAlgorithm, env: VecEnv) -> None:
        self.agent: Any = agent
        self.env = env

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """As `BaseAlgorithm.predict`, for what the environments show right now."""
        from sb3_contrib.common.maskable.utils import get_action_masks

        masks = get_action_masks(self.env)
        actions, state = self.agent.predict(
            observation, state, episode_start, deterministic, action_masks=masks
        )
        return actions, state


def actor_on(agent: BaseAlgorithm, env: VecEnv) -> BaseAlgorithm | MaskedActor:
    """The agent, told which actions are valid where it listens and the environments say so."""
    if takes_masks(agent) and env.has_attr("action_masks"):
        return MaskedActor(agent, env)
    return agent
