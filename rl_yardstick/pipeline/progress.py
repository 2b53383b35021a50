"""The progress of a training: a live bar on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from rl_yardstick.agents.common.callbacks import BlockCallback

UPDATES = 400  # of a training's bar
SECONDS_BETWEEN_LINES = 10.0


class ProgressCallback(BlockCallback):
    """Tells the steps, the mean return of training's last episodes, and the time that is left.

    Args:
        console: where it is told.
        n_timesteps: steps of the training.
        on_variant: whether training's environment differs from the one of evaluations.
    """

    excluded_from_states = ("console", "bar", "task", "told_at")

    def __init__(self, console: Console, n_timesteps: int, on_variant: bool = False) -> None:
        super().__init__()
        self.console, self.on_variant = console, on_variant
        # A block of compiled training ends where a callback acts: nobody reads a quiet console.
        self.every_n_steps = min(max(n_timesteps // UPDATES, 1), 20_000)
        if console.quiet:
            self.every_n_steps = max(n_timesteps, 1)
        self.bar: Progress | None = None
        self.task: Any = None
        self.told_at = time.monotonic()

    def _on_training_start(self) -> None:
        self.told_at = time.monotonic()
        if self.console.is_terminal and not self.console.quiet:
            columns = BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
            figures = TextColumn("{task.description}")
            self.bar = Progress(*columns, figures, console=self.console, transient=True)
            self.bar.start()
            self.task = self.bar.add_task("", total=1.0)

    def _on_step(self) -> bool:
        share = min(self.num_timesteps / max(self.model._total_timesteps, 1), 1.0)
        if self.bar is not None:
            self.bar.update(self.task, completed=share, description=self._figures())
        elif time.monotonic() - self.told_at > SECONDS_BETWEEN_LINES:
            self.told_at = time.monotonic()
            self.console.print(f"{share:4.0%}  {self._figures()}", highlight=False)
        return True

    def _on_training_end(self) -> None:
        self.close()

    def close(self) -> None:
        """Give the terminal back; may be called repeatedly."""
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    def _figures(self) -> str:
        figures = f"{self.num_timesteps:,} steps"
        if episodes := self.model.ep_info_buffer:
            where = " (on a variant)" if self.on_variant else ""
            mean = np.mean([episode["r"] for episode in episodes])
            figures += f"  mean return in training{where} {mean:.2f}"
        return figures
