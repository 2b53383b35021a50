"""The least and the greatest return of an episode: rewards of a step times the time limit."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym

from rl_yardstick.envs.brackets import is_plain
from rl_yardstick.envs.known_models import time_limit, transition_model

# The rewards of a step in environments without a transition model, by class.
_REWARDS = {
    "gymnasium.envs.classic_control.cartpole.CartPoleEnv": (0.0, 1.0),
    "gymnasium.envs.classic_control.mountain_car.MountainCarEnv": (-1.0, 0.0),
    "gymnasium.envs.classic_control.acrobot.AcrobotEnv": (-1.0, 0.0),
    "gymnasium.envs.classic_control.pendulum.PendulumEnv": (-16.2736044, 0.0),
}


def return_bounds(env: gym.Env[Any, Any]) -> tuple[float, float]:
    """The least and the greatest return of an episode, infinite where they are not known.

    An environment declares the least and the greatest reward of a step as ``reward_range``. Else
    they are those of its transition model, or known for its class.
    """
    rewards = _reward_range(env)
    if rewards is None:
        return -math.inf, math.inf
    low, high = rewards
    limit = time_limit(env) or math.inf
    # An episode has one step at least.
    return low * limit if low < 0 else low, high * limit if high > 0 else high


def _reward_range(env: gym.Env[Any, Any]) -> tuple[float, float] | None:
    declared = getattr(env.unwrapped, "reward_range", None)
    if isinstance(declared, tuple) and len(declared) == 2:
        return float(declared[0]), float(declared[1])
    model = transition_model(env)
    if model is not None:
        met = model.reward[model.prob > 0]
        is_noisy = model.reward_variance is not None and bool(model.reward_variance.any())
        return None if is_noisy else (float(met.min()), float(met.max()))
    kind = type(env.unwrapped)
    return _REWARDS.get(f"{kind.__module__}.{kind.__qualname__}") if is_plain(env) else None
