"""Which agent is better: one word for each pair of agents, from their scores over seeds.

Welch's tests with Holm's correction in two families, for differences and for ties (reasons:
docs/statistics.md). A failure that no run showed is not counted: see ``AgentRuns.unseen``.

    study = judge({"CartPole-v1": {"dqn": [500, 498, 500], "ppo": [500, 500, 500]}}, margin=10)
    print(study.best["CartPole-v1"], study.pairs[0].text)
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rl_yardstick.verdicts import welch as tests
from rl_yardstick.verdicts.estimates import (
    FEW,
    LEVEL,
    UNBOUNDED,
    AgentRuns,
    Bounds,
    describe,
    failure_threshold,
)

Word = Literal["better", "worse", "tied", "undecided"]
OPPOSITE: dict[Word, Word] = {"better": "worse", "worse": "better"}

FEW_FOR_TIES = 10  # with fewer runs "tied" holds only so far: rare failures may be missing
FOR_TIES = 0.2  # the share of the level for ties; differences have the rest

Key = tuple[str, str, str]  # environment, first agent, second agent
Scores = Mapping[str, Mapping[str, ArrayLike]]
T = TypeVar("T")


@dataclass(frozen=True)
class Pair:
    """Two agents in an environment. The word is about the first."""

    environment: str
    first: str
    second: str
    word: Word
    so_far: bool  #: whether runs are few: below five, below ten for ``tied``
    difference: float  #: mean of the first minus mean of the second
    interval: Bounds  #: at ``Study.interval_level``; it agrees with the word
    p_different: float  #: corrected for all pairs of the study: different at 0.8 of the level
    p_tied: float  #: likewise: tied at 0.2 of the level
    n: int  #: the fewer runs of the two
    #: where undecided: so many seeds of each would decide, if further runs are like these
    seeds_needed: int | None = None

    @property
    def text(self) -> str:
        """The word, with "so far" where runs are few."""
        return f"{self.word} so far" if self.so_far else self.word

    def swapped(self) -> Pair:
        """The same pair from the second agent's point of view."""
        return replace(
            self,
            first=self.second,
            second=self.first,
            word=OPPOSITE.get(self.word, self.word),
            difference=-self.difference,
            interval=(-self.interval[1], -self.interval[0]),
        )


@dataclass(frozen=True)
class Best:
    """The agents than which no other is shown to be better."""

    agents: tuple[str, ...]  #: by mean, the highest first
    tied: bool  #: whether all of them are tied
    so_far: bool  #: whether runs are few for the words behind it
    otherwise: str = "undecided"  #: how they stand if not

    def __str__(self) -> str:
        words = [] if len(self.agents) < 2 else ["tied" if self.tied else self.otherwise]
        words += ["so far"] if self.so_far and words != ["undecided"] else []
        between = "; " if any("," in name for name in self.agents) else ", "
        names = between.join(self.agents) or "none"
        return f"{names} ({' '.join(words)})" if words else names


@dataclass(frozen=True)
class Study:
    """The verdicts of a study."""

    agents: list[AgentRuns]
    pairs: list[Pair]
    best: dict[str, Best]  #: by environment
    failure_threshold: dict[str, float]  #: by environment; NaN where failures have no meaning
    interval_level: float  #: one minus the confidence of each interval of a difference
    #: With ``looks``, by environment and agent, its seeds at the next look: as many as at the last
    #: where all its pairs are decided.
    seeds: dict[str, dict[str, int]]
    n_looks: int = 1  #: the number of looks so far
    is_done: bool = True  #: whether no agent lacks seeds for another look


class _Evidence(NamedTuple):
    """A pair's smallest p-values over all looks so far, each with the runs behind it."""

    different: tuple[float, tests.Difference]
    tied: tuple[float, tests.Difference]
    last: tests.Difference


class _Rules(NamedTuple):
    """What is the same at every look."""

    bounds: Bounds | Mapping[str, Bounds] | None
    margin: float | Mapping[str, float]
    level: float  # of one look
    n_looks: int
    baseline: float | Mapping[str, float | None] | None
    certain: Collection[tuple[str, str]]
    paired: bool
    against: str


def judge(
    scores: Scores,
    *,
    bounds: Bounds | Mapping[str, Bounds] | None = None,
    margin: float | Mapping[str, float] = 0.02,
    level: float = LEVEL,
    n_looks: int = 1,
    baseline: float | Mapping[str, float | None] | None = 0.0,
    certain: Collection[tuple[str, str]] = (),
    paired: bool = False,
    against: str = "",
    looks: Sequence[int] = (),
) -> Study:
    """Compare every two agents in every environment.

    Args:
        scores: by environment and agent, one for each run, higher is better, shape (n_runs,); NaN
            for a missing run.
        bounds: the least and the greatest possible score (of each environment); None if unknown.
        margin: the largest difference that does not matter (in each environment); 0: no ties.
        level: the share of studies that may have a false word.
        n_looks: how often the study will be looked at, fixed beforehand; each look has an equal
            share of the level.
        baseline: the score of an agent that has learnt nothing (in each environment): runs below
            half the way from there to the best median failed. None: failures are not counted.
        certain: environment and agent where chance has no part, so that all runs are equal.
        paired: whether runs at one place share their randomness: Student's paired t test.
        against: the only agent that the others are compared with; empty for all pairs.
        looks: the number of seeds at each look of a study that grows until its pairs are decided,
            fixed beforehand. Decided pairs keep their word, and agents without undecided pairs get
            no more seeds. All looks that the runs allow are made, from the first.

    Raises:
        ValueError: for a level, a margin or a number of looks out of range.

    Source: Welch (1947); Schuirmann (1987); Holm (1979). docs/statistics.md has the journals.
    """
    n_looks = len(looks) or n_looks
    if not (0 < level < 0.5 and n_looks >= 1):
        raise ValueError(f"level {level} must lie between 0 and 0.5, and n_looks {n_looks} above 0")
    if min(margin.values() if isinstance(margin, Mapping) else [margin], default=0) < 0:
        raise ValueError(f"margin {margin} must be 0 or a positive difference of scores")
    rules = _Rules(bounds, margin, level / n_looks, n_looks, baseline, certain, paired, against)
    if looks:
        return _grown(rules, scores, looks)
    return _study(rules, scores, _evidence(rules, scores, {}))


def _of(value: T | Mapping[str, T], environment: str) -> T:
    return value[environment] if isinstance(value, Mapping) else value


def _evidence(
    rules: _Rules, scores: Scores, before: Mapping[Key, _Evidence], words: Mapping[Key, Word] = {}
) -> dict[Key, _Evidence]:
    """The evidence on each pair, with that of earlier looks; decided pairs keep theirs."""
    found = dict(before)
    for environment, runs in scores.items():
        margin = _of(rules.margin, environment)
        certain = {name for e, name in rules.certain if e == environment}
        samples = {name: tests.sample(runs[name], is_certain=name in certain) for name in runs}
        for a, b in combinations(runs, 2):
            key = environment, a, b
            if rules.against not in ("", a, b) or words.get(key, "undecided") != "undecided":
                continue
            paired = tests.student(runs[a], runs[b]) if rules.paired else None
            now = paired or tests.welch(samples[a], samples[b])
            new = _Evidence((tests.p_different(now), now), (tests.p_tied(now, margin), now), now)
            old = before.get(key, new)
            found[key] = _Evidence(min(old[0], new[0]), min(old[1], new[1]), now)
    return found


class _Words(NamedTuple):
    words: dict[Key, Word]
    p_different: dict[Key, float]  # corrected
    p_tied: dict[Key, float]
    levels: tuple[float, float]  # of one pair, for a difference and for a tie


def _words(rules: _Rules, scores: Scores, evidence: Mapping[Key, _Evidence]) -> _Words:
    """The words of all pairs, and what the tests say."""
    apart = tests.holm({key: each.different[0] for key, each in evidence.items()})
    close = tests.holm({key: each.tied[0] for key, each in evidence.items()})
    levels = (1 - FOR_TIES) * rules.level, FOR_TIES * rules.level
    words: dict[Key, Word] = {}
    for environment, runs in scores.items():
        place = {name: k for k, name in enumerate(runs)}
        ahead, same = (np.zeros((len(place),) * 2, bool) for _ in range(2))
        here = [(key, place[key[1]], place[key[2]]) for key in evidence if key[0] == environment]
        for key, a, b in here:
            if apart[key] <= levels[0]:
                ahead[(a, b) if evidence[key].different[1].apart > 0 else (b, a)] = True
            same[a, b] = same[b, a] = close[key] <= levels[1]
        _close(ahead, same)
        for key, a, b in here:
            shown: Word = "better" if ahead[a, b] else "worse" if ahead[b, a] else "undecided"
            words[key] = "tied" if same[a, b] else shown
    open_ = sum(p > levels[0] for p in apart.values()), sum(p > levels[1] for p in close.values())
    each = levels[0] / max(1, open_[0]), levels[1] / max(1, open_[1])
    return _Words(words, apart, close, each)


def _close(ahead: NDArray[np.bool_], same: NDArray[np.bool_]) -> None:
    """Add what follows: a > b > c makes a > c; if a and c are tied, b is tied with both."""
    before = (-1, -1)
    while before != (now := (int(ahead.sum()), int(same.sum()))):
        before = now
        ahead |= ahead @ ahead
        between = ahead & (same @ ahead.T | ahead.T @ same)
        same |= between | between.T


def _study(rules: _Rules, scores: Scores, evidence: Mapping[Key, _Evidence]) -> Study:
    found = _words(rules, scores, evidence)
    pairs = [_pair(rules, key, evidence[key], found) for key in evidence]
    agents: list[AgentRuns] = []
    best, thresholds = {}, {}
    for environment, runs in scores.items():
        baseline = _of(rules.baseline, environment)
        ends = _of(rules.bounds, environment) or UNBOUNDED
        threshold = thresholds[environment] = failure_threshold(baseline, runs.values())
        here = [describe(environment, name, runs[name], ends, threshold) for name in runs]
        agents += here
        those = [pair for pair in pairs if pair.environment == environment]
        best[environment] = _best(here, those, rules.against)
    seeds = {e: {name: np.size(values) for name, values in r.items()} for e, r in scores.items()}
    return Study(agents, pairs, best, thresholds, found.levels[0], seeds)


def _pair(rules: _Rules, key: Key, evidence: _Evidence, found: _Words) -> Pair:
    word, margin = found.words[key], _of(rules.margin, key[0])
    shown = {"tied": evidence.tied[1], "undecided": evidence.last}.get(word, evidence.different[1])
    ends = _of(rules.bounds, key[0]) or UNBOUNDED
    low, high = tests.difference_interval(shown, found.levels[0], ends)
    least = {"better": 0.0, "tied": -margin}.get(word, -np.inf)
    most = {"worse": 0.0, "tied": margin}.get(word, np.inf)
    is_open, few = word == "undecided", FEW_FOR_TIES if word == "tied" else FEW
    return Pair(
        *key,
        word,
        so_far=not is_open and shown.n < few,
        difference=shown.apart,
        interval=(float(max(low, least)), float(min(high, most))),
        p_different=min(1.0, found.p_different[key] * rules.n_looks),
        p_tied=min(1.0, found.p_tied[key] * rules.n_looks),
        n=1 if np.isinf(shown.n) else int(shown.n),
        seeds_needed=tests.seeds_needed(shown, found.levels, margin) if is_open else None,
    )


def _best(agents: Sequence[AgentRuns], pairs: Sequence[Pair], against: str) -> Best:
    said = [one for pair in pairs for one in (pair, pair.swapped())]
    behind = {pair.first for pair in said if pair.word == "worse"}
    there = [agent for agent in agents if agent.n and agent.name not in behind]
    names = [agent.name for agent in sorted(there, key=lambda agent: -agent.mean)]
    among = [pair for pair in pairs if {pair.first, pair.second} <= set(names)]
    n_pairs = len(names) * (len(names) - 1) // 2
    is_tied = len(among) == n_pairs > 0 and all(pair.word == "tied" for pair in among)
    leads = [pair for pair in said if pair.first in names and pair.word in ("better", "tied")]
    # Where all are compared with one agent alone, more seeds would not tell them apart.
    how = sorted({pair.word for pair in said if pair.first in names and pair.second == against})
    relation = " or ".join(how).replace("better", "better than").replace("tied", "tied with")
    otherwise = f"{relation} {against}" if how and "undecided" not in how else "undecided"
    return Best(tuple(names), is_tied, any(pair.so_far for pair in leads), otherwise)


def _grown(rules: _Rules, scores: Scores, looks: Sequence[int]) -> Study:
    """The verdicts of a growing study, after all looks that the runs allow."""
    seeds = {env: dict.fromkeys(runs, looks[0]) for env, runs in scores.items()}
    evidence: dict[Key, _Evidence] = {}
    words: dict[Key, Word] = {}
    shown, n_looks, is_done = scores, 0, False
    for size in looks:
        for key, word in words.items():
            # An agent whose runs all crash would never be decided.
            if word == "undecided" and evidence[key].last.n > 1:
                seeds[key[0]] |= dict.fromkeys(key[1:], size)
        shown = {
            e: {name: np.ravel(scores[e][name])[:n] for name, n in by.items()}
            for e, by in seeds.items()
        }
        asked = [(np.size(shown[e][name]), n) for e, by in seeds.items() for name, n in by.items()]
        is_done = all(n_there == n for n_there, n in asked)
        if not is_done or (n_looks and size not in [n for _, n in asked]):
            break
        evidence = _evidence(rules, shown, evidence, words)
        words = _words(rules, shown, evidence).words
        n_looks += 1
    study = _study(rules, shown, evidence)
    return replace(study, seeds=seeds, n_looks=n_looks, is_done=is_done)
