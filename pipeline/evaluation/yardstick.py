"""What returns are measured against, and when a run has failed."""

from __future__ import annotations

from dataclasses import dataclass

# A score below which a run has failed, and the share of its episodes that count as all.
FAILED, NEARLY_ALL = 0.05, 0.99

# Returns closer than this are equal but for rounding.
ROUNDING = 1e-12

# Where the way from the baseline to the optimum is a smaller share of them, scores say nothing.
LEAST_WAY = 0.01


@dataclass(frozen=True)
class Yardstick:
    """What returns on an environment are measured against."""

    # the highest expected return that any policy has under the time limit. Where that is not known,
    # a return that no policy exceeds.
    optimum: float
    baseline: float  # the highest of uniformly random actions and of each constant action
    # where the optimum is not known, a return that a policy was seen to reach: the optimum is
    # bracketed by the two. None where it is known.
    at_least: float | None = None

    def gap(self, expected_return: float) -> float:
        """How far a return stays behind the optimum, or of a bracket behind its upper end."""
        return self.optimum - expected_return

    def score(self, expected_return: float) -> float:
        """The return on a scale where 1 is the optimum and 0 the best random or constant policy.

        Of a bracket it is measured by the upper end: between 0 and 1 it never says too much.
        """
        rounding = ROUNDING * max(1.0, abs(self.optimum))
        if self.optimum - self.baseline <= rounding:
            return 1.0 if expected_return >= self.optimum - rounding else 0.0
        return (expected_return - self.baseline) / (self.optimum - self.baseline)

    @property
    def has_scale(self) -> bool:
        """Whether the way from the baseline to the optimum is long enough for a score."""
        least = LEAST_WAY * max(abs(self.optimum), abs(self.baseline))
        return self.optimum - self.baseline > least

    @property
    def lower_end(self) -> Yardstick:
        """The yardstick with the lower end of a bracket as optimum."""
        return self if self.at_least is None else Yardstick(self.at_least, self.baseline)

    def figures(self, expected_return: float) -> dict[str, float]:
        """How a return measures, as JSON; of a bracket by both of its ends."""
        found = {"optimum": self.optimum, "baseline": self.baseline}
        found |= {"gap": self.gap(expected_return), "score": self.score(expected_return)}
        if self.at_least is not None:
            found["optimum_at_least"] = self.at_least
            found["gap_at_least"] = self.lower_end.gap(expected_return)
            found["score_at_most"] = self.lower_end.score(expected_return)
        return found
