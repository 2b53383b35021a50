"""What has become of a run that was sent, and whose fault it was that it has not come back."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from experiments.launching import RunFailure
from experiments.planned_runs import PlannedRun

MOST_TRIES = 3
# Who did nothing wrong is sent again as often as that.
MOST_SENDS = 50


@dataclass
class SentRun:
    """A run under way.

    Only a run that had begun may have to do with the end of its worker. One that merely waited
    there, or whose worker left in good order, or whose scheduler went, is sent again without blame.

    Attributes:
        planned: the run.
        future: what its sender waits for.
        key: its name at the scheduler, another each time.
        task: what the scheduler promises.
        n_sent: how often it was sent.
        n_lost: how often the worker that had begun it was lost.
        n_refused: how often what came back was not the run, or none.
        worker: where it has begun, as far as is known.
        reason: why it was last lost or refused.
    """

    planned: PlannedRun
    future: Future[RunFailure | None] = field(default_factory=Future)
    key: str = ""
    task: Any = None
    n_sent: int = 0
    n_lost: int = 0
    n_refused: int = 0
    worker: str | None = None
    reason: str = ""

    def begin(self, worker: str, has_left: bool) -> None:
        """Note that a worker has begun; where another had before, that one was lost.

        Args:
            worker: its address.
            has_left: whether the one before it left in good order.
        """
        self.lose(has_left)
        self.worker = worker

    def lose(self, has_left: bool) -> None:
        """Note that the worker that had begun is gone, if one had.

        Args:
            has_left: whether it left in good order.
        """
        if self.worker is not None and not has_left:
            self.n_lost += 1
            self.reason = f"the worker that did it was lost {self.n_lost} times ({self.worker})"
        self.worker = None

    def refuse(self, reason: str) -> None:
        """Note that something else than the run came back."""
        self.n_refused += 1
        self.worker = None
        self.reason = f"{self.n_refused} times it did not come back as a run: {reason}"

    @property
    def is_given_up(self) -> bool:
        """Whether it has been tried often enough."""
        is_sent_too_often = self.n_sent >= MOST_SENDS
        if is_sent_too_often and not self.reason:
            self.reason = f"it was sent {self.n_sent} times and never came back"
        return self.n_lost + self.n_refused >= MOST_TRIES or is_sent_too_often
