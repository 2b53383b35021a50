"""A study that adds seeds until its verdicts are decided: a group sequential design."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from verdicts.error_levels import level_of_look
from verdicts.means import FEWEST_SEEDS
from verdicts.pairs import Ends, Judgement, fewest_seeds, judge_pairs
from verdicts.resampling import Floats

# The approximate ratio of the numbers of seeds at one look and at the look before.
STEP = 1.5


@dataclass(frozen=True)
class Growth:
    """How far a study has grown on one environment."""

    #: By pair of agents, the judgement on the first, from the look that decided it, or else from
    #: the last.
    judged: Mapping[tuple[str, str], Judgement]
    looks: Mapping[tuple[str, str], int]  #: by pair, the number of that look, counted from 1
    #: By agent, the number of seeds at the next look; the same as at the last look where all pairs
    #: with the agent are decided.
    seeds: Mapping[str, int]
    n_looks: int  #: the number of looks so far
    level: float  #: the error rate of each look
    is_done: bool  #: whether no agent lacks seeds for another look


def look_sizes(first: int, most: int, n_agents: int, level: float) -> tuple[int, ...]:
    """The number of seeds of an agent at each look: from ``first`` to ``most``, in equal ratios.

    The first look has more seeds where ``first`` seeds could decide nothing, whatever the scores:
    such a look would be wasted.

    Args:
        first: how many seeds the study begins with.
        most: how many it may have.
        n_agents: how many agents there are.
        level: the error rate of all looks together.
    """
    n_pairs = max(math.comb(n_agents, 2), 1)
    for start in range(first, most):
        steps = max(round(math.log(most / start) / math.log(STEP)), 1)
        if start >= fewest_seeds(level / (steps + 1), n_pairs):
            ratio = (most / start) ** (1 / steps)
            return (*(round(start * ratio**step) for step in range(steps)), most)
    return (most,)


def grow(
    scores: Mapping[str, Floats],
    sizes: Sequence[int],
    margin: float,
    level: float,
    certain: Collection[str] = (),
    *,
    ends: Ends | None = None,
    paired: bool = False,
    against: str = "",
) -> Growth:
    """Make all planned looks that the seeds allow, and say which agents need more seeds.

    Only agents in undecided pairs get more seeds, so that at each look all tested pairs have the
    same, planned number of seeds. Decided pairs keep their judgement. All looks are computed from
    the first, so that the result depends on the scores alone, and not on how often somebody
    looked.

    Args:
        scores: by agent, one for each of its seeds; a non-finite score is a failed run.
        sizes: the number of seeds of an undecided agent at each look, fixed before the first.
        margin: the largest difference that does not matter.
        level: the error rate of all looks together. Each has an equal share.
        certain: the deterministic agents; see ``judge_pairs``.
        ends: the ends of the scores' scale; see ``judge_pairs``.
        paired: whether the agents' runs of one seed share their randomness.
        against: the only agent that the others are compared with; see ``judge_pairs``.

    Source: Holm's procedure with p-values over looks, each multiplied by the number of looks; see
    Maurer and Bretz (2013), "Multiple testing in group sequential trials using graphical
    approaches", Statistics in Biopharmaceutical Research 5(4).
    """
    share = level_of_look(level, 1, len(sizes))
    judged: dict[tuple[str, str], Judgement] = {}
    looks: dict[tuple[str, str], int] = {}
    seeds = dict.fromkeys(scores, sizes[0])
    for look, size in enumerate(sizes, start=1):
        growing = _undecided_agents(scores, judged, seeds, against) if judged else set(scores)
        seeds |= dict.fromkeys(growing, size)
        if not growing or any(len(scores[name]) < size for name in growing):
            break
        decided = {pair: each for pair, each in judged.items() if each.is_decided}
        shown = {name: np.asarray(values)[: seeds[name]] for name, values in scores.items()}
        judged = judge_pairs(
            shown, margin, share, certain, decided, ends=ends, paired=paired, against=against
        )
        looks |= {pair: look for pair in judged if pair not in decided}
    is_done = all(len(values) >= seeds[name] for name, values in scores.items())
    return Growth(judged, looks, seeds, max(looks.values(), default=0), share, is_done)


def _undecided_agents(
    scores: Mapping[str, Floats],
    judged: Mapping[tuple[str, str], Judgement],
    seeds: Mapping[str, int],
    against: str,
) -> set[str]:
    """The agents in undecided pairs, if both agents of the pair have enough finite scores."""
    there = {name: np.isfinite(values[: seeds[name]]).sum() for name, values in scores.items()}
    return {
        name
        for pair, judgement in judged.items()
        if (not against or against in pair)
        and not judgement.is_decided
        and min(there[each] for each in pair) >= FEWEST_SEEDS
        for name in pair
    }
