"""Playing a trained agent, episode by episode."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipeline.environments import make_evaluation_env
from pipeline.errors import UserError, one_line
from pipeline.model_choice import ChosenModel

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

RenderMode = Literal["human", "ansi", "rgb_array"]

# What an environment draws in these modes is handed over rather than shown at once.
KEPT_MODES: tuple[RenderMode, ...] = ("ansi", "rgb_array")


def playing_env(chosen: ChosenModel, mode: RenderMode | None) -> VecEnv:
    """The VecEnv that a model is played on, drawn in that render mode.

    What is drawn to be handed over is kept until `FrameTaker` asks for it.

    Raises:
        UserError: if the environment cannot be drawn so, or the statistics of its observations
            cannot be read.
    """
    if mode == "rgb_array":
        # Drawing into memory needs no display, and SDL complains where it finds none.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    extra = {} if mode is None else {"render_mode": mode}
    # A VecEnv resets a finished environment at once: frames are kept before that happens.
    wrap_innermost = keep_frames if mode in KEPT_MODES else None
    env: VecEnv = make_evaluation_env(chosen.spec, 1, wrap_innermost=wrap_innermost, **extra)
    if mode is not None and mode not in env.get_attr("metadata")[0].get("render_modes", []):
        raise UserError(f"{chosen.spec.env_id} cannot be rendered as {mode}")
    if chosen.run is not None and chosen.run.vecnormalize_path.exists():
        return _with_statistics(env, chosen.run.vecnormalize_path)
    return env


def keep_frames(env: Any) -> Any:
    """Keep the frames of an environment until they are asked for, over resets too."""
    from gymnasium.wrappers import RenderCollection

    return RenderCollection(env, pop_frames=True, reset_clean=False)


def _with_statistics(env: VecEnv, path: Path) -> VecEnv:
    """The environment with the statistics of training, where it normalises by some."""
    from stable_baselines3.common.vec_env import VecNormalize

    if not isinstance(env, VecNormalize):
        return env
    try:
        env = VecNormalize.load(str(path), env.venv)
    except Exception as error:  # a pickle can fail in any way
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error
    env.training = env.norm_reward = False
    return env


def play_episodes(
    model: BaseAlgorithm,
    env: VecEnv,
    n_episodes: int,
    n_steps: int | None = None,
    *,
    deterministic: bool = True,
    after_step: Callable[[bool], object] = lambda done: None,
) -> Iterator[tuple[float, int]]:
    """Play until so many episodes have ended, or so many steps are done.

    Args:
        model: the agent.
        env: a VecEnv of one environment.
        n_episodes: how many episodes.
        n_steps: how many steps at most, over all episodes; None for any number.
        deterministic: the policy's best actions rather than samples of them.
        after_step: told after each step whether it ended an episode.

    Yields:
        Return and length of each episode as it ends.
    """
    from pipeline.evaluation.mask_telling import player

    choose = player(model, env).predict
    obs: Any = env.reset()
    state = None
    starts = np.ones(1, dtype=bool)
    steps = finished = 0
    while finished < n_episodes and (n_steps is None or steps < n_steps):
        actions, state = choose(obs, state=state, episode_start=starts, deterministic=deterministic)
        obs, _, starts, infos = env.step(actions)
        steps += 1
        after_step(bool(starts[0]))
        if starts[0]:
            finished += 1
            yield infos[0]["episode"]["r"], infos[0]["episode"]["l"]


class FrameTaker:
    """Hands over what an environment has drawn, and keeps the episodes apart.

    Args:
        env: a VecEnv of one environment from `playing_env`, in one of `KEPT_MODES`.
    """

    def __init__(self, env: VecEnv) -> None:
        self.env = env
        self._first_of_next: list[Any] = []

    def take(self, done: bool) -> list[Any]:
        """What was drawn since the last call.

        A VecEnv has begun the next episode by the time that one is done; its first frame waits.

        Args:
            done: whether the last step ended an episode.
        """
        drawn: list[Any] = self._first_of_next + self.env.env_method("render")[0]
        self._first_of_next = [drawn.pop()] if done else []
        return drawn
