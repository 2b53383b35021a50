"""Whether a policy has weights, and whether it acts by more than what it observes now."""

from __future__ import annotations

import sys

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm


def is_network(model: BaseAlgorithm) -> bool:
    """Whether the agent's policy has weights."""
    policy = getattr(model, "policy", None)
    return isinstance(policy, th.nn.Module) and next(policy.parameters(), None) is not None


def has_memory(agent: BaseAlgorithm) -> bool:
    """Whether the agent's policy is recurrent, and acts by what it saw before as well."""
    # Where sb3-contrib is not imported, no policy can be of its classes.
    module = sys.modules.get("sb3_contrib.common.recurrent.policies")
    return module is not None and isinstance(
        getattr(agent, "policy", None), module.RecurrentActorCriticPolicy
    )
