"""Finite environments whose states have places on a map, for looking at."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from envs.finite_env import FiniteEnv
from envs.rendering import GridRenderer
from envs.scene import Scene
from envs.text_rendering import render_text

# Chains that are longer are drawn in several rows, to be read as text is.
LONGEST_ROW = 50


class MapEnv(FiniteEnv):
    """One whose states are shown on a map; its letters are those of `envs.sprites`.

    Attributes:
        rows: the map.
        action_names: what its actions are called.
    """

    rows: tuple[str, ...]
    action_names: ClassVar[tuple[str, ...]]

    def cell_of(self, state: int) -> int:
        """Where a state lies, cells counted row by row: by default states are cells."""
        return state

    def _text(self) -> str:
        return render_text(self._picture())

    def _picture(self) -> Scene:
        name = "start" if self.last_action is None else self.action_names[self.last_action]
        return Scene(self.rows, self.cell_of(self.s), (), (), None, title=name)

    def _make_renderer(self, fps: int, title: str) -> GridRenderer:
        return GridRenderer(self.rows, fps, title)


class ChainEnv(MapEnv):
    """One whose states lie side by side."""

    @abstractmethod
    def letters(self) -> str:
        """The letter of each state, in order."""

    @property
    def rows(self) -> tuple[str, ...]:  # type: ignore[override]
        """The chain, in rows of equal length."""
        letters = self.letters()
        length = min(len(letters), LONGEST_ROW)
        starts = range(0, len(letters), length)
        return tuple(letters[start : start + length].ljust(length, "#") for start in starts)
