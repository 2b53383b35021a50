"""What a policy needs to act beside the observation: a memory, or to be told what is valid."""

from __future__ import annotations

import sys

from stable_baselines3.common.base_class import BaseAlgorithm


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
