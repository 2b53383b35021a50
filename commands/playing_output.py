"""What a person sees of an agent that plays: pictures, returns, and what the policy is worth."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from rich.console import Console

from commands.run_output import describe
from pipeline.errors import UserError
from pipeline.evaluation.exact import exact_evaluator
from pipeline.filming import write_film
from pipeline.model_choice import ChosenModel
from pipeline.model_loading import load_model
from pipeline.playing import KEPT_MODES, FrameTaker, RenderMode, play_episodes, playing_env
from pipeline.train_spec import TrainSpec


@dataclass(frozen=True)
class PlayingRequest:
    """How an agent is to be played.

    Attributes:
        n_episodes: episodes to play.
        n_steps: steps to play at most, or None for any number.
        deterministic: the policy's best actions rather than samples of them.
        render: how to watch: ``"human"``, ``"ansi"``, ``"none"``, or None for a window where there
            is a display to show it on.
        film: a file to write a film to, instead, or None.
        num_threads: torch threads.
    """

    n_episodes: int = 10
    n_steps: int | None = None
    deterministic: bool = True
    render: str | None = None
    film: Path | None = None
    num_threads: int = 1

    @property
    def mode(self) -> RenderMode | None:
        """The render mode of the environment."""
        if self.film is not None:
            return "rgb_array"
        if self.render == "none":
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
    """Prints or keeps what is drawn, as it comes."""

    console: Console
    mode: RenderMode | None
    taker: FrameTaker
    frames: list[Any] = field(default_factory=list)

    def after_step(self, done: bool) -> None:
        if self.mode not in KEPT_MODES:
            return
        drawn = self.taker.take(done)
        if self.mode == "rgb_array":
            self.frames += drawn
            return
        for text in drawn:
            self.console.file.write(f"{text}\n")


def play(chosen: ChosenModel, request: PlayingRequest) -> None:
    """Play episodes, show or film them, and print their returns.

    Raises:
        UserError: if the model cannot be loaded or the environment cannot be rendered so.
    """
    th.set_num_threads(request.num_threads)
    console = Console(highlight=False)
    env = playing_env(chosen, request.mode)
    spec = chosen.spec
    model = load_model(spec.algo, chosen.path, env, device=spec.device)
    env.seed(spec.seed)
    show = _Show(console, request.mode, FrameTaker(env))
    returns, lengths = [], []
    for total_return, length in play_episodes(
        model,
        env,
        request.n_episodes,
        request.n_steps,
        deterministic=request.deterministic,
        after_step=show.after_step,
    ):
        returns.append(total_return)
        lengths.append(length)
        console.print(f"episode {len(returns)}: return {total_return:.2f}, {length} steps")
    env.close()
    if request.film is not None:
        _write_film(console, request.film, show.frames)
    _print_returns(console, returns, lengths)
    _print_exact(console, spec, model, request.deterministic)


def _write_film(console: Console, path: Path, frames: list[Any]) -> None:
    if not frames:
        raise UserError("--record: nothing was played, so there is nothing to film")
    write_film(path, frames)
    console.print(f"film: {path}")


def _print_returns(console: Console, returns: list[float], lengths: list[int]) -> None:
    if returns:
        console.print(
            f"return {np.mean(returns):.2f} ± {np.std(returns):.2f} over {len(returns)} episodes, "
            f"length {np.mean(lengths):.1f}"
        )
    else:
        console.print("no episode came to its end: raise --n-timesteps")


def _print_exact(console: Console, spec: TrainSpec, model: Any, deterministic: bool) -> None:
    """Say what the policy is worth, where that can be computed."""
    evaluator = exact_evaluator(spec)
    if evaluator is None:
        return
    obstacle = evaluator.obstacle(model)
    if obstacle:
        console.print(f"[dim]sampled, not exact: {spec.algo}: {obstacle}[/]")
        return
    try:
        evaluation = evaluator(model, deterministic)
    except (TypeError, ValueError):
        # The probabilities that the agent samples its actions from are not known.
        return
    console.print(describe(evaluation))
