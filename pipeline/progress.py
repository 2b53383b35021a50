"""What a person watching a training run sees."""

from __future__ import annotations

import logging
import time

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

from agents.common.callback_horizons import BlockCallback

SECONDS_BETWEEN_UPDATES = 0.1
LINES_WITHOUT_TERMINAL = 10


class CompilationNotice(logging.Handler):
    """Says once that a loop is being compiled, which takes some seconds.

    Args:
        console: where to.
    """

    def __init__(self, console: Console) -> None:
        super().__init__(logging.INFO)
        self.console = console
        self.log = logging.getLogger("mdp.machine_code")
        self.level_before = self.log.level

    def listen(self) -> None:
        """Begin to wait for something to be compiled."""
        self.log.addHandler(self)
        self.log.setLevel(logging.INFO)

    def stop(self) -> None:
        """Say no more; harmless when called again."""
        self.log.removeHandler(self)
        self.log.setLevel(self.level_before)

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.INFO:
            self.stop()
            self.console.print("compiling the training loop (the first time, some seconds)")


class ProgressDisplay(BlockCallback):
    """A live bar in a terminal, a few plain lines elsewhere: steps/s, mean return, time left.

    Args:
        console: where to.
        live: whether to draw a bar that moves.
    """

    def __init__(self, console: Console, live: bool) -> None:
        super().__init__()
        self.console = console
        self.bar: Progress | None = None
        self.live = live
        self.started = 0.0
        self.updated = 0.0
        self.tenths_shown = 0
        self.notice = CompilationNotice(console)

    def _on_training_start(self) -> None:
        self.started = self.updated = time.monotonic()
        self.notice.listen()
        self.first_step = self.num_timesteps
        if self.live:
            self.bar = Progress(
                BarColumn(),
                TaskProgressColumn(),
                TextColumn("{task.fields[figures]}"),
                TimeRemainingColumn(),
                console=self.console,
                auto_refresh=False,
            )
            self.bar.start()
            self.task = self.bar.add_task("training", total=1.0, figures="")

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now - self.updated > SECONDS_BETWEEN_UPDATES:
            self.updated = now
            self._show()
        return True

    def _on_training_end(self) -> None:
        self._show()
        self.close()

    def close(self) -> None:
        """Give the terminal back; may be called again."""
        self.notice.stop()
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    @property
    def share_done(self) -> float:
        """How much of the training is behind."""
        return min(self.num_timesteps / max(self.model._total_timesteps, 1), 1.0)

    def _show(self) -> None:
        if self.bar is not None:
            self.bar.update(
                self.task, completed=self.share_done, figures=self._figures(), refresh=True
            )
        elif not self.live:
            tenths = int(self.share_done * LINES_WITHOUT_TERMINAL)
            if tenths > self.tenths_shown:
                self.tenths_shown = tenths
                self.console.print(f"{self.share_done:4.0%}  {self._figures()}", highlight=False)

    def _figures(self) -> str:
        seconds = max(time.monotonic() - self.started, 1e-9)
        speed = (self.num_timesteps - self.first_step) / seconds
        figures = f"{self.num_timesteps:,} steps  {speed:,.0f} steps/s"
        episodes = self.model.ep_info_buffer
        if episodes:
            mean_return = np.mean([episode["r"] for episode in episodes])
            figures += f"  mean return {mean_return:.2f}"
        return figures
