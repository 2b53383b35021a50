"""Tries a user's environment for some steps, before anything learns on it.

The calls must be Gymnasium's, observations must lie in their space, and two copies with one seed
must do the same. Environments of Gymnasium and of this project are not tried.
"""

from __future__ import annotations

import copy
import random
import time
from contextlib import closing
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.utils.env_checker import data_equivalence

from rl_yardstick.envs.wrappers import action_masks
from rl_yardstick.pipeline.environments import Env, creator_of, make_single_env
from rl_yardstick.pipeline.errors import UserError, shown
from rl_yardstick.pipeline.spec import Component, TrainSpec

N_STEPS = 200
MOST_SECONDS = 5.0  # after which a slow environment has been tried long enough
KNOWN = ("rl_yardstick", "gymnasium", "ale_py")
WITHOUT_EPISODE = "rl_yardstick.envs.wrappers.WithoutEpisodeInfo"
ACTION, START = "observation, reward, terminated, truncated, info", "observation, info"


def tried(spec: TrainSpec) -> tuple[TrainSpec, list[str]]:
    """The spec, with a wrapper where the environment needs one, and notes on the environment.

    Raises UserError where nothing can learn. The state of global generators is as before.
    """
    if getattr(creator_of(spec.env_id), "__module__", "").partition(".")[0] in KNOWN:
        return spec, []
    states = random.getstate(), np.random.get_state(), th.get_rng_state()  # noqa: NPY002
    try:
        with closing(make_single_env(spec, training=True, disable_env_checker=True)) as env:
            _check_calls(spec.env_id, env.unwrapped)
        first = _Trial(spec, N_STEPS)
        second = _Trial(spec, len(first.steps))
    except UserError:
        raise
    except (Exception, SystemExit):  # noqa: BLE001  # of the user's code: training will meet it
        return spec, []
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        th.set_rng_state(states[2])
    notes = [first.note] if first.note else []
    if not data_equivalence(first.steps, second.steps, exact=True):
        returns = f"{first.first_return:g} and {second.first_return:g}"
        if first.first_return == second.first_return:
            returns = "other steps the second time"
        notes.append(f"the environment is not reproducible: seed 0 gave {returns}")
    if first.has_episode:
        notes.append("the environment's own info['episode'] is left out: Monitor has one")
        spec = spec.changed(env_wrapper=[*spec.env_wrapper, Component(name=WITHOUT_EPISODE)])
    return spec, notes


def _check_calls(env_id: str, env: Any) -> None:
    """Raise UserError if the environment has the calls of Gym before version 0.26."""
    way_out = "Gymnasium has no apply_api_compatibility any more: wrap or port the environment"
    try:
        found = env.reset(seed=0)
    except TypeError as error:
        if "keyword argument" not in str(error):
            raise
        raise UserError(
            f"{env_id}: Gymnasium calls reset(seed=..., options=...), which the environment "
            f"does not take; {way_out}"
        ) from error
    for call, wanted in (("reset", START), ("step", ACTION)):
        if call == "step":
            found = env.step(copy.deepcopy(env.action_space).sample())
        n_wanted = wanted.count(",") + 1
        if not isinstance(found, tuple) or len(found) != n_wanted:
            given = f"{len(found)} values" if isinstance(found, tuple) else "one value"
            raise UserError(f"{env_id}: {call} returns {given}, not {wanted}; {way_out}")


class _Trial:
    """What a new copy of an environment does with one seed and one sequence of actions."""

    def __init__(self, spec: TrainSpec, n_steps: int) -> None:
        self.spec, self.note, self.has_episode = spec, "", False
        self.steps: list[Any] = []  # observations, rewards and ends
        self.first_return = 0.0
        end = time.monotonic() + MOST_SECONDS
        with closing(make_single_env(spec, training=True, disable_env_checker=True)) as env:
            # An environment may make its own space anew, or seed it, in `reset`.
            self.space, actions = env.observation_space, copy.deepcopy(env.action_space)
            actions.seed(0)
            obs, info = env.reset(seed=0)
            self._see(obs, info, 0)
            is_first = True
            for step in range(1, n_steps + 1):
                obs, reward, terminated, truncated, info = env.step(_chosen(env, actions))
                self._see(obs, info, step)
                self.steps.append((copy.deepcopy(obs), float(reward), terminated, truncated))
                self.first_return += float(reward) * is_first
                if terminated or truncated:
                    is_first = False
                    obs, info = env.reset()
                    self._see(obs, info, step)
                if n_steps == N_STEPS and time.monotonic() > end:
                    break

    def _see(self, obs: Any, info: dict[str, Any], step: int) -> None:
        """Look at an observation; UserError if no agent can use it."""
        self.has_episode |= "episode" in info
        fault = _fault(self.space, obs)
        if fault and isinstance(self.space, spaces.Box) and np.shape(obs) == self.space.shape:
            self.note = self.note or f"observations {fault}, first at step {step}"
        elif fault:
            raise UserError(f"{self.spec.env_id}: at step {step} the observation {fault}")


def _chosen(env: Env, actions: Any) -> Any:
    """A random action, a valid one where the environment has masks."""
    masks = action_masks(env)
    if masks is None or not isinstance(actions, spaces.Discrete):
        return actions.sample()
    return actions.sample(mask=masks.astype(np.int8))


def _fault(space: Any, obs: Any) -> str:
    """Why an observation is not in its space; empty if it is, or if it has no finite numbers."""
    if isinstance(space, spaces.Dict) and isinstance(obs, dict) and {*obs} == {*space}:
        return next((f for key in space if (f := _fault(space[key], obs[key]))), "")
    if isinstance(space, spaces.Box):
        array = np.asarray(obs)
        if array.shape != space.shape:
            return f"has the shape {array.shape}, and its space the shape {space.shape}"
        if not np.can_cast(array.dtype, space.dtype):
            return f"are {array.dtype}, and their space is {space.dtype}"
        is_inside = bool(((array >= space.low) & (array <= space.high))[np.isfinite(array)].all())
        return "" if is_inside else "leave the bounds of their space"
    return "" if space.contains(obs) else f"{shown(obs)} is not in {space}"
