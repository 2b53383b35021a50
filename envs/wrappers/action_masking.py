"""Wrappers that tell which actions an environment allows."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from envs.action_masks import INFO_KEY, has_masks, mask_source
from mdp.array_types import Bools


class ActionMasks(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Says in both ways what may be done: by `action_masks()` and by ``info["action_mask"]``.

    The first is sb3-contrib's convention and can be asked at any time. The second comes with each
    step, so that it also tells of the state in which an episode is cut off.

    Args:
        env: an environment that says it in one of the two ways, or Gymnasium's Taxi.

    Raises:
        ValueError: if it says it in neither.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self._told: Any = None
        if not has_masks(env):
            name = env.unwrapped if env.spec is None else env.spec.id
            raise ValueError(
                f"{name} has no action masks: neither a method action_masks() nor "
                f"info[{INFO_KEY!r}]"
            )

    def action_masks(self) -> Bools:
        """What may be done now, bool of shape (n_actions,)."""
        source = mask_source(self.env)
        return np.asarray(self._told if source is None else source(), dtype=np.bool_)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """As the environment, with the mask in ``info``."""
        obs, info = self.env.reset(**kwargs)
        return obs, self._with_mask(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As the environment, with the mask in ``info`` unless nothing can be done any more."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if not terminated:
            info = self._with_mask(info)
        return obs, reward, terminated, truncated, info

    def _with_mask(self, info: dict[str, Any]) -> dict[str, Any]:
        self._told = info.get(INFO_KEY)
        return {**info, INFO_KEY: self.action_masks().astype(np.int8)}


class IdleActionMasks(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Allows the actions that may change something, by the model that the environment holds.

    An action that surely leaves the state as it is, without ending the episode, is masked; in a
    state that no action changes, none is. For FrozenLake and CliffWalking, which have no masks.

    Args:
        env: an environment that holds ``P`` and its state ``s`` as Gymnasium's toy_text does.

    Attributes:
        masks: of all states, bool of shape (S, A).

    Raises:
        ValueError: if it holds none.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        P = getattr(env.unwrapped, "P", None)  # noqa: N806 (Gymnasium's own name)
        if P is None:
            raise ValueError(f"IdleActionMasks needs an environment that holds P, not {env}")
        self.masks = np.array(
            [[_changes(s, P[s][action]) for action in range(len(P[s]))] for s in range(len(P))]
        )
        self.masks |= ~self.masks.any(axis=1, keepdims=True)

    def action_masks(self) -> Bools:
        """What may be done now, bool of shape (A,)."""
        base: Any = self.env.unwrapped
        return np.array(self.masks[base.s])


def _changes(state: int, outcomes: list[tuple[float, int, float, bool]]) -> bool:
    """Whether an action can lead to another state or end the episode."""
    return any(prob > 0 and (ends or after != state) for prob, after, _, ends in outcomes)
