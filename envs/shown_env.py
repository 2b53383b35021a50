"""What environments share that can be looked at: as text, as a picture, in a window."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.argument_checks import check_choice
from envs.rendering import Renderer

RENDER_MODES = ("ansi", "rgb_array", "human")


class ShownEnv(gym.Env[Any, Any], ABC):
    """An environment with the three ways of looking at it.

    Args:
        render_mode: ``"ansi"``, ``"rgb_array"``, ``"human"`` or None.

    Raises:
        ValueError: if it is none of these.
    """

    # Not annotated as ClassVar, since Gymnasium declares it as an attribute of the instance.
    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 8}  # noqa: RUF012

    def __init__(self, render_mode: str | None) -> None:
        if render_mode is not None:
            check_choice("render_mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self._renderer: Renderer | None = None

    def render(self) -> str | NDArray[np.uint8] | None:
        """As text (``ansi``), as a picture of shape (height, width, 3), or in a window."""
        if self.render_mode is None:
            gym.logger.warn("render() does nothing: the environment was made without render_mode")
            return None
        if self.render_mode == "ansi":
            return self._text()
        if self._renderer is None:
            title = type(self).__name__ if self.spec is None else self.spec.id
            self._renderer = self._make_renderer(self.metadata["render_fps"], title)
        if self.render_mode == "rgb_array":
            return self._renderer.pixels(self._picture())
        self._renderer.show(self._picture())
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    @abstractmethod
    def _text(self) -> str:
        """The state as text."""

    @abstractmethod
    def _picture(self) -> Any:
        """The state as what the renderer paints."""

    @abstractmethod
    def _make_renderer(self, fps: int, title: str) -> Renderer:
        """What paints the pictures."""
