"""Which actions an environment allows now, however it says so."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.toy_text.taxi import TaxiEnv

from mdp.array_types import Bools

Env = gym.Env[Any, Any]

# The keys under which Gymnasium's Taxi and sb3-contrib's environments have it.
INFO_KEY = "action_mask"
METHOD = "action_masks"


def mask_source(env: Env) -> Callable[[], Any] | None:
    """What to call for the mask of the present state, or None where there is nothing to call.

    That is the method `action_masks`, of the environment or of a wrapper around it; of Gymnasium's
    Taxi, which has none, its mask of the state that it is in.
    """
    if env.has_wrapper_attr(METHOD):
        method: Callable[[], Any] = env.get_wrapper_attr(METHOD)
        return method
    base = env.unwrapped
    if isinstance(base, TaxiEnv):
        return lambda: base.action_mask(int(base.s))
    return None


def has_masks(env: Env) -> bool:
    """Whether the environment says what it allows, in whichever way; one may have to be begun."""
    return mask_source(env) is not None or INFO_KEY in env.reset()[1]


def action_masks(env: Env) -> Bools | None:
    """What may be done now, bool of shape (n_actions,), or None where the environment has no say.

    An environment that speaks by ``info["action_mask"]`` alone is asked through
    `envs.wrappers.ActionMasks`.
    """
    source = mask_source(env)
    return None if source is None else np.asarray(source(), dtype=np.bool_)
