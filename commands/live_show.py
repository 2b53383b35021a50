"""An agent that plays, in a terminal: one picture of letters that is drawn anew in its place."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich.cells import cell_len
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text
from stable_baselines3.common.base_class import BaseAlgorithm

from pipeline.action_figures import ActionFigures, action_figures
from pipeline.playing import FrameTaker, Repetition

# In letters: a bar, a number such as -1.235e-05 or "probability", and what lies beside the map.
BAR = 12
NUMBER = 11
FIGURES_WIDTH = 36
GAP = 3
# In lines: what is above the map, what is above the figures, and one for the cursor.
HEADINGS = 3
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
        self._repetition = Repetition()
        self._is_left_out = False
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
        frames = self.taker.take(done=False)
        if frames and self._repetition.goes_on(frames[-1]):
            if not self._is_left_out:
                self._say(f"step {self._step}: it repeats itself, and is not shown any more")
            self._is_left_out = True
            return
        self._is_left_out = False
        figures = action_figures(self._model, obs)
        chosen = int(np.asarray(actions).reshape(-1)[0]) if figures is not None else None
        self._draw(frames, figures, chosen)
        time.sleep(self._pause)

    def after_step(self, done: bool) -> None:
        """Draw where an episode has ended."""
        self._step += 1
        if done:
            self._draw(self.taker.take(done=True), None, None)
            time.sleep(self._pause)
            self._step = 0
            self._repetition.forget()

    def after_episode(self, total_return: float, length: int) -> None:
        """Say above the picture how an episode went."""
        self.returns.append(total_return)
        self.lengths.append(length)
        self._say(f"episode {len(self.returns)}: return {total_return:.2f}, {length} steps")

    def _say(self, line: str) -> None:
        self._live.console.print(line, highlight=False, soft_wrap=True)

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
        lines = drawn.split()
        width = max((line.cell_len for line in lines), default=0)
        columns, rows = self._live.console.width, self._live.console.height - HEADINGS
        is_beside = width + GAP + FIGURES_WIDTH <= columns
        if is_beside:
            columns -= width + GAP
        else:
            rows -= len(lines)
        table = figures_table(figures, chosen, self._names, min(rows, MOST_ACTIONS), columns)
        if not is_beside:
            return Group(title, drawn, table)
        beside = Table.grid(padding=(0, GAP))
        beside.add_row(drawn, table)
        return Group(title, beside)


def figures_table(
    figures: ActionFigures,
    chosen: int,
    names: tuple[str, ...],
    n_shown: int = MOST_ACTIONS,
    width: int = FIGURES_WIDTH,
) -> Table:
    """A row for each action, with a bar between the lowest and the highest; the chosen one marked.

    Columns are as wide whatever they hold, so that nothing moves but what changes.

    Args:
        figures: what the agent makes of its actions.
        chosen: what it is about to do.
        names: what actions are called, as far as they have names.
        n_shown: how many there is room for: the first ones, and the chosen one in any case.
        width: letters that there is room for; bars take what is left, and none where that is none.
    """
    n_shown = max(n_shown, 1)
    shown = [*range(min(n_shown, len(figures.numbers)))]
    if chosen not in shown:
        shown[-1] = chosen
    words = [names[action] if action < len(names) else str(action) for action in shown]
    longest = max(map(cell_len, ["action", *words]))
    bar = max(min(BAR, width - longest - NUMBER - 4), 0)
    table = Table.grid(padding=(0, 1))
    for columns in (1, longest, NUMBER, bar):
        table.add_column(width=columns, no_wrap=True, overflow="crop")
    table.add_row("", "action", figures.word, "", style="dim")
    low, high = float(np.min(figures.numbers)), float(np.max(figures.numbers))
    low = 0.0 if figures.word == "probability" else low
    for action, name in zip(shown, words, strict=True):
        number = float(figures.numbers[action])
        share = (number - low) / (high - low) if 0 < high - low < np.inf else 0.0
        mark, style = (">", "bold") if action == chosen else (" ", "")
        table.add_row(
            mark, Text(name), f"{number:.4g}", Text("#" * round(bar * share)), style=style
        )
    return table
