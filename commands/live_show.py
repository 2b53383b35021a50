"""An agent that plays, in a terminal: one picture of letters that is drawn anew in its place."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text
from stable_baselines3.common.base_class import BaseAlgorithm

from pipeline.action_figures import ActionFigures, action_figures
from pipeline.playing import FrameTaker

BAR = 12  # letters
# Beside the map: a name, a bar and a number.
FIGURES_WIDTH = 36
MOST_ACTIONS = 20


class LiveShow:
    """Draws what the environment shows, with what the agent makes of its actions beside it.

    Args:
        console: a terminal on which what is shown can be replaced.
        model: the agent.
        taker: hands over what the environment draws.
        fps: pictures a second.
        names: what the actions are called; numbers where there are none.
    """

    def __init__(
        self,
        console: Console,
        model: BaseAlgorithm,
        taker: FrameTaker,
        fps: float,
        names: tuple[str, ...] = (),
    ) -> None:
        self.taker = taker
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self._model = model
        self._names = names
        self._pause = 1.0 / fps
        self._step = 0  # of the episode
        self._live = Live(console=console, auto_refresh=False, vertical_overflow="crop")

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Draw while the ``with`` statement runs; the last picture stays."""
        with self._live:
            yield
            if self._step:  # else the end of an episode is shown
                self._draw(self.taker.take(done=False), None, None)

    def before_step(self, obs: Any, actions: Any) -> None:
        """Draw where the agent is, and what it is about to do."""
        figures = action_figures(self._model, obs)
        chosen = int(np.asarray(actions).reshape(-1)[0]) if figures is not None else None
        self._draw(self.taker.take(done=False), figures, chosen)
        time.sleep(self._pause)

    def after_step(self, done: bool) -> None:
        """Draw where an episode has ended."""
        self._step += 1
        if done:
            self._draw(self.taker.take(done=True), None, None)
            time.sleep(self._pause)
            self._step = 0

    def after_episode(self, total_return: float, length: int) -> None:
        """Say above the picture how an episode went."""
        self.returns.append(total_return)
        self.lengths.append(length)
        line = f"episode {len(self.returns)}: return {total_return:.2f}, {length} steps"
        self._live.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def _draw(self, frames: list[Any], figures: ActionFigures | None, chosen: int | None) -> None:
        if frames:
            self._live.update(self._picture(str(frames[-1]), figures, chosen), refresh=True)

    def _picture(
        self, frame: str, figures: ActionFigures | None, chosen: int | None
    ) -> RenderableType:
        drawn = Text.from_ansi(frame.rstrip("\n"), no_wrap=True, overflow="crop")
        title = Text(f"episode {len(self.returns) + 1}, step {self._step}", style="dim")
        if figures is None or chosen is None:
            return Group(title, drawn)
        table = figures_table(figures, chosen, self._names)
        width = max((line.cell_len for line in drawn.split()), default=0)
        if width + FIGURES_WIDTH > self._live.console.width:
            return Group(title, drawn, table)
        beside = Table.grid(padding=(0, 3))
        beside.add_row(drawn, table)
        return Group(title, beside)


def figures_table(figures: ActionFigures, chosen: int, names: tuple[str, ...]) -> Table:
    """A row for each action, with a bar between the lowest and the highest; the chosen one marked.

    Of very many actions the first are shown, and the chosen one.
    """
    table = Table.grid(padding=(0, 1))
    low, high = float(np.min(figures.numbers)), float(np.max(figures.numbers))
    low = 0.0 if figures.word == "probability" else low
    table.add_row("", "action", figures.word, "", style="dim")
    for action, number in enumerate(figures.numbers.tolist()):
        if action >= MOST_ACTIONS and action != chosen:
            continue
        share = (number - low) / (high - low) if high > low else 0.0
        name = names[action] if action < len(names) else str(action)
        bar = "#" * round(BAR * share)
        style = "bold" if action == chosen else ""
        mark = ">" if action == chosen else " "
        table.add_row(mark, Text(name), f"{number:.4g}", Text(bar), style=style)
    return table
