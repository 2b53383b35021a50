"""The scale of returns (baseline and optimum), and the limits below which a run has failed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

FAILED = 0.05  # a run with a lower score has failed
ROUNDING = 1e-12  # returns closer than this differ only by rounding
# If the gap is smaller, relative to baseline and optimum, scores are meaningless.
LEAST_WAY = 0.01


def rounding(optimum: float) -> float:
    """The error of exact returns: a smaller gap is none."""
    return ROUNDING * max(1.0, abs(optimum))


def bracket_mark(is_proven: bool) -> str:
    """The remark behind figures of a bracketed optimum."""
    return "(bracketed)" if is_proven else "(bracketed; the upper end is not proven)"


@dataclass(frozen=True)
class HiddenState:
    """The optima of other kinds of agents, if observations hide the state."""

    full_optimum: float  # of policies of the state
    # bounds of the optimum of policies of all observations so far; equal if it is known
    memory_optimum: tuple[float, float]
    with_memory: bool  # whether the yardstick is for agents with memory


@dataclass(frozen=True)
class Yardstick:
    """The baseline and the optimum of an environment."""

    # the highest expected return of any policy under the time limit; if that is not known, an upper
    # bound of it
    optimum: float
    baseline: float  # the highest return of uniformly random or constant actions
    # if the optimum is not known, a return that some policy has reached: the two bracket the
    # optimum. None if the optimum is known.
    at_least: float | None = None
    is_proven: bool = True  # whether the upper end of the bracket, or the optimum, is proven
    # set if observations hide the state; ``optimum`` is then that of policies of observations
    hidden: HiddenState | None = None

    def gap(self, expected_return: float) -> float:
        """The distance of a return from the optimum, or from the upper end of its bracket."""
        return self.optimum - expected_return

    def score(self, expected_return: float) -> float:
        """The score: 1 is the optimum, 0 the best random or constant policy.

        With a bracket, 1 is its upper end, so that a score between 0 and 1 is never too high.
        """
        error = rounding(self.optimum)
        if self.optimum - self.baseline <= error:
            return 1.0 if expected_return >= self.optimum - error else 0.0
        return (expected_return - self.baseline) / (self.optimum - self.baseline)

    @property
    def has_scale(self) -> bool:
        """Whether the gap between baseline and optimum is large enough for a score."""
        least = LEAST_WAY * max(abs(self.optimum), abs(self.baseline))
        return self.optimum - self.baseline > least

    @property
    def lower_end(self) -> Yardstick:
        """This yardstick with the lower end of the bracket as optimum."""
        return self if self.at_least is None else Yardstick(self.at_least, self.baseline)

    def figures(self, expected_return: float) -> dict[str, Any]:
        """Score and gap of a return as JSON; with a bracket, for both of its ends."""
        found: dict[str, Any] = {"optimum": self.optimum, "baseline": self.baseline}
        found |= {"gap": self.gap(expected_return), "score": self.score(expected_return)}
        if self.at_least is not None:
            found["optimum_at_least"] = self.at_least
            found["optimum_is_proven"] = self.is_proven
            found["gap_at_least"] = self.lower_end.gap(expected_return)
            found["score_at_most"] = self.lower_end.score(expected_return)
        if self.hidden is not None:
            found["full_optimum"] = self.hidden.full_optimum
            found["memory_optimum_at_least"], found["memory_optimum"] = self.hidden.memory_optimum
            found["measured_by"] = "memory" if self.hidden.with_memory else "observation"
        return found


def with_memory(figures: dict[str, Any]) -> dict[str, Any]:
    """The figures of a run relative to the optimum of agents with memory."""
    if figures.get("measured_by") != "observation":
        return figures
    lower, upper = figures["memory_optimum_at_least"], figures["memory_optimum"]
    hidden = HiddenState(figures["full_optimum"], (lower, upper), with_memory=True)
    at_least = None if lower == upper else lower
    yardstick = Yardstick(upper, figures["baseline"], at_least, hidden=hidden)
    kept = {name: figures[name] for name in figures if not name.endswith("at_least")}
    kept.pop("score_at_most", None)
    return kept | yardstick.figures(figures["mean_return"])
