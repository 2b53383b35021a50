"""What a person watching a study sees: one table that moves, or a line now and then."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Table

from experiments.launching import Launcher, Launchers, RunFailure
from experiments.planned_runs import PlannedRun
from pipeline.signs_of_life import (
    SECONDS_BETWEEN_LINES,
    SECONDS_BETWEEN_LOOKS,
    Heartbeat,
    Silence,
    can_move,
)


class StudyProgress:
    """How far the runs of a study are, by agent and environment.

    Args:
        console: where to.
        runs: all runs of the study.
        done: those of them that had been done before.
    """

    def __init__(
        self, console: Console, runs: Sequence[PlannedRun], done: Sequence[PlannedRun]
    ) -> None:
        self.console = console
        self.total = Counter((run.agent, run.environment) for run in runs)
        self.done = Counter((run.agent, run.environment) for run in done)
        self.failed: Counter[tuple[str, str]] = Counter()
        self._refused: set[str] = set()
        self.n_missing = len(runs) - len(done)
        self.n_ended = 0
        self.started = time.monotonic()
        self.silence = Silence(SECONDS_BETWEEN_LINES)
        self.live = Live(console=console, auto_refresh=False) if can_move(console) else None
        self.heart = Heartbeat(self.look, SECONDS_BETWEEN_LOOKS)
        self._launcher: Launcher | None = None

    def __enter__(self) -> StudyProgress:
        if self.live is not None:
            self.live.start()
            self._draw()
        self.heart.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.heart.stop()
        if self.live is not None:
            self._draw()
            self.live.stop()
        if isinstance(error, KeyboardInterrupt):
            self.console.print(f"{self._figures()}; the same command goes on", highlight=False)

    def watching(self, launchers: Launchers) -> Launchers:
        """The same launchers, of which is shown what there is to say while one is open."""

        @contextlib.contextmanager
        def watched() -> Iterator[Launcher]:
            with launchers() as self._launcher:
                yield self._launcher
            self._launcher = None

        return watched

    def note(self, run: PlannedRun, failure: RunFailure | None) -> None:
        """Count a run that has ended now."""
        self.n_ended += 1
        key = (run.agent, run.environment)
        if failure is None:
            self.done[key] += 1
            self.note_refusal(run)
        else:
            self.failed[key] += 1
            self.console.print(
                f"failed: {run.agent} on {run.environment}, seed {run.seed}: {failure.reason}",
                markup=False,
                highlight=False,
            )
        if self.live is None and self.n_ended == self.n_missing:
            self._print_line()
        else:
            self.look()

    def note_refusal(self, run: PlannedRun) -> None:
        """Say once for each environment why its own model is not used, where that is so."""
        refusal = run.run.read_info().get("model_refused")
        if isinstance(refusal, str) and run.environment not in self._refused:
            self._refused.add(run.environment)
            self.console.print(
                f"{run.environment}: {refusal}; figures are sampled",
                markup=False,
                highlight=False,
                soft_wrap=True,
            )

    def look(self) -> None:
        """Show how far the study is, also while no run ends."""
        if self.live is not None:
            self._draw()
        elif self.n_ended < self.n_missing and self.silence.is_too_long:
            self._print_line()

    def _draw(self) -> None:
        if self.live is not None:
            self.live.update(self._table(), refresh=True)

    def _print_line(self) -> None:
        self.silence.end()
        self.console.print(self._figures(), highlight=False)

    def _figures(self) -> str:
        seconds = time.monotonic() - self.started
        text = f"{self.n_ended} of {self.n_missing} runs in {_duration(seconds)}"
        if 0 < self.n_ended < self.n_missing:
            left = seconds / self.n_ended * (self.n_missing - self.n_ended)
            text += f", about {_duration(left)} left"
        words = self._launcher.words if self._launcher is not None else ""
        text += f", {words}" if words else ""
        n_failed = self.failed.total()
        return f"{text}, {n_failed} failed" if n_failed else text

    def _table(self) -> Table:
        table = Table(box=None, pad_edge=False, caption=self._figures(), caption_justify="left")
        for heading in ("agent", "environment", "runs", "", "failed"):
            table.add_column(heading)
        for key, total in self.total.items():
            done, failed = self.done[key], self.failed[key]
            table.add_row(
                *map(escape, key),
                f"{done}/{total}",
                ProgressBar(total=total, completed=done, width=24),
                f"[red]{failed}[/]" if failed else "",
            )
        return table


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
