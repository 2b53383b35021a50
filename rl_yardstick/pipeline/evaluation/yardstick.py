"""The scale of returns (baseline and optimum), evaluations, and when a run has failed."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import gymnasium as gym

    from rl_yardstick.mdp.transition_model import Floats

FAILED = 0.05  # a run with a lower score has failed
ROUNDING = 1e-12  # returns closer than this differ only by rounding
# If the gap is smaller, relative to baseline and optimum, scores are meaningless.
LEAST_WAY = 0.01


def rounding(optimum: float) -> float:
    """The error of exact returns: a smaller gap is none."""
    return ROUNDING * max(1.0, abs(optimum))


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


def bracket_of(env: gym.Env[Any, Any]) -> Yardstick | None:
    """The known bracket of an environment's optimum, or None."""
    from rl_yardstick.envs.brackets import optimum_bracket

    found = optimum_bracket(env)
    if found is None:
        return None
    return Yardstick(found.upper, found.baseline, found.lower, found.upper_is_proven)


# --- evaluations ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class OtherReturns:
    """Further exact returns of the final agent; None where unknown."""

    acts_by: str | None = None  # its policy in training, in words: "epsilon 0.01"
    stochastic_return: float | None = None  # of its policy in training
    discount: float | None = None  # the agent's discount
    discounted_return: float | None = None  # of the greedy policy, under that discount
    discounted_optimum: float | None = None  # under that discount; None if the state is hidden


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation: sampled episodes, or their exact expectation."""

    # undiscounted return of each episode, shape (n_episodes,);
    # if exact, the expected return, of shape (1,)
    returns: Floats
    lengths: NDArray[np.floating[Any] | np.integer[Any]]  # number of steps, likewise
    # whether each episode succeeded, or the probability of success, likewise; None if the
    # environment does not report it
    successes: NDArray[np.bool_ | np.floating[Any]] | None
    # exact standard deviation of an episode's return; None for sampled episodes
    exact_std: float | None = None
    yardstick: Yardstick | None = None  # the scale for the return, if known
    others: OtherReturns | None = None  # further returns; None for sampled episodes

    @property
    def is_exact(self) -> bool:
        """Whether the figures are exact expectations."""
        return self.exact_std is not None

    @cached_property
    def mean_return(self) -> float:
        """Mean return of an episode."""
        return float(self.returns.mean())

    @cached_property
    def mean_length(self) -> float:
        """Mean number of steps of an episode."""
        return float(self.lengths.mean())

    @cached_property
    def std_return(self) -> float:
        """Standard deviation of an episode's return."""
        return float(self.returns.std()) if self.exact_std is None else self.exact_std

    @cached_property
    def success_rate(self) -> float | None:
        """Share of successful episodes, if the environment reports success."""
        return None if self.successes is None else float(self.successes.mean())

    def joined(self, more: Evaluation) -> Evaluation:
        """These sampled episodes together with further ones of the same agent."""
        both = None
        if self.successes is not None and more.successes is not None:
            both = np.concatenate([self.successes, more.successes])
        returns = np.concatenate([self.returns, more.returns])
        return Evaluation(returns, np.concatenate([self.lengths, more.lengths]), both)

    def summary(self) -> dict[str, Any]:
        """The figures as JSON."""
        figures: dict[str, Any] = {
            "mean_return": self.mean_return,
            "std_return": self.std_return,
            "mean_length": self.mean_length,
            "success_rate": self.success_rate,
            "exact": self.is_exact,
            "n_episodes": None if self.is_exact else len(self.returns),
        }
        if self.yardstick is not None:
            figures |= self.yardstick.figures(self.mean_return)
        if self.others is not None:
            figures |= asdict(self.others)
        return figures
