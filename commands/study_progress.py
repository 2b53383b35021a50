"""What a person watching a study sees: one table that moves, or a line now and then."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from commands.live_progress import LiveProgress
from experiments.launching import RunFailure, TimeLeft
from experiments.plan import PlannedRun
from pipeline.signs_of_life import duration


class StudyProgress(LiveProgress):
    """How far the runs of a study are, by agent and environment.

    Args:
        console: where to.
        runs: all runs of the study.
        done: those of them that had been done before.
        expected: seconds of a run, by agent and environment, where something is known of them.
    """

    def __init__(
        self,
        console: Console,
        runs: Sequence[PlannedRun],
        done: Sequence[PlannedRun],
        expected: Mapping[tuple[str, str], float] | None = None,
    ) -> None:
        super().__init__(console)
        there = {run.path for run in done}
        self.left = TimeLeft([run for run in runs if run.path not in there], expected or {})
        self.total = Counter((run.agent, run.environment) for run in runs)
        self.done = Counter((run.agent, run.environment) for run in done)
        self.failed: Counter[tuple[str, str]] = Counter()
        self._refused: set[str] = set()
        self.n_missing = len(runs) - len(done)
        self.n_ended = 0

    def note(self, run: PlannedRun, failure: RunFailure | None) -> None:
        """Count a run that has ended now."""
        self.n_ended += 1
        now = time.monotonic()
        self.left.start(self.started if self.n_ended == 1 else now, self.n_workers)
        self.left.end(run, now)
        self.left.start(now, self.n_workers)
        key = (run.agent, run.environment)
        if failure is None:
            self.done[key] += 1
            self.note_refusal(run)
        else:
            self.failed[key] += 1
            self.say(f"failed: {run.agent} on {run.environment}, seed {run.seed}: {failure.reason}")
        if self.live is None and self.is_over:
            self.say(self.figures())
        else:
            self.look()

    def look(self) -> None:
        """Show how far it is; from the first look on, runs are under way."""
        self.left.start(time.monotonic(), self.n_workers)
        super().look()

    @property
    def n_workers(self) -> int:
        """How many runs are done at once."""
        return 1 if self._launcher is None else self._launcher.n_workers

    def note_refusal(self, run: PlannedRun) -> None:
        """Say once for each environment why its own model is not used, where that is so."""
        refusal = run.run.read_info().get("model_refused")
        if isinstance(refusal, str) and run.environment not in self._refused:
            self._refused.add(run.environment)
            self.say(f"{run.environment}: {refusal}; figures are sampled")

    @property
    def is_over(self) -> bool:
        """Whether all runs have ended."""
        return self.n_ended >= self.n_missing

    def figures(self) -> str:
        """How many runs have ended, and how long the others may take."""
        seconds = time.monotonic() - self.started
        text = f"{self.n_ended} of {self.n_missing} runs in {duration(seconds)}"
        if 0 < self.n_ended < self.n_missing:
            left = self.left.seconds(time.monotonic(), self.n_workers)
            text += "" if left is None else f", about {duration(left)} left by the clock"
        text += self.place_words
        n_failed = self.failed.total()
        return f"{text}, {n_failed} failed" if n_failed else text

    def picture(self) -> Table:
        """The same by agent and environment."""
        table = Table(box=None, pad_edge=False, caption=self.figures(), caption_justify="left")
        for heading in ("agent", "environment", "runs", "", "failed"):
            table.add_column(heading)
        for key, total in self.total.items():
            done, failed = self.done[key], self.failed[key]
            table.add_row(
                *key,
                f"{done}/{total}",
                ProgressBar(total=total, completed=done, width=24),
                Text(str(failed), "red") if failed else "",
            )
        return table
