"""Plays trained agents, episode by episode."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rl_yardstick.pipeline.environments import make_envs
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.models import Model, take_statistics

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

RenderMode = Literal["human", "ansi", "rgb_array"]


def playing_env(
    model: Model,
    mode: RenderMode | None,
    n_envs: int = 1,
    monitor_folder: Path | None = None,
    norm_reward: bool = False,
) -> VecEnv:
    """Make the VecEnv for playing.

    `FrameTaker` returns the frames of the modes ``ansi`` and ``rgb_array``. With ``norm_reward``,
    returns are sums of normalised rewards, as in training.
    """
    if mode == "rgb_array":
        # Rendering into memory needs no display, but SDL complains if there is none.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    extra: dict[str, Any] = {} if mode is None else {"render_mode": mode}
    # A VecEnv resets a finished environment at once, so frames are stored before that.
    wrap_innermost = None
    if mode in ("ansi", "rgb_array"):
        from gymnasium.wrappers import RenderCollection

        wrap_innermost = partial(RenderCollection, pop_frames=True, reset_clean=False)
    spec = model.spec
    env: VecEnv = make_envs(spec, n_envs, monitor_folder, wrap_innermost, **extra)
    if mode is not None and mode not in env.get_attr("metadata")[0].get("render_modes", []):
        raise UserError(f"{spec.env_id} cannot be rendered as {mode}")
    if model.statistics is not None:
        take_statistics(env, model.statistics)
    if not norm_reward:
        return env
    from stable_baselines3.common.vec_env import VecMonitor, unwrap_vec_normalize

    normalization = unwrap_vec_normalize(env)
    if normalization is None:
        raise UserError("--norm-reward: no statistics of VecNormalize belong to this model")
    normalization.norm_reward = True
    with warnings.catch_warnings():
        # Overwriting the statistics of the inner Monitor is intended.
        warnings.filterwarnings("ignore", "The environment is already wrapped with a `Monitor`")
        return VecMonitor(env)


def play_episodes(
    model: BaseAlgorithm,
    env: VecEnv,
    n_episodes: int | None,
    n_steps: int | None = None,
    *,
    deterministic: bool = True,
    when: str = "",
    before_step: Callable[[Any, Any], object] = lambda obs, actions: None,
    after_step: Callable[[bool], object] = lambda done: None,
) -> Iterator[tuple[float, int, bool | None]]:
    """Play a number of episodes, or a number of steps over all environments.

    ``before_step`` gets the observations and the actions; ``after_step`` gets whether the step
    ended an episode of the first environment; ``when`` stands in errors.

    Yields:
        Return and length of each episode as it ends, and its success, None if it is not reported.

    Raises:
        UserError: if numbers are not finite, or the agent takes masks, and there are none.
    """
    from rl_yardstick.agents.common.masks import check_masks_exist, present_masks
    from rl_yardstick.agents.policies import takes_masks
    from rl_yardstick.pipeline.finite_numbers import check_numbers

    told: dict[str, Any] = {"deterministic": deterministic}
    if is_masked := takes_masks(model):
        try:
            check_masks_exist(env)
        except ValueError as error:
            needs = f"{type(model).__name__} needs action masks, and the environment has none"
            raise UserError(needs) from error
    obs: Any = env.reset()
    state = None
    starts = np.ones(env.num_envs, dtype=bool)
    # An equal share for each environment, as in `evaluate_policy`: the first episodes to end over
    # all environments would mostly be short ones.
    due: Any = np.full(env.num_envs, np.inf)
    if n_episodes is not None:
        due = (n_episodes + np.arange(env.num_envs)) // env.num_envs
    steps = 0
    while any(due > 0) and (n_steps is None or steps < n_steps):
        check_numbers(obs, "observation", when or "while it is played", in_rows=True)
        if is_masked:
            told["action_masks"] = present_masks(env, obs)
        actions, state = model.predict(obs, state=state, episode_start=starts, **told)
        before_step(obs, actions)
        obs, _, starts, infos = env.step(actions)
        steps += env.num_envs
        after_step(bool(starts[0]))
        for index in np.flatnonzero(starts & (due > 0)):
            # Missing if a wrapper restarts although the episode itself has not ended.
            episode = infos[index].get("episode")
            if episode is not None:
                due[index] -= 1
                where = when or f"of an episode of environment {index}"
                check_numbers(episode["r"], "return", where)
                yield episode["r"], episode["l"], infos[index].get("is_success")


class FrameTaker:
    """Returns the frames of an environment of `playing_env`, separated by episode."""

    def __init__(self, env: VecEnv) -> None:
        self.env = env
        self._first_of_next: list[Any] = []

    def take(self, done: bool) -> list[Any]:
        """The frames since the last call, except the first frame of the next episode."""
        drawn: list[Any] = self._first_of_next + self.env.env_method("render")[0]
        self._first_of_next = [drawn.pop()] if done else []
        return drawn
