"""Playing a trained agent: finding it, watching it, filming it."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.wrappers import RenderCollection
from rich.console import Console

from commands.run_output import describe
from commands.train_request import check_algorithm
from pipeline.environments import check_env_id, import_gym_packages, make_evaluation_env
from pipeline.errors import UserError, one_line
from pipeline.model_loading import check_model_file, hand_written_algorithm, load_model, run_of
from pipeline.run_folder import Run
from pipeline.settings import hyperparams
from pipeline.settings.literals import parse_assignments
from pipeline.train_spec import TrainSpec

FILM_SUFFIXES = (".gif", ".mp4")
FRAMES_PER_SECOND = 10


@dataclass(frozen=True)
class ChosenModel:
    """A model file and the run that it comes from.

    Attributes:
        path: the zip.
        spec: how its environments are made.
        run: the run folder, or None for a zip that lies elsewhere.
    """

    path: Path
    spec: TrainSpec
    run: Run | None


def check_recording(record: str | None) -> None:
    """Make sure that a film can be written before anything is played.

    Raises:
        UserError: otherwise.
    """
    if record is None:
        return
    path = Path(record)
    if path.suffix not in FILM_SUFFIXES:
        raise UserError(f"--record writes {' or '.join(FILM_SUFFIXES)} files, not {path.name!r}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--record: there is no folder {path.parent}")
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise UserError("--record to .mp4 needs: pip install 'rl-yardstick[video]'")


def choose_model(args: argparse.Namespace) -> ChosenModel:
    """The model that the arguments of ``enjoy.py`` mean.

    Raises:
        UserError: if there is no such model, or it may not be loaded.
    """
    import_gym_packages(tuple(args.gym_packages))
    if args.model is not None:
        return _model_at(Path(args.model), args)
    algo, env_id = args.algo or "ppo", args.env or "CartPole-v1"
    check_algorithm(algo)
    check_env_id(env_id)
    run = Run.find(Path(args.folder), algo, env_id, args.exp_id)
    path = _file_in(run, args)
    if not path.exists():
        raise UserError(f"{run.path} holds no {path.name}: its training may not have ended")
    check_model_file(path)
    return ChosenModel(path, _spec(algo, env_id, run, args), run)


def _file_in(run: Run, args: argparse.Namespace) -> Path:
    if args.load_best:
        return run.best_model_path
    if args.load_checkpoint is not None:
        return run.checkpoint_path(args.load_checkpoint)
    if args.load_last_checkpoint:
        checkpoints = run.checkpoints()
        if not checkpoints:
            raise UserError(f"{run.path} holds no checkpoint: train with --save-freq")
        return checkpoints[-1]
    return run.model_path


def _model_at(path: Path, args: argparse.Namespace) -> ChosenModel:
    check_model_file(path)
    run = run_of(path)
    recorded = {} if run is None else run.read_info().get("spec", {})
    hand_written = hand_written_algorithm(path)
    algo = args.algo or hand_written or recorded.get("algo")
    env_id = args.env or recorded.get("env_id")
    if algo is None or env_id is None:
        missing = "--algo" if algo is None else "--env"
        raise UserError(f"{path} lies in no run folder: say what it is with {missing}")
    check_algorithm(algo)
    check_env_id(env_id)
    inside = path.resolve().is_relative_to(Path(args.folder).resolve())
    if hand_written is None and not inside and not args.trust:
        raise UserError(
            f"{path} lies outside {args.folder}, and loading a zip of a library agent can run "
            "code that is hidden in it: add --trust if you know where it comes from"
        )
    return ChosenModel(path, _spec(algo, env_id, run, args), run)


def _spec(algo: str, env_id: str, run: Run | None, args: argparse.Namespace) -> TrainSpec:
    """The settings of the run, or the default ones where there is none."""
    recorded = {} if run is None else run.read_info().get("spec", {})
    raw = recorded.get("hyperparams") or hyperparams.read_hyperparams(algo, env_id)
    given = parse_assignments(args.env_kwargs)
    raw = {**raw, "env_kwargs": {**(raw.get("env_kwargs") or {}), **given}}
    return TrainSpec(
        algo=algo,
        env_id=env_id,
        hyperparams=hyperparams.split(raw),
        saved_hyperparams=raw,
        seed=args.seed,
        device=args.device,
        gym_packages=(*recorded.get("gym_packages", ()), *args.gym_packages),
    )


def play(chosen: ChosenModel, args: argparse.Namespace) -> None:
    """Play episodes, show or film them, and print their returns.

    Raises:
        UserError: if the model cannot be loaded or the environment cannot be rendered so.
    """
    import torch as th

    th.set_num_threads(args.num_threads)
    console = Console(highlight=False)
    mode = "rgb_array" if args.record else _render_mode(args.render)
    env = playing_env(chosen, mode)
    model = load_model(chosen.spec.algo, chosen.path, env, device=args.device)
    env.seed(args.seed)
    watcher = Watcher(env, mode, console)
    returns, lengths = [], []
    for total_return, length in play_episodes(model, env, args, watcher.show):
        returns.append(total_return)
        lengths.append(length)
        console.print(f"episode {len(returns)}: return {total_return:.2f}, {length} steps")
    env.close()
    if args.record:
        write_film(Path(args.record), watcher.frames)
        console.print(f"film: {args.record}")
    _print_returns(console, returns, lengths)
    _print_exact(console, chosen.spec, model, deterministic=not args.stochastic)


def _print_exact(console: Console, spec: TrainSpec, model: Any, *, deterministic: bool) -> None:
    """Say what the policy is worth, where that can be computed."""
    from pipeline.evaluation.exact import exact_evaluator

    evaluator = exact_evaluator(spec)
    if evaluator is None:
        return
    try:
        evaluation = evaluator(model, deterministic)
    except (TypeError, ValueError):
        # The probabilities that the agent samples its actions from are not known.
        return
    console.print(describe(evaluation))


def _print_returns(console: Console, returns: list[float], lengths: list[int]) -> None:
    if returns:
        console.print(
            f"return {np.mean(returns):.2f} ± {np.std(returns):.2f} over {len(returns)} episodes, "
            f"length {np.mean(lengths):.1f}"
        )
    else:
        console.print("no episode came to its end: raise --n-timesteps")


def _render_mode(render: str | None) -> str | None:
    """The render mode asked for, or a window where there is a display to show it on."""
    if render == "none":
        return None
    if render is not None:
        return render
    has_display = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    return "human" if has_display else None


def playing_env(chosen: ChosenModel, mode: str | None) -> Any:
    """The VecEnv that a model is played on, drawn in that render mode."""
    from stable_baselines3.common.vec_env import VecNormalize

    if mode == "rgb_array":
        # Drawing into memory needs no display, and SDL complains where it finds none.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    extra = {} if mode is None else {"render_mode": mode}
    # A VecEnv resets a finished environment at once: frames are kept before that happens.
    keep_frames = mode in ("ansi", "rgb_array")
    env = make_evaluation_env(
        chosen.spec,
        1,
        wrap_innermost=collect_frames if keep_frames else None,
        **extra,
    )
    if mode is not None and mode not in env.get_attr("metadata")[0].get("render_modes", []):
        raise UserError(f"{chosen.spec.env_id} cannot be rendered as {mode}")
    statistics = None if chosen.run is None else chosen.run.vecnormalize_path
    if isinstance(env, VecNormalize) and statistics is not None and statistics.exists():
        try:
            env = VecNormalize.load(str(statistics), env.venv)
        except Exception as error:  # a pickle can fail in any way
            raise UserError(f"{statistics} cannot be read: {one_line(error)}") from error
        env.training = env.norm_reward = False
    return env


def collect_frames(env: Any) -> Any:
    """Keep the frames of an environment until they are asked for, over resets too."""
    return RenderCollection(env, pop_frames=True, reset_clean=False)


def play_episodes(
    model: Any, env: Any, args: argparse.Namespace, show: Callable[[bool], None]
) -> Iterator[tuple[float, int]]:
    """Return and length of each episode as it ends."""
    obs, state = env.reset(), None
    starts = np.ones(1, dtype=bool)
    steps = finished = 0
    while finished < args.n_episodes and (args.n_timesteps < 0 or steps < args.n_timesteps):
        actions, state = model.predict(
            obs, state=state, episode_start=starts, deterministic=not args.stochastic
        )
        obs, _, starts, infos = env.step(actions)
        steps += 1
        show(bool(starts[0]))
        if starts[0]:
            finished += 1
            yield infos[0]["episode"]["r"], infos[0]["episode"]["l"]


class Watcher:
    """Prints or keeps what the environment draws.

    Args:
        env: a VecEnv of one environment that keeps its frames.
        mode: ``"ansi"`` prints, ``"rgb_array"`` keeps them in `frames`; else nothing is done.
        console: where to.
    """

    def __init__(self, env: Any, mode: str | None, console: Console) -> None:
        self.env = env
        self.mode = mode
        self.console = console
        self.frames: list[Any] = []
        self._first_of_next: list[Any] = []

    def show(self, done: bool) -> None:
        """Take what was drawn since the last call.

        A VecEnv has begun the next episode by the time that one is done; its first frame waits.
        """
        if self.mode not in ("ansi", "rgb_array"):
            return
        drawn = self._first_of_next + self.env.env_method("render")[0]
        self._first_of_next = [drawn.pop()] if done else []
        if self.mode == "rgb_array":
            self.frames.extend(drawn)
            return
        for text in drawn:
            self.console.file.write(f"{text}\n")


def write_film(path: Path, frames: list[Any]) -> None:
    """Write pictures, uint8 of shape (height, width, 3), as a film: .mp4, and else GIF."""
    if path.suffix != ".mp4":
        from PIL import Image

        pictures = [Image.fromarray(frame) for frame in frames]
        duration = 1000 // FRAMES_PER_SECOND
        pictures[0].save(
            path, "GIF", save_all=True, append_images=pictures[1:], duration=duration, loop=0
        )
        return
    import imageio.v2 as imageio

    # Encoders want even sides.
    even = [frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2] for frame in frames]
    imageio.mimwrite(path, even, fps=FRAMES_PER_SECOND, macro_block_size=1)
