"""What a person watching a search sees: a line that moves, or one now and then."""

from __future__ import annotations

import time
from collections.abc import Callable

from rich.console import Console

from commands.live_progress import LiveProgress
from pipeline.signs_of_life import duration

# To read all trials takes time, where there are many.
SECONDS_BETWEEN_QUESTIONS = 5.0


class TuningProgress(LiveProgress):
    """How far a search is, and the best that was found.

    Args:
        console: where to.
        n_trials: how many there are to be.
        ended: says what the trials were judged that have ended, other drivers' among them, by
            number; None for those that were ended early.
        is_cost: whether the lower value is the better.
    """

    def __init__(
        self,
        console: Console,
        n_trials: int,
        ended: Callable[[], dict[int, float | None]],
        *,
        is_cost: bool,
    ) -> None:
        super().__init__(console)
        self.n_trials, self.is_cost = n_trials, is_cost
        self._ended, self._asked_at = ended, time.monotonic()
        self.values = ended()
        self.n_before = len(self.values)
        self.n_runs = 0

    def run_ended(self) -> None:
        """Count a run that has ended."""
        self.n_runs += 1
        if time.monotonic() > self._asked_at + SECONDS_BETWEEN_QUESTIONS:
            self.values, self._asked_at = self._ended(), time.monotonic()
        self.look()

    def trial_ended(self, number: int, value: float | None, reason: str) -> None:
        """Count a trial that has ended; one that is the best so far gets a line that stays."""
        best = self.best()
        self.values[number] = value
        if reason:
            self.say(f"trial {number} failed: {reason}")
        elif value is not None and (best is None or self._is_better(value, best[1])):
            self.say(f"trial {number}: {value:.4g}, the best so far")

    def _is_better(self, value: float, other: float) -> bool:
        return value < other if self.is_cost else value > other

    def best(self) -> tuple[int, float] | None:
        """The best trial and what it was judged; None before there is any."""
        judged = [(number, value) for number, value in self.values.items() if value is not None]
        sign = 1 if self.is_cost else -1
        return min(judged, key=lambda each: (sign * each[1], each[0]), default=None)

    def figures(self) -> str:
        """How many trials have ended, the best of them, and how long the others may take."""
        seconds = time.monotonic() - self.started
        ended, new = len(self.values), len(self.values) - self.n_before
        runs = "1 run" if self.n_runs == 1 else f"{self.n_runs} runs"
        text = f"{ended} of {self.n_trials} trials, {runs} in {duration(seconds)}"
        text += self.place_words
        best = self.best()
        if best is not None:
            text += f"; best {best[1]:.4g} (trial {best[0]})"
        if new > 0 and ended < self.n_trials:
            text += f"; about {duration(seconds / new * (self.n_trials - ended))} left by the clock"
        return text
