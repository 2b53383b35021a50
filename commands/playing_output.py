"""What a person sees of an agent that plays: pictures, returns, and what the policy is worth."""

from __future__ import annotations

import os
import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from rich.console import Console

from commands.live_show import LiveShow
from commands.run_output import describe, describe_measured, episodes, print_refusal
from envs.layout import action_names
from pipeline.environments import lacking_packages_told
from pipeline.errors import UserError
from pipeline.evaluation.exact import exact_evaluator, model_refusal
from pipeline.evaluation.policies import why_not_exact
from pipeline.evaluation.sampled import Evaluation, bracketed_yardstick
from pipeline.filming import write_film
from pipeline.models.choose import ChosenModel
from pipeline.models.load import load_to_play, with_normalised_rewards
from pipeline.playing import (
    KEPT_MODES,
    FrameTaker,
    RenderMode,
    Repetition,
    play_episodes,
    playing_env,
)
from pipeline.signs_of_life import Activity, can_move, doing
from pipeline.train_spec import TrainSpec

FRAMES_PER_SECOND = 4


@dataclass(frozen=True)
class PlayingRequest:
    """How an agent is to be played.

    Attributes:
        n_episodes: episodes to play, or None for any number.
        n_steps: steps to play at most, over all environments, or None for any number.
        n_envs: environments to play on at once.
        deterministic: the policy's best actions rather than samples of them.
        render: how to watch: ``"human"``, ``"ansi"``, ``"none"``, or None for a window where there
            is a display to show it on.
        film: a file to write a film to, instead, or None.
        monitor_folder: where to write the returns of the episodes, or None.
        norm_reward: count rewards as training normalised them.
        num_threads: torch threads; below 1 for PyTorch's own choice.
        fps: pictures a second of ``"ansi"`` on a terminal.
    """

    n_episodes: int | None = 10
    n_steps: int | None = None
    n_envs: int = 1
    deterministic: bool = True
    render: str | None = None
    film: Path | None = None
    monitor_folder: Path | None = None
    norm_reward: bool = False
    num_threads: int = 1
    fps: int = FRAMES_PER_SECOND

    @property
    def mode(self) -> RenderMode | None:
        """The render mode of the environment."""
        if self.film is not None:
            return "rgb_array"
        if self.render == "none" or (self.render is None and self.n_envs > 1):
            return None
        if self.render == "ansi":
            return "ansi"
        return "human" if self.render == "human" or has_display() else None


def has_display() -> bool:
    """Whether there is a display to open a window on."""
    return sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )


@dataclass
class _Show:
    """Prints or keeps what is drawn, as it comes, and tells how far the playing is."""

    activity: Activity
    mode: RenderMode | None
    taker: FrameTaker
    frames: list[Any] = field(default_factory=list)
    steps: int = 0
    returns: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    repetition: Repetition = field(default_factory=Repetition)
    n_left_out: int = 0  # pictures

    def shown(self) -> AbstractContextManager[None]:
        # Pictures of letters show by themselves that something goes on.
        return nullcontext() if self.mode == "ansi" else self.activity.shown()

    def before_step(self, obs: Any, actions: Any) -> None:
        """Nothing: what is drawn is shown afterwards."""

    def after_step(self, done: bool) -> None:
        self.steps += 1
        self.activity.at(f"{self.steps:,} steps, {episodes(len(self.returns))}")
        if self.mode not in KEPT_MODES:
            return
        drawn = self.taker.take(done)
        if self.mode == "rgb_array":
            self.frames += drawn
            return
        for text in drawn:
            self._write(text)
        if done:
            self._tell_left_out()
            self.repetition.forget()

    def _write(self, text: str) -> None:
        if self.repetition.goes_on(text):
            self.n_left_out += 1
            return
        self._tell_left_out()
        self.activity.console.file.write(f"{text}\n")

    def _tell_left_out(self) -> None:
        if self.n_left_out:
            steps = f"{self.n_left_out:,} step{'s' if self.n_left_out > 1 else ''}"
            self.activity.say(f"... {steps} left out, which repeat pictures from above")
        self.n_left_out = 0

    def after_episode(self, total_return: float, length: int) -> None:
        self.returns.append(total_return)
        self.lengths.append(length)
        self.activity.say(f"episode {len(self.returns)}: return {total_return:.2f}, {length} steps")


def play(console: Console, chosen: ChosenModel, request: PlayingRequest) -> None:
    """Play episodes, show or film them, and print their returns.

    Args:
        console: where to.
        chosen: the model to play.
        request: how.

    Raises:
        UserError: if the model cannot be loaded or the environment cannot be rendered so.
    """
    if request.num_threads > 0:
        th.set_num_threads(request.num_threads)
    spec = chosen.spec
    with doing(console, "loading the agent"):
        env = playing_env(chosen, request.mode, request.n_envs, request.monitor_folder)
        if request.norm_reward:
            env = with_normalised_rewards(env)
        model = load_to_play(spec.algo, chosen.file, env, spec.device, spec.user_modules)
        env.seed(spec.seed)
    show = _show_of(console, request, model, env)
    with show.shown(), lacking_packages_told(spec.env_id):
        for total_return, length in play_episodes(
            model,
            env,
            request.n_episodes,
            request.n_steps,
            deterministic=request.deterministic,
            before_step=show.before_step,
            after_step=show.after_step,
        ):
            show.after_episode(total_return, length)
    env.close()
    if request.film is not None and isinstance(show, _Show):
        _write_film(console, request.film, show.frames)
        if chosen.run is not None:
            chosen.run.add_file(request.film)
    _print_returns(console, show.returns, show.lengths)
    if show.returns and not request.norm_reward:
        _print_measured(console, spec, show)
    _print_exact(console, spec, model, request.deterministic)


def _show_of(console: Console, request: PlayingRequest, model: Any, env: Any) -> _Show | LiveShow:
    """What shows it: one picture that moves where it can, else what is drawn as it comes."""
    taker = FrameTaker(env)
    if request.mode != "ansi" or not can_move(console) or console.quiet:
        return _Show(Activity(console, "playing"), request.mode, taker)
    return LiveShow(console, model, taker, request.fps, action_names(env.unwrapped.envs[0]))


def _write_film(console: Console, path: Path, frames: list[Any]) -> None:
    if not frames:
        raise UserError("--record: nothing was played, so there is nothing to film")
    with doing(console, "writing the film"):
        write_film(path, frames)
    console.print(f"film: {path}")


def _print_returns(console: Console, returns: list[float], lengths: list[int]) -> None:
    if returns:
        console.print(
            f"return {np.mean(returns):.2f} ± {np.std(returns):.2f} over {episodes(len(returns))}, "
            f"length {np.mean(lengths):.1f}"
        )
    else:
        console.print("no episode came to its end: raise --n-timesteps")


def _print_measured(console: Console, spec: TrainSpec, show: _Show | LiveShow) -> None:
    """Say how the returns stand to the optimum, where that is bracketed."""
    played = Evaluation(np.array(show.returns), np.array(show.lengths), None)
    measured = describe_measured(played.measured_by(bracketed_yardstick(spec)))
    if measured:
        console.print(measured)


def _print_exact(console: Console, spec: TrainSpec, model: Any, deterministic: bool) -> None:
    """Say what the policy is worth, where that can be computed."""
    with doing(console, "working out what the policy is worth"):
        evaluator = exact_evaluator(spec)
        if evaluator is None:
            print_refusal(console, model_refusal(spec))
            return
        obstacle = evaluator.obstacle(model, deterministic)
        if obstacle:
            console.print(f"sampled, not exact: {spec.algo}: {obstacle}", style="dim")
            return
        if why_not_exact(model, evaluator.observations):
            return
        try:
            evaluation = evaluator(model, deterministic)
        except (TypeError, ValueError):
            # The probabilities that the agent samples its actions from are not known.
            return
    console.print(describe(evaluation))
