"""Action masks: reads them from environments, checks them, and stores them in policies."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from rl_yardstick.agents.common.model_files import TablePolicy
from rl_yardstick.envs.known_models import action_masks_of_states, observations_of_states
from rl_yardstick.envs.wrappers import METHOD, action_masks, mask_source
from rl_yardstick.mdp.transition_model import Bools, Ints

# Observations of `Discrete` spaces, as indices of tables.


def numbers_in(space: Any, observations: Any) -> Ints:
    """Observations as integers of the same shape; ValueError for one outside the space."""
    given = np.asarray(observations)
    outside = given[~((given >= 0) & (given < space.n) & (given == np.floor(given)))]
    if outside.size:
        raise ValueError(f"observation {outside[0]} is not in {space}, the agent's space")
    return given.astype(np.int64)


# Checked action masks of the environments in a VecEnv, for agents with ``mask_actions``.


def check_masks_exist(env: VecEnv) -> None:
    """Refuse environments that have no action masks."""
    inside = env.unwrapped
    if isinstance(inside, DummyVecEnv):
        found = all(mask_source(one) is not None for one in inside.envs)
    else:
        found = env.has_attr(METHOD)
    if not found:
        raise ValueError(
            "mask_actions: the environment has no method action_masks(); where its info holds "
            "action_mask, wrap it in rl_yardstick.envs.wrappers.ActionMasks"
        )


def present_masks(env: VecEnv, obs: Any) -> Bools:
    """The current masks, bool of shape (n_envs, n_actions); errors name ``obs``."""
    inside = env.unwrapped
    if isinstance(inside, DummyVecEnv):
        masks = [action_masks(one) for one in inside.envs]
        if any(mask is None for mask in masks):
            check_masks_exist(env)
    else:
        masks = env.env_method(METHOD)
    return checked_masks(masks, obs, int(env.action_space.n))  # type: ignore[attr-defined]


def checked_masks(masks: Any, obs: Any, n_actions: int) -> Bools:
    """Masks as an array, bool of shape (n, n_actions)."""
    for mask, one in zip(masks, obs, strict=True):
        shape, shown = np.shape(mask), " ".join(str(one).split())
        if shape != (n_actions,):
            raise ValueError(
                f"the action mask for observation {shown} has shape {shape}, it must be "
                f"({n_actions},), a bool for each action"
            )
        if not np.any(mask):
            raise ValueError(f"the action mask for observation {shown} allows no action")
    return np.asarray(masks, dtype=np.bool_)


def masks_of_observations(env: VecEnv, n_observations: int) -> Bools | None:
    """The mask of each observation, bool of shape (n_observations, n_actions).

    The row of an observation that no state has is all False. The result is None if masks are not
    known for all states, or differ between environments or between states that look alike.
    """
    inside = env.unwrapped
    if not isinstance(inside, DummyVecEnv):
        return None
    found: Bools | None = None
    for one in inside.envs:
        masks, observations = action_masks_of_states(one), observations_of_states(one)
        if masks is None or observations is None or observations.ndim != 1:
            return None
        by_observation = np.zeros((n_observations, masks.shape[1]), dtype=np.bool_)
        by_observation[observations] = masks
        if not np.array_equal(by_observation[observations], masks):
            return None
        if found is not None and not np.array_equal(found, by_observation):
            return None
        found = by_observation
    return found


class MaskBufferPolicy(TablePolicy):
    """A policy that can store a mask for each observation, also in its model file."""

    # Bool of shape (S, A), rows of False for unknown masks; exists after `keep_masks`.
    allowed_actions: th.Tensor

    def keep_masks(self) -> None:
        """Create the mask buffer if both spaces are `Discrete`."""
        sizes: Any = (self.observation_space, self.action_space)
        shape = tuple(int(space.n) for space in sizes)
        self.register_buffer("allowed_actions", th.zeros(shape, dtype=th.bool))

    @property
    def masks(self) -> Bools:
        """`allowed_actions` as an array that shares its memory; without masks it has no rows."""
        if "allowed_actions" not in self._buffers:
            n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
            return np.zeros((0, n_actions), dtype=np.bool_)
        return np.asarray(self.allowed_actions.numpy())

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Load tables; masks may be missing in the file, and are ignored if unused here."""
        tables = {name: state_dict[name] for name in state_dict if name != "allowed_actions"}
        if "allowed_actions" in self._buffers:
            unknown = th.zeros_like(self.allowed_actions)
            tables["allowed_actions"] = state_dict.get("allowed_actions", unknown)
        return super().load_state_dict(tables, strict, assign)
