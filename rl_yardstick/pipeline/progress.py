"""Shows the progress of a training run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn

from rl_yardstick.agents.common.callbacks import BlockCallback
from rl_yardstick.pipeline.signs_of_life import (
    SECONDS_BETWEEN_FRAMES,
    SECONDS_BETWEEN_LOOKS,
    SPINNER,
    CompilationNotice,
    Heartbeat,
    Silence,
    duration,
)

SECONDS_BETWEEN_UPDATES = 0.1
SECONDS_BEFORE_THE_FIRST_LINE = 2.0
LINES_WITHOUT_TERMINAL = 10

LEARNING = "learning"
COMPILING = "compiling the training loop"


class ProgressDisplay(BlockCallback):
    """A live bar in a terminal; elsewhere a line per tenth of the training and every 10 s."""

    takes_blocks = True

    def __init__(self, console: Console, live: bool, on_variant: bool = False) -> None:
        super().__init__()
        self.console = console
        self.bar: Progress | None = None
        self.live = live
        self.on_variant = on_variant  # training and evaluation returns differ
        self.has_begun = False
        self.updated = 0.0
        self.tenths_shown = 0
        # Pairs of time and share done; shares are at least a thousandth apart.
        self.marks: list[tuple[float, float]] = []
        self.figures = ""
        self.activity = ""
        self.silence = Silence(SECONDS_BEFORE_THE_FIRST_LINE)
        self.notice = CompilationNotice(self._on_compiling)
        self.heart = Heartbeat(self.look, SECONDS_BETWEEN_FRAMES if live else SECONDS_BETWEEN_LOOKS)

    def _on_training_start(self) -> None:
        self.updated = time.monotonic()
        self.silence = Silence(SECONDS_BEFORE_THE_FIRST_LINE)
        self.notice.listen()
        self.has_begun, self.marks = False, [(self.updated, self.share_done)]
        if self.live:
            self.bar = Progress(
                SpinnerColumn(SPINNER),
                BarColumn(),
                TaskProgressColumn(),
                TextColumn("{task.fields[figures]}"),
                console=self.console,
                auto_refresh=False,
            )
            self.bar.start()
            self.task = self.bar.add_task("training", total=1.0, figures="")
        self.heart.start()

    def _on_rollout_start(self) -> None:
        self.activity = ""
        if not self.has_begun:  # a resumed run has restored its state by now
            self.num_timesteps = self.model.num_timesteps
            self.has_begun, self.marks = True, [(time.monotonic(), self.share_done)]

    def _on_rollout_end(self) -> None:
        self.activity = LEARNING

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now - self.updated > SECONDS_BETWEEN_UPDATES:
            self.updated = now
            self._show()
        return True

    def _on_training_end(self) -> None:
        self.activity = ""
        self._show()
        self.close()

    def close(self) -> None:
        """Release the terminal; may be called repeatedly."""
        self.notice.stop()
        self.heart.stop()
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    @contextmanager
    def doing(self, activity: str) -> Iterator[None]:
        """Name an activity besides training, shown if it takes long."""
        before, self.activity = self.activity, activity
        try:
            yield
        finally:
            self.activity = before

    @property
    def share_done(self) -> float:
        """The finished share of the training."""
        return min(self.num_timesteps / max(self.model._total_timesteps, 1), 1.0)

    def look(self) -> None:
        """Show that the training is alive, also while its progress does not change."""
        if self.bar is not None:
            self._draw()
        elif not self.live and self.silence.is_too_long:
            self._print_line()

    def _show(self) -> None:
        self.figures = self._figures()
        if self.bar is not None:
            self._draw()
        elif not self.live:
            tenths = int(self.share_done * LINES_WITHOUT_TERMINAL)
            if tenths > self.tenths_shown:
                self.tenths_shown = tenths
                self._print_line()

    def _draw(self) -> None:
        if self.bar is not None:
            words = "  ".join(self._words())
            self.bar.update(self.task, completed=self.share_done, figures=words, refresh=True)

    def _print_line(self) -> None:
        self.silence.end()
        line = "  ".join([f"{self.share_done:4.0%}", *self._words()])
        self.console.print(line, highlight=False, soft_wrap=True)

    def _words(self) -> list[str]:
        """The figures, and if the training pauses, the current activity and its duration."""
        words = [self.figures] if self.figures else []
        if self.activity and (seconds := time.monotonic() - self.updated) >= 1:
            words.append(f"{self.activity}, {seconds:.0f} s")
        return words

    def _on_compiling(self) -> None:
        self.activity = COMPILING
        if self.bar is None:
            self.silence.end()
            self.console.print(f"{COMPILING} (the first time, some seconds)", highlight=False)

    def _figures(self) -> str:
        figures = f"{self.num_timesteps:,} steps"
        episodes = self.model.ep_info_buffer
        if episodes:
            mean_return = np.mean([episode["r"] for episode in episodes])
            where = " (on a variant)" if self.on_variant else ""
            figures += f"  mean return in training{where} {mean_return:.2f}"
        left = self._seconds_left()
        return figures if left is None else f"{figures}  about {duration(left)} left by the clock"

    def _seconds_left(self) -> float | None:
        """Estimate by the last half's speed: off-policy agents are faster before they learn."""
        now, share = time.monotonic(), self.share_done
        if share >= self.marks[-1][1] + 0.001:
            self.marks.append((now, share))
        marks = self.marks[1:]
        if not marks or share < marks[0][1] + 0.02:
            return None
        half = (marks[0][1] + share) / 2
        began, before = next(mark for mark in reversed(marks) if mark[1] <= half)
        left = (now - began) * (1 - share) / (share - before)
        return left if share < 1 and left >= 1 else None
