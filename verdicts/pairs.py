"""Verdicts on pairs of agents: tests corrected for their number, effect sizes, power."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from verdicts.error_levels import level_of_claim, level_of_look
from verdicts.means import (
    FEWEST_SEEDS,
    MeanDifference,
    MeanVerdict,
    Verdict,
    compare_means,
    fewest_for,
    judge_means,
    opposite,
    rank_by_mean,
    seeds_needed,
)
from verdicts.rank_tests import (
    ahead_p_value,
    apart_p_value,
    differences,
    equivalent_p_value,
    holm,
    same_shape,
    wins_of,
)
from verdicts.resampling import (
    N_RESAMPLES,
    Counts,
    Estimate,
    Floats,
    as_columns,
    check_confidence,
    interval_tail,
    percentile_interval,
    resample_counts,
)


def fewest_seeds(level: float, n_pairs: int = 1) -> int:
    """The fewest seeds that can decide about means, where ``n_pairs`` pairs share a level."""
    return fewest_for(level_of_claim(level, "means") / n_pairs)


# Verdicts on pairs of agents: on their means and on their typical runs.


@dataclass(frozen=True)
class Judgement:
    """Verdicts on the first agent of a pair."""

    mean: MeanVerdict  #: the verdict on the means
    #: On typical runs: ``better`` or ``worse`` if a run of one scores higher than one of the
    #: other more often than not; ``equivalent`` if neither does by more than the margin.
    typical: Verdict
    #: Whether both agents are deterministic, so that there was nothing to test.
    certain: bool = False

    @property
    def is_decided(self) -> bool:
        """Whether there is a verdict on the means, conditional or not."""
        return self.mean.verdict != "undecided"


@dataclass(frozen=True)
class Ends:
    """The ends of the scale on which means are judged; scores beyond an end count as that end."""

    low: float  #: the lowest score that a run may have
    high: float  #: the highest

    @staticmethod
    def beyond(scores: Mapping[str, Floats]) -> Ends:
        """Ends for an unknown scale: the observed range, extended by its length on each side."""
        values = np.concatenate([*scores.values(), []])
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        reach = high - low if high > low else 1.0
        return Ends(low - reach, high + reach)

    def shares(self, values: Floats) -> Floats:
        """Scores as shares of the scale, from 0 at the lower end to 1 at the upper."""
        return np.clip((values - self.low) / (self.high - self.low), 0.0, 1.0)


def judge_pairs(
    scores: Mapping[str, Floats],
    margin: float,
    level: float,
    certain: Collection[str] = (),
    decided: Mapping[tuple[str, str], Judgement] | None = None,
    *,
    ends: Ends | None = None,
    paired: bool = False,
    against: str = "",
) -> dict[tuple[str, str], Judgement]:
    """Judge every two agents, in the order of the mapping.

    The verdicts on means are those of simultaneous intervals, one for each pair; those on typical
    runs are corrected by Holm's procedure.

    Args:
        scores: by agent, shape (n_seeds,); a non-finite score is a missing run.
        margin: the largest difference that does not matter.
        level: the share of studies in which any claim about means, typical runs, failures or speed
            may be wrong; see ``SHARES``.
        certain: the deterministic agents. Two of these are compared by their scores, without a
            test, and the other pairs keep the whole level.
        decided: the pairs that an earlier look decided, in the same order; see ``grow``. They keep
            their judgement. None for a single look: half of the error rate for means is then
            spent on the ranking, see ``rank_by_mean``.
        ends: the ends of the scores' scale; None for ``Ends.beyond``.
        paired: whether the agents' runs of one seed share their randomness.
        against: the only agent whose mean the others are compared with. Other pairs are not tested:
            they are undecided, unless two tested pairs imply a verdict. Empty for all pairs.
    """
    earlier = dict(decided or {})
    ends = ends or Ends.beyond(scores)
    pairs = list(combinations(scores, 2))
    known = {(a, b) for a, b in pairs if a in certain and b in certain} - earlier.keys()
    tested = [pair for pair in pairs if pair not in known and pair not in earlier]
    for_means = level_of_claim(level, "means")
    ranks = decided is None and len(scores) > 2 and not against
    if ranks:
        for_means /= 2  # the other half is for the ranking
    compared = {pair for pair in pairs if not against or against in pair}
    share = for_means / max(len(compared - known), 1)
    runs = {pair: _runs(scores, pair, paired=paired) for pair in tested}
    means = {}
    for pair, (x, y) in runs.items():
        if pair not in compared:
            means[pair] = MeanVerdict("undecided")
            continue
        means[pair] = judge_means(
            ends.shares(x),
            ends.shares(y),
            share,
            margin=margin / (ends.high - ends.low),
            paired=paired,
            exact=(pair[0] in certain, pair[1] in certain),
        )
    typical = _typical(runs, margin, level_of_claim(level, "typical"), len(earlier))
    if ranks:
        seen, sure = (
            _ahead_of_all(scores, for_means, certain, ends, paired=paired, seen_only=seen_only)
            for seen_only in (True, False)
        )
        for a, b in seen:
            _say(means, (a, b), MeanVerdict("better", is_conditional=True))
        for a, b in sure:
            _say(means, (a, b), MeanVerdict("better"))
    _close(means)
    judged = {pair: Judgement(means[pair], typical[pair]) for pair in tested}
    for a, b in known:
        judged[a, b] = _known(scores[a], scores[b], margin)
    return {pair: earlier.get(pair) or judged[pair] for pair in pairs}


def _say(
    means: dict[tuple[str, str], MeanVerdict],
    pair: tuple[str, str],
    said: MeanVerdict,
) -> None:
    """Replace the verdict on a pair by one that says more."""
    if pair not in means:
        pair, said = pair[::-1], said.swapped()
    known = means.get(pair, MeanVerdict("equivalent"))
    if known.verdict == "undecided" or (
        not said.is_conditional and known != MeanVerdict("equivalent")
    ):
        means[pair] = said


def _close(means: dict[tuple[str, str], MeanVerdict]) -> None:
    """Add what follows by transitivity: if a is better than b and b than c, a is better than c."""
    better = {pair for pair, said in means.items() if said == MeanVerdict("better")}
    better |= {(b, a) for (a, b), said in means.items() if said == MeanVerdict("worse")}
    names = {name for pair in means for name in pair}
    for middle in names:
        better |= {(a, c) for a, b in better if b == middle for m, c in better if m == middle}
    for (a, b), said in means.items():
        if said != MeanVerdict("equivalent") and {(a, b), (b, a)} & better:
            means[a, b] = MeanVerdict("better" if (a, b) in better else "worse")


def _ahead_of_all(
    scores: Mapping[str, Floats],
    level: float,
    certain: Collection[str],
    ends: Ends,
    *,
    paired: bool,
    seen_only: bool,
) -> list[tuple[str, str]]:
    """The pairs whose first agent is shown to be ahead of the second and of all that follow it."""
    shares = {name: ends.shares(values) for name, values in scores.items()}
    there = {name: np.isfinite(values) for name, values in scores.items()}
    if paired:
        in_all = np.asarray(np.all([*there.values()], axis=0))
        there = dict.fromkeys(there, in_all)
    finite = {name: values[there[name]] for name, values in shares.items()}
    order = sorted(finite, key=lambda name: _mean_or_last(finite[name]), reverse=True)
    exact = [name in certain for name in order]
    n_ranked = rank_by_mean(
        [finite[name] for name in order], level, paired=paired, exact=exact, seen_only=seen_only
    )
    return [(order[k], other) for k in range(n_ranked) for other in order[k + 1 :]]


def _mean_or_last(values: Floats) -> float:
    return float(values.mean()) if len(values) else -np.inf


def _runs(
    scores: Mapping[str, Floats], pair: tuple[str, str], *, paired: bool
) -> tuple[Floats, Floats]:
    """The finite scores of two agents; of the same seeds where they are paired."""
    x, y = (np.asarray(scores[name], np.float64) for name in pair)
    there = np.isfinite(x), np.isfinite(y)
    if paired:
        there = (there[0] & there[1],) * 2
    return x[there[0]], y[there[1]]


def _typical(
    runs: Mapping[tuple[str, str], tuple[Floats, Floats]],
    margin: float,
    level: float,
    n_others: int,
) -> dict[tuple[str, str], Verdict]:
    """Verdicts on typical runs, with Holm's correction over these pairs and ``n_others`` more."""
    enough = [pair for pair, both in runs.items() if min(map(len, both)) >= FEWEST_SEEDS]
    others = [1.0] * n_others
    apart = holm([*(apart_p_value(*runs[pair]) for pair in enough), *others])
    close = holm([*(equivalent_p_value(*runs[pair], margin) for pair in enough), *others])
    found: dict[tuple[str, str], Verdict] = dict.fromkeys(runs, "undecided")
    for pair, different, same in zip(enough, apart, close, strict=False):
        first, second = runs[pair]
        # Within the margin a difference does not matter, however certain: equivalence comes first,
        # unless runs of one agent are shown to be ahead by more than the margin more often.
        if same <= level and not apart_beyond(first, second, margin, level):
            found[pair] = "equivalent"
        elif different <= level:
            found[pair] = "better" if ahead_p_value(first, second) < 0.5 else "worse"
    return found


def apart_beyond(first: Floats, second: Floats, margin: float, level: float) -> bool:
    """Whether one agent is ahead by more than the margin more often than the other is.

    The two-sided sign test, over runs in the order of their seeds.
    """
    n = min(len(first), len(second))
    apart = differences(first[:n], second[:n])
    above, below = int((apart > margin).sum()), int((apart < -margin).sum())
    return bool(2 * stats.binom.sf(max(above, below) - 1, above + below, 0.5) <= level)


def _known(first: Floats, second: Floats, margin: float) -> Judgement:
    x, y = (values[np.isfinite(values)] for values in (first, second))
    if min(len(x), len(y)) == 0:
        return Judgement(MeanVerdict("undecided"), "undecided")
    apart = float(differences(x[:1], y[:1])[0])
    verdict: Verdict = "better" if apart > margin else "worse" if -apart > margin else "equivalent"
    return Judgement(MeanVerdict(verdict), verdict, certain=True)


# How often an agent beats another.

# From this many seeds on, the bootstrap interval and the normal interval agree.
MANY_SEEDS = 200


def probability_of_improvement(
    first: ArrayLike,
    second: ArrayLike,
    *,
    seed: int,
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
) -> Estimate:
    """The probability that a run of the first agent scores higher than one of the second.

    It is the share of all pairs of runs, equal scores counting half: the statistic of Mann and
    Whitney. Over several environments it is the mean over them. Both agents' seeds are resampled
    together, as they were run on the same random numbers. Where the first agent always won, or
    always lost, a bootstrap interval would have length 0; the interval is then that of Clopper and
    Pearson for as many independent wins as there are seeds.

    Args:
        first: shape (n_seeds,) or (n_seeds, n_envs).
        second: likewise, the same seeds at the same places. A seed counts where neither is NaN;
            infinite scores are compared as any others.
        seed: the seed of the resampling.
        confidence: the confidence level of the interval.
        n_resamples: how many resamples it comes from.

    Raises:
        ValueError: for arguments out of range or of another shape.

    Source: Agarwal et al. (2021), section 4.3. The interval is widened for few seeds, see
    ``interval_tail``; with more than ``MANY_SEEDS`` seeds it is the normal interval, which agrees
    with resampling and is faster.
    """
    check_confidence(confidence)
    x, y = as_columns(first), as_columns(second)
    same_shape(x, y)
    known = ~np.isnan(x) & ~np.isnan(y)
    pairs = [(one[k], other[k]) for one, other, k in zip(x.T, y.T, known.T, strict=True)]
    sizes = [len(first_scores) for first_scores, _ in pairs]
    n, n_missing = sum(sizes), x.size - sum(sizes)
    if min(sizes) == 0:
        return Estimate(np.nan, np.nan, np.nan, n, n_missing)
    # The pairs that each seed wins, by its run of the first agent, and by its run of the second.
    wins = [(wins_of(one, other), len(one) - wins_of(other, one)) for one, other in pairs]
    point = float(np.mean([ahead.sum() / len(ahead) ** 2 for ahead, _ in wins]))
    if point in {0, 1} and min(sizes) > 1:
        sure = ((1 - confidence) / 2) ** (1 / (min(sizes) * len(sizes)))
        low, high = (sure, 1.0) if point else (0.0, 1 - sure)
        return Estimate(point, low, high, n, n_missing)
    # The influence of each seed, by both of its runs, gives the variance of the statistic.
    influences = [(ahead + behind) / len(ahead) for ahead, behind in wins]
    if min(sizes) > MANY_SEEDS:
        low, high = _normal_interval(point, influences, confidence)
        return Estimate(point, low, high, n, n_missing)
    tail = interval_tail(influences, confidence)
    rng = np.random.default_rng(seed)
    tables = [_table(*pair) for pair in pairs]
    resampled = [_resampled(each, resample_counts(len(each), n_resamples, rng)) for each in tables]
    ends = percentile_interval(np.mean(resampled, axis=0), tail)
    return Estimate(point, float(ends[0]), float(ends[1]), n, n_missing)


def _normal_interval(
    point: float, influences: list[Floats], confidence: float
) -> tuple[float, float]:
    """The normal interval from the variance of the seeds' influences, within 0 and 1.

    Source: DeLong, DeLong and Clarke-Pearson (1988), "Comparing the areas under two or more
    correlated receiver operating characteristic curves", Biometrics 44(3).
    """
    variances = [values.var(ddof=1) / len(values) for values in influences]
    reach = stats.norm.isf((1 - confidence) / 2) * np.sqrt(sum(variances)) / len(influences)
    return max(point - float(reach), 0.0), min(point + float(reach), 1.0)


def _table(first: Floats, second: Floats) -> Floats:
    """1 where a run of the first (rows) beats one of the second (columns), 0.5 where equal."""
    return (1 + np.sign(differences(first[:, None], second[None, :]))) / 2


def _resampled(wins: Floats, counts: Counts) -> Floats:
    """The share of wins in each resample, shape (n_resamples,)."""
    return np.asarray(((counts @ wins) * counts).sum(axis=1) / len(wins) ** 2)


# Which of two agents is better, by how much, and how many seeds it would take to say.


@dataclass(frozen=True)
class PairComparison:
    """The comparison of two agents."""

    first: str  #: the name of the first agent
    second: str  #: the name of the second agent
    said: MeanVerdict  #: the verdict on the means
    #: The difference of the means, as shares of the scale between the ends; the intervals for all
    #: pairs hold together and agree with the verdict.
    mean: MeanDifference
    typical: Verdict  #: the verdict on typical runs; see ``Judgement``
    #: The probability that a run of the first agent scores higher than one of the second.
    probability_of_improvement: Estimate
    #: Where the means are undecided, the approximate number of seeds that would decide at the next
    #: look with 80 % power if means and variances are as observed. None above 10,000, or with too
    #: few seeds to say.
    seeds_needed: int | None
    #: Whether both agents are deterministic, so that their scores are exact.
    certain: bool = False
    #: The number of seeds of each agent at the time of the judgement, failed runs included.
    n_seeds: int = 0

    @property
    def verdict(self) -> Verdict:
        """The verdict on the first agent's mean."""
        return self.said.verdict

    @property
    def is_conditional(self) -> bool:
        """Whether the verdict holds only if few further runs lie outside the observed range."""
        return self.said.is_conditional

    def swapped(self) -> PairComparison:
        """The same comparison seen from the second agent."""
        wins = self.probability_of_improvement
        return replace(
            self,
            first=self.second,
            second=self.first,
            said=self.said.swapped(),
            mean=self.mean.swapped(),
            typical=opposite(self.typical),
            probability_of_improvement=replace(
                wins, point=1 - wins.point, low=1 - wins.high, high=1 - wins.low
            ),
        )


def compare_pairs(
    scores: Mapping[str, ArrayLike],
    margin: float = 0.0,
    *,
    seed: int,
    ends: tuple[float, float] | None = None,
    paired: bool = False,
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
    look: int = 1,
    n_looks: int | None = None,
    certain: Collection[str] = (),
) -> list[PairComparison]:
    """Compare every two agents, in the order of the mapping.

    Args:
        scores: by agent, shape (n_seeds,), higher is better. Non-finite scores are missing.
        margin: the largest difference, in the unit of the scores, that does not matter.
        seed: the seed of the resampling.
        ends: the lowest and the highest score that a run may have; scores beyond an end count as
            that end. None for ``Ends.beyond``.
        paired: whether the agents' runs of one seed share their randomness.
        confidence: the share of studies in which no verdict is wrong, over all looks of a study.
        n_resamples: how many resamples the intervals of the probabilities come from.
        look: the number of this look, counted from 1; each look has more seeds.
        n_looks: how many looks there will be; see ``level_of_look``.
        certain: the deterministic agents; see ``judge_pairs``.

    Raises:
        ValueError: for arguments out of range, or agents with different numbers of seeds.
    """
    _check(scores, margin, confidence, ends)
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in scores.items()}
    level = level_of_look(1 - confidence, look, n_looks)
    last = n_looks is not None and look >= n_looks
    later = level if last else level_of_look(1 - confidence, look + 1, n_looks)
    scale = Ends(*ends) if ends else Ends.beyond(arrays)
    judged = judge_pairs(arrays, margin, level, certain, ends=scale, paired=paired)
    return describe_pairs(
        {pair: (judgement, len(arrays[pair[0]])) for pair, judgement in judged.items()},
        arrays,
        margin,
        (level, later),
        scale,
        seed=seed,
        paired=paired,
        ranks=len(arrays) > 2,
        certain=certain,
        confidence=confidence,
        n_resamples=n_resamples,
    )


def describe_pairs(
    judged: Mapping[tuple[str, str], tuple[Judgement, int]],
    scores: Mapping[str, Floats],
    margin: float,
    levels: tuple[float, float],
    ends: Ends,
    *,
    seed: int,
    paired: bool = False,
    ranks: bool = False,
    against: str = "",
    certain: Collection[str] = (),
    confidence: float = 0.95,
    n_resamples: int = N_RESAMPLES,
) -> list[PairComparison]:
    """Add differences, probabilities and seeds needed to the judgements on pairs of agents.

    Args:
        judged: by pair, the judgement and the number of seeds that it was made with.
        scores: by agent, shape (n_seeds,).
        margin: the largest difference that does not matter.
        levels: the error rates of the look that judged, and of the next.
        ends: the ends of the scores' scale.
        seed: the seed of the resampling.
        paired: whether the agents' runs of one seed share their randomness.
        ranks: whether half of the error rate for means was spent on the ranking.
        against: the only agent that the others were compared with; empty for all pairs.
        certain: the deterministic agents.
        confidence: the confidence level of the probabilities of improvement.
        n_resamples: how many resamples their intervals come from.
    """
    compared = {pair for pair in judged if not against or against in pair}
    n_pairs = max(1, sum(not judged[pair][0].certain for pair in compared))
    for_best = level_of_claim(levels[0], "means") / 2 if ranks else 0.0
    level = (for_best or level_of_claim(levels[0], "means")) / n_pairs
    comparisons = []
    for (one, two), (judgement, n_seeds) in judged.items():
        both = np.array([scores[one][:n_seeds], scores[two][:n_seeds]])
        in_both = np.where(np.isfinite(both).all(axis=0), both, np.nan)
        improvement = probability_of_improvement(
            *in_both, seed=seed, confidence=confidence, n_resamples=n_resamples
        )
        x, y = _runs(dict(zip((one, two), both, strict=True)), (one, two), paired=paired)
        needed = None
        if (one, two) in compared and not judgement.is_decided and min(len(x), len(y)) > 1:
            needed = seeds_needed(
                ends.shares(x),
                ends.shares(y),
                level_of_claim(levels[1], "means") / n_pairs,
                margin / (ends.high - ends.low),
            )
            needed = None if needed is None else max(needed, min(len(x), len(y)) + 1, FEWEST_SEEDS)
        comparisons.append(
            PairComparison(
                first=one,
                second=two,
                said=judgement.mean,
                mean=_mean_difference(
                    (ends.shares(x), ends.shares(y)),
                    (one in certain, two in certain),
                    # The interval of a pair that was not tested contains every difference.
                    (level if (one, two) in compared else 0.0, for_best),
                    margin / (ends.high - ends.low),
                    judgement,
                    paired=paired,
                ),
                typical=judgement.typical,
                probability_of_improvement=improvement,
                seeds_needed=needed,
                certain=judgement.certain,
                n_seeds=n_seeds,
            )
        )
    return comparisons


def _check(
    scores: Mapping[str, ArrayLike],
    margin: float,
    confidence: float,
    ends: tuple[float, float] | None,
) -> None:
    if not 0.5 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, it must lie between 0.5 and 1, as 0.95 does")
    if not margin >= 0:
        raise ValueError(f"margin is {margin}, it must be 0 or a positive difference of scores")
    if ends is not None and not -np.inf < ends[0] < ends[1] < np.inf:
        raise ValueError(f"ends are {ends}, they must be two finite scores, the lower one first")
    shapes = {name: np.shape(values) for name, values in scores.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(
            f"agents have scores of different shapes, {shapes}: give all of them the same seeds, "
            "and NaN for a run that failed"
        )
    for shape in set(shapes.values()):
        if len(shape) != 1:
            raise ValueError(f"scores have shape {shape}, they must have (n_seeds,)")


def _mean_difference(
    runs: tuple[Floats, Floats],
    exact: tuple[bool, bool],
    levels: tuple[float, float],
    margin: float,
    judgement: Judgement,
    *,
    paired: bool,
) -> MeanDifference:
    """The difference of two means, with intervals that agree with the verdict.

    The first level is that of the intervals of all pairs; the second that of the ranking, a test of
    its own, which may decide what an interval leaves open. Where agents are equivalent, the
    interval is cut at the margin: Stefansson, Kim and Hsu (1988), "On confidence sets in multiple
    comparisons".
    """
    x, y = runs
    if judgement.certain:
        apart = float(x[0] - y[0])
        return MeanDifference(apart, apart, apart, apart, apart)
    found, said = compare_means(x, y, levels[0], paired=paired, exact=exact), judgement.mean
    is_ahead = said.verdict in ("better", "worse")
    if said.is_conditional and is_ahead and found.seen_low <= 0 <= found.seen_high:
        found = compare_means(x, y, levels[1], paired=paired, exact=exact)
    least = {"better": 0.0, "equivalent": -margin}.get(said.verdict, -1.0)
    most = {"worse": 0.0, "equivalent": margin}.get(said.verdict, 1.0)
    seen = {"seen_low": max(found.seen_low, least), "seen_high": min(found.seen_high, most)}
    if said.is_conditional:
        return replace(found, **seen)
    return replace(found, low=max(found.low, least), high=min(found.high, most), **seen)
