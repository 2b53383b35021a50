"""Bounds of the return of any episode, and precomputed ones (brackets) of the optimum.

`benchmarks/optimum_brackets.py` of commit d0af048 wrote the brackets, for Gymnasium's environments
as made by default. A bracket applies only to an environment of the same class, with the same
constants and time limit, whose wrappers change neither rewards, actions nor steps.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym

from rl_yardstick.envs.known_models import (
    TRANSPARENT_WRAPPERS,
    layers,
    time_limit,
    transition_model,
)
from rl_yardstick.envs.published_models import is_changed

DATA = Path(__file__).with_name("brackets.json")

# Modules of wrappers that change observations, but not the dynamics.
_OBSERVATION_HOMES = ("gymnasium.wrappers.", "rl_yardstick.envs.wrappers.")


@dataclass(frozen=True)
class OptimumBracket:
    """Bounds of the highest mean return of any policy, over random starts."""

    lower: float  # what a policy was observed to reach
    upper: float  # what no policy exceeds
    baseline: float  # the mean return of the best random or constant policy
    upper_is_proven: bool = True  # whether there is a proof of the upper bound


def optimum_bracket(env: gym.Env[Any, Any]) -> OptimumBracket | None:
    """The bracket of an environment, or None where no bracket applies."""
    base = env.unwrapped
    entry = known_entries().get(f"{type(base).__module__}:{type(base).__qualname__}", {})
    found = entry.get(time_limit(env))
    if found is None or not is_plain(env) or constants_of(base) != found["constants"]:
        return None
    baseline, is_proven = found["baseline"]["mean"], found["upper_is_proven"]
    return OptimumBracket(found["lower"], found["upper"], baseline, is_proven)


def may_have_bracket(env_id: str) -> bool:
    """Whether an environment is of a class that has brackets, without making it."""
    registered = gym.registry.get(env_id.rpartition(":")[2])
    return registered is not None and registered.entry_point in known_entries()


def upper_is_proven(env_id: str) -> bool:
    """Whether the upper ends of all brackets of the environment's class are proven."""
    registered = gym.registry.get(env_id.rpartition(":")[2])
    entries = {} if registered is None else known_entries().get(str(registered.entry_point), {})
    return all(entry["upper_is_proven"] for entry in entries.values())


@cache
def known_entries() -> dict[str, dict[int | None, dict[str, Any]]]:
    """The stored brackets, by class and time limit."""
    found: dict[str, dict[int | None, dict[str, Any]]] = {}
    for entry in json.loads(DATA.read_text(encoding="utf-8")).values():
        found.setdefault(entry["class"], {})[entry["time_limit"]] = entry
    return found


def constants_of(base: gym.Env[Any, Any]) -> dict[str, Any]:
    """The numbers, texts and lists that an environment's dynamics may depend on, by name.

    Attributes of its class count too; those for rendering, or that change in each step, do not.
    """
    of_class = {k: v for each in reversed(type(base).__mro__) for k, v in vars(each).items()}
    named = {**of_class, **vars(base)}
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in sorted(named.items())
        if isinstance(value, int | float | str | list | tuple) and not name.startswith(_NO_DYNAMICS)
    }


_NO_DYNAMICS = (
    *("__", "_is_protocol", "_np_random", "render", "screen", "SCREEN", "isopen"),
    *("state", "steps_beyond", "last_u"),
)


def is_plain(env: gym.Env[Any, Any]) -> bool:
    """Whether wrappers change only observations, and no method was replaced by hand."""
    base, wrappers = layers(env)
    for wrapper in wrappers:
        name = f"{type(wrapper).__module__}.{type(wrapper).__qualname__}"
        shows = isinstance(wrapper, gym.ObservationWrapper) and name.startswith(_OBSERVATION_HOMES)
        if not (shows or name in TRANSPARENT_WRAPPERS):
            return False
    return not any(map(is_changed, (base, *wrappers)))


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
    kind, rewards = type(env.unwrapped), (-math.inf, math.inf)
    declared = getattr(env.unwrapped, "reward_range", None)
    if isinstance(declared, tuple) and len(declared) == 2:
        rewards = float(declared[0]), float(declared[1])
    elif (model := transition_model(env)) is not None:
        met = model.reward[model.prob > 0]
        if model.reward_variance is None or not model.reward_variance.any():
            rewards = float(met.min()), float(met.max())
    elif is_plain(env):
        rewards = _REWARDS.get(f"{kind.__module__}.{kind.__qualname__}", rewards)
    low, high = rewards
    limit = time_limit(env) or math.inf
    # An episode has one step at least.
    return low * limit if low < 0 else low, high * limit if high > 0 else high
