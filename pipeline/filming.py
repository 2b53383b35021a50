"""Films of trained agents."""

from __future__ import annotations

import errno
import importlib.util
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import UserError
from pipeline.files import replacing
from pipeline.playing import FrameTaker, play_episodes

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

FILM_SUFFIXES = (".gif", ".mp4")
FRAMES_PER_SECOND = 10


def check_film_path(path: Path) -> None:
    """Make sure that a film can be written before anything is played."""
    if path.suffix not in FILM_SUFFIXES:
        raise UserError(f"--record writes {' or '.join(FILM_SUFFIXES)} files, not {path.name!r}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--record: there is no folder {path.parent}")
    if not os.access(path.absolute().parent, os.W_OK):
        raise UserError(f"--record: nothing can be written in {path.parent}")
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise UserError("--record to .mp4 needs: pip install 'rl-yardstick[video]'")


def film_episode(
    model: BaseAlgorithm, env: VecEnv, max_steps: int, *, deterministic: bool
) -> tuple[list[Any], tuple[float, int] | None]:
    """Play an episode, and return its frames; and its return and length, None if it did not end."""
    taker = FrameTaker(env)
    frames: list[Any] = []

    def keep(done: bool) -> None:
        frames.extend(taker.take(done))

    played = play_episodes(model, env, 1, max_steps, deterministic=deterministic, after_step=keep)
    ended = list(played)
    return frames, ended[0] if ended else None


def write_film(path: Path, frames: list[Any]) -> None:
    """Write frames, uint8 of shape (height, width, 3), as a film: .mp4, and else GIF."""
    film = _as_mp4(frames) if path.suffix == ".mp4" else as_gif(frames)
    with replacing(path) as file:
        file.write(film)


def as_gif(frames: list[Any]) -> bytes:
    """The content of a GIF file of frames, uint8 of shape (height, width, 3)."""
    from PIL import Image

    first, *others = [Image.fromarray(frame) for frame in frames]
    duration, film = 1000 // FRAMES_PER_SECOND, io.BytesIO()
    first.save(film, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    return film.getvalue()


def _as_mp4(frames: list[Any]) -> bytes:
    import imageio.v2 as imageio

    # Encoders want even sides.
    even = [frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2] for frame in frames]
    film: bytes = imageio.mimwrite(
        "<bytes>", even, format="mp4", fps=FRAMES_PER_SECOND, macro_block_size=1
    )
    # It goes through a temporary file, and on a full disk nobody says so.
    if b"moov" not in film:
        raise OSError(errno.EIO, "the encoder wrote no whole film: is the disk full?")
    return film
