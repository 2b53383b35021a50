"""Compiled environments that were made before, for as long as what they were made from is the same.

Working out those of a million states takes longer than training on them. One is kept while the
environments live that it stands for; of small ones, the last few longer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import gymnasium as gym
from gymnasium.wrappers import ClipReward, OrderEnforcing, PassiveEnvChecker, TimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from agents.compiled.cart_pole import CartPole
from agents.compiled.finite_model import FiniteModel
from agents.compiled.mountain_car import MountainCar
from envs.known_models import clips_to_numbers
from envs.model_claims import Sources, pickled, sources_of

World = FiniteModel | CartPole | MountainCar

SMALL = 2**22  # bytes
N_SMALL = 4

# What counts of wrappers whose own state changes at every step; of any other, all that it holds.
_COUNTS: dict[type, tuple[str, ...]] = {
    Monitor: (),
    OrderEnforcing: (),
    PassiveEnvChecker: (),
    TimeLimit: ("_max_episode_steps",),
    # Its function cannot be compared, but follows from the bounds.
    ClipReward: ("_saved_kwargs",),
}
_BELOW = "env"


@dataclass(frozen=True)
class Recipe:
    """All that a compiled environment is made from, to be compared.

    Attributes:
        sources: of the environment without its wrappers.
        wrappers: their classes, and what they hold, the outermost first.
    """

    sources: Sources
    wrappers: tuple[tuple[type, bytes], ...]

    __hash__ = None  # type: ignore[assignment]


_of_envs: WeakKeyDictionary[VecEnv, tuple[Recipe, World]] = WeakKeyDictionary()
_small: deque[tuple[Recipe, World]] = deque(maxlen=N_SMALL)


def recipe_of(layers: Sequence[gym.Env[Any, Any]]) -> Recipe | None:
    """What an environment is made from; None where that is not known, or cannot be compared.

    Args:
        layers: its wrappers, the outermost first, and the environment itself.
    """
    *wrappers, base = layers
    sources = sources_of(base)
    contents = [_content(wrapper) for wrapper in wrappers] if sources is not None else [None]
    known = [content for content in contents if content is not None]
    if sources is None or len(known) < len(contents):
        return None
    kinds = [type(wrapper) for wrapper in wrappers]
    return Recipe(sources, tuple(zip(kinds, known, strict=True)))


def _content(wrapper: gym.Env[Any, Any]) -> bytes | None:
    if isinstance(wrapper, ClipReward) and not clips_to_numbers(wrapper):
        return None
    held = {name: value for name, value in vars(wrapper).items() if name != _BELOW}
    names = _COUNTS.get(type(wrapper), held.keys())
    return pickled({name: held[name] for name in names})


def kept_world(recipe: Recipe | None) -> World | None:
    """The compiled environment of a recipe, where there is one."""
    if recipe is not None:
        for known, world in (*_of_envs.values(), *_small):
            if known == recipe:
                return world
    return None


def keep_world(vec_env: VecEnv, recipe: Recipe | None, world: World) -> None:
    """Keep the compiled environment that stands for ``vec_env``, by the recipe that it has now."""
    if recipe is None:
        _of_envs.pop(vec_env, None)
        return
    _of_envs[vec_env] = (recipe, world)
    is_known = any(known == recipe for known, _ in _small)
    if not is_known and isinstance(world, FiniteModel) and world.outcomes.nbytes <= SMALL:
        _small.append((recipe, world))
