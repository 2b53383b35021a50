"""Figures on many runs on a bandit, pull by pull."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mdp.array_types import AnyInts, Floats, Ints
from pipeline.digests import DamagedFileError, read_arrays
from pipeline.files import replacing
from pipeline.runs import Run

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
FIRST_PULLS = 100  # kept one by one; of later ones fewer and fewer, `MAX_POINTS` in all
MAX_POINTS = 300


@dataclass(frozen=True)
class PullStatistics:
    """Figures over the runs of one agent on one bandit, and the totals of each run.

    Regret is the best expected reward less that of the arm pulled. Simple regret is that of
    recommending the arm pulled most so far (Bubeck, Munos and Stoltz, 2009), in each context.

    Attributes:
        pulls: the pulls that the figures are given at, counted from 1, shape (n_points,).
        reward: mean reward of a pull since the point before, shape (n_points,).
        optimal: share of those pulls that were of a best arm, shape (n_points,).
        regret: mean regret of those pulls, shape (n_points,).
        cumulative_regret: mean sum of the regrets up to the point, shape (n_points,).
        cumulative_regret_sem: its standard error over runs, shape (n_points,).
        cumulative_regret_quantiles: over runs, see `QUANTILES`, shape (n_quantiles, n_points).
        simple_regret: mean over runs, shape (n_points,).
        total_reward: of each run, shape (n_runs,).
        total_regret: of each run, shape (n_runs,).
        shares: share of the pulls that went to each arm, by context, shape (n_contexts, n_arms).
        context_regret: mean regret of a pull, by context and arm; nan where it was never pulled,
            shape (n_contexts, n_arms).
        estimates: mean of the final estimates over runs, shape (n_contexts, n_arms); empty where
            the agent has none.
        estimates_std: their standard deviation over runs, likewise.
        true_means: of the arms, where all runs have the same, likewise; else empty.
        moments: pulls after which posteriors were kept, shape (n_moments,).
        posteriors: of the first run's arms: parameters of Beta distributions, or mean and standard
            deviation, shape (n_moments, n_contexts, n_arms, 2); else empty.
    """

    pulls: Ints
    reward: Floats
    optimal: Floats
    regret: Floats
    cumulative_regret: Floats
    cumulative_regret_sem: Floats
    cumulative_regret_quantiles: Floats
    simple_regret: Floats
    total_reward: Floats
    total_regret: Floats
    shares: Floats
    context_regret: Floats
    estimates: Floats
    estimates_std: Floats
    true_means: Floats
    moments: Ints
    posteriors: Floats

    def save(self, path: Path) -> None:
        """Write all arrays to a NumPy archive."""
        arrays: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        with replacing(path) as file:
            np.savez(file, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: Path) -> PullStatistics:
        """Read what `save` wrote.

        Raises:
            DamagedFileError: if the file is missing or changed, or holds anything else.
        """
        arrays = read_arrays(path, Run(path.parent, "").files.read(path))
        names = [field.name for field in fields(cls)]
        lacking = [name for name in names if name not in arrays]
        if lacking:
            raise DamagedFileError(path, f"is damaged: it lacks {lacking[0]}")
        statistics = cls(**{name: arrays[name] for name in names})
        if not statistics._is_of_one_shape():
            raise DamagedFileError(path, "is damaged: its arrays do not fit each other")
        return statistics

    def _is_of_one_shape(self) -> bool:
        """Whether the arrays have the shapes that the class says."""
        n_points, n_runs = self.pulls.size, self.total_reward.size
        shapes = {
            (n_points,): (
                self.pulls,
                self.reward,
                self.optimal,
                self.regret,
                self.cumulative_regret,
                self.cumulative_regret_sem,
                self.simple_regret,
            ),
            (len(QUANTILES), n_points): (self.cumulative_regret_quantiles,),
            (n_runs,): (self.total_reward, self.total_regret),
            self.shares.shape: (self.shares, self.context_regret),
        }
        fits = all(array.shape == shape for shape, arrays in shapes.items() for array in arrays)
        return (
            fits
            and self.shares.ndim == 2
            and n_points > 0
            # An agent that sees no contexts has one row of estimates for all of them.
            and self.estimates.shape == self.estimates_std.shape
            and self.estimates.ndim == self.true_means.ndim == 2
            and self.posteriors.ndim == 4
            and (not self.posteriors.size or self.posteriors.shape[0] == self.moments.size)
        )


def points_of(n_pulls: int) -> Ints:
    """The pulls to give figures at: the first one by one, later ones ever further apart."""
    if n_pulls <= MAX_POINTS:
        return np.arange(1, n_pulls + 1)
    first = np.arange(1, FIRST_PULLS + 1)
    rest = np.geomspace(FIRST_PULLS + 1, n_pulls, MAX_POINTS - FIRST_PULLS)
    return np.unique(np.concatenate([first, rest.round().astype(np.int64)]))


def pull_statistics(
    arms: AnyInts,
    rewards: NDArray[np.floating[Any]],
    regrets: Floats,
    contexts: AnyInts | None,
    n_arms: int,
    n_contexts: int = 1,
    estimates: Floats | None = None,
    true_means: Floats | None = None,
    moments: tuple[int, ...] = (),
    posteriors: Floats | None = None,
) -> PullStatistics:
    """Sum up runs; arrays have a row for each run and a column for each pull.

    Args:
        arms: what was pulled, shape (n_runs, n_pulls).
        rewards: what it gave, likewise.
        regrets: of each pull, likewise.
        contexts: what the arm was chosen in, likewise; None where there is but one.
        n_arms: how many arms there are.
        n_contexts: how many contexts.
        estimates: of each run at its end, shape (n_runs, n_contexts, n_arms).
        true_means: of the arms, where all runs have the same, shape (n_contexts, n_arms).
        moments: after how many pulls posteriors were kept.
        posteriors: shape (n_runs, n_moments, n_contexts, n_arms, 2).
    """
    points = points_of(arms.shape[1])
    at = points - 1
    cumulative = np.cumsum(regrets, axis=1)
    cells = arms.astype(np.int64) + n_arms * (0 if contexts is None else contexts.astype(np.int64))
    size = n_arms * n_contexts
    counts = np.bincount(cells.ravel(), minlength=size).reshape(n_contexts, n_arms)
    sums = np.bincount(cells.ravel(), weights=regrets.ravel(), minlength=size)
    empty = np.empty((0, 0))
    with np.errstate(invalid="ignore"):
        context_regret = sums.reshape(n_contexts, n_arms) / counts
        shares = counts / counts.sum(axis=1, keepdims=True)
    n_runs = len(arms)
    mean, std = _mean_and_std(empty[None] if estimates is None else estimates)
    return PullStatistics(
        pulls=points,
        reward=_mean_since_last(rewards.mean(axis=0, dtype=np.float64), points),
        optimal=_mean_since_last((regrets == 0.0).mean(axis=0), points),
        regret=_mean_since_last(regrets.mean(axis=0), points),
        cumulative_regret=cumulative[:, at].mean(axis=0),
        cumulative_regret_sem=cumulative[:, at].std(axis=0, ddof=min(1, n_runs - 1)) / n_runs**0.5,
        cumulative_regret_quantiles=np.quantile(cumulative[:, at], QUANTILES, axis=0),
        simple_regret=_simple_regret(cells, regrets, at, (n_contexts, n_arms)),
        total_reward=rewards.sum(axis=1, dtype=np.float64),
        total_regret=cumulative[:, -1],
        shares=shares,
        context_regret=context_regret,
        estimates=mean,
        estimates_std=std,
        true_means=empty if true_means is None else true_means,
        moments=np.array(moments, dtype=np.int64),
        posteriors=np.empty((0, 0, 0, 2)) if posteriors is None else posteriors[0],
    )


def _mean_and_std(estimates: Floats) -> tuple[Floats, Floats]:
    """Over runs, leaving out nan; nan where no run has a figure."""
    is_known = ~np.isnan(estimates)
    with np.errstate(invalid="ignore"):
        n_known = is_known.sum(axis=0)
        mean = np.where(is_known, estimates, 0.0).sum(axis=0) / n_known
        squares = np.where(is_known, estimates - mean, 0.0) ** 2
        return mean, np.sqrt(squares.sum(axis=0) / n_known)


def _mean_since_last(by_pull: Floats, points: Ints) -> Floats:
    """Means over the pulls from one point, not included, to the next."""
    sums = np.cumsum(by_pull)[points - 1]
    return np.asarray(np.diff(sums, prepend=0.0) / np.diff(points, prepend=0))


def _simple_regret(cells: Ints, regrets: Floats, at: Ints, shape: tuple[int, int]) -> Floats:
    """Mean over runs of what recommending the arm pulled most so far falls short by.

    Args:
        cells: which context and arm, as one number, shape (n_runs, n_pulls).
        regrets: likewise.
        at: the pulls to give it at, counted from 0.
        shape: numbers of contexts and arms.
    """
    n_runs, rows = len(cells), np.arange(len(cells))
    counts = np.zeros((n_runs, shape[0] * shape[1]))
    sums = np.zeros_like(counts)
    result, begin = np.empty(len(at)), 0
    for index, last in enumerate(at.tolist()):
        for pull in range(begin, last + 1):
            counts[rows, cells[:, pull]] += 1
            sums[rows, cells[:, pull]] += regrets[:, pull]
        begin = last + 1
        by_context = counts.reshape(n_runs, *shape)
        most = by_context.argmax(axis=2)[..., None]
        n_most = np.take_along_axis(by_context, most, axis=2)[..., 0]
        regret_of_most = np.take_along_axis(sums.reshape(n_runs, *shape), most, axis=2)[..., 0]
        # Contexts count as often as they were seen.
        weights = by_context.sum(axis=2) / (last + 1)
        result[index] = (weights * regret_of_most / np.maximum(n_most, 1)).sum(axis=1).mean()
    return result
