"""How often verdicts are wrong, and how often they are found, over kinds of scores.

    nice python benchmarks/verdict_errors.py [--studies 2000]

Wrong claims: each row is a kind of sentence and of scores, each column a number of seeds; "grown"
looks at 5, 10, 20 and 40 seeds until there is a verdict. The promise is 5 % of studies. Columns of
one look spend all of it at once.

Power: the same beside Welch's t test, and beside AdaStop (Mathieu and others, 2023): a permutation
test of the difference of means, sequential over groups of five seeds.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import stats

from verdicts import (
    compare_speed,
    count_failures,
    fail_more_often,
    failure_threshold,
    judge_pairs,
    level_of_look,
)

Scores = NDArray[np.float64]
Draw = Callable[[Generator, tuple[int, ...]], Scores]

SEEDS = (3, 5, 10, 20, 50)
LOOKS = (5, 10, 20, 40)
MARGIN = 0.5
ALPHA = 0.05
SPACING = 100.0


def failing(share: float) -> Draw:
    """Scores about 0.95, but 0 in so large a share of runs."""

    def draw(rng: Generator, shape: tuple[int, ...]) -> Scores:
        scores = 0.95 + 0.01 * rng.normal(size=shape)
        return np.where(rng.random(shape) < share, 0.0, scores)

    return draw


def two_peaks(rng: Generator, shape: tuple[int, ...]) -> Scores:
    """A run either finds the way or does not, as likely."""
    return (rng.random(shape) < 0.5) + 0.02 * rng.normal(size=shape)


def tied(rng: Generator, shape: tuple[int, ...]) -> Scores:
    """Four different scores, one of them in most runs."""
    return rng.choice([0.0, 0.5, 0.9, 1.0], size=shape, p=[0.1, 0.1, 0.2, 0.6])


DISTRIBUTIONS: dict[str, Draw] = {
    "normal": lambda rng, shape: rng.normal(size=shape),
    "exponential": lambda rng, shape: rng.exponential(size=shape),
    "log-normal": lambda rng, shape: rng.lognormal(size=shape),
    "two peaks": two_peaks,
    "heavily tied": tied,
    "fails in 5 %": failing(0.05),
    "fails in 30 %": failing(0.3),
}


def paired_scores(draw: Draw, rng: Generator, n: int) -> tuple[Scores, Scores]:
    """Two agents that share half of what makes up a score, as with common random numbers."""
    shared, own = draw(rng, (n,)), draw(rng, (2, n))
    return shared + own[0], shared + own[1]


def verdict(first: Scores, second: Scores, level: float, margin: float = 0.0) -> str:
    """What is said of the first of two agents."""
    return judge_pairs({"x": first, "y": second}, margin, level)["x", "y"].verdict


def first_verdict(first: Scores, second: Scores, margin: float = 0.0) -> str:
    """What is said when a study is grown until it says something."""
    for look, n in enumerate(LOOKS, start=1):
        found = verdict(first[:n], second[:n], level_of_look(ALPHA, look), margin)
        if found != "undecided":
            return found
    return "undecided"


def rate(wrong: Callable[[int | None], bool], studies: int) -> list[float]:
    """The share of studies that are wrong, by number of seeds, the last grown."""
    return [float(np.mean([wrong(n) for _ in range(studies)])) for n in (*SEEDS, None)]


def said_of(first: Scores, second: Scores, n: int | None, margin: float = 0.0) -> str:
    """The verdict after n seeds, or of a grown study."""
    if n is None:
        return first_verdict(first, second, margin)
    return verdict(first, second, ALPHA, margin)


def wrong_same(draw: Draw, rng: Generator) -> Callable[[int | None], bool]:
    """An agent is called better or worse than itself."""

    def wrong(n: int | None) -> bool:
        x, y = draw(rng, (2, n or LOOKS[-1]))
        return said_of(x, y, n) != "undecided"

    return wrong


def wrong_paired(draw: Draw, rng: Generator) -> Callable[[int | None], bool]:
    """The same, with seeds that make both agents' runs alike."""

    def wrong(n: int | None) -> bool:
        return said_of(*paired_scores(draw, rng, n or LOOKS[-1]), n) != "undecided"

    return wrong


def wrong_middle(draw: Draw, rng: Generator) -> Callable[[int | None], bool]:
    """A steady agent at the median of another is called better than it."""
    middle = float(np.median(draw(np.random.default_rng(0), (100_001,))))

    def wrong(n: int | None) -> bool:
        scores = draw(rng, (n or LOOKS[-1],))
        return said_of(np.full(len(scores), middle), scores, n) == "better"

    return wrong


def wrong_equivalent(draw: Draw, rng: Generator) -> Callable[[int | None], bool]:
    """Agents that lie the margin apart are called equivalent."""
    margin = MARGIN * float(stats.iqr(draw(np.random.default_rng(0), (100_001,))) or 0.1)

    def wrong(n: int | None) -> bool:
        x, y = draw(rng, (2, n or LOOKS[-1]))
        return said_of(x, y + margin * (1 + 1e-9), n, margin) == "equivalent"

    return wrong


def wrong_steady_equivalent(draw: Draw, rng: Generator) -> Callable[[int | None], bool]:
    """A steady agent that lies the margin above another's median is called equivalent to it."""
    known = draw(np.random.default_rng(0), (100_001,))
    margin, middle = MARGIN * float(stats.iqr(known)), float(np.median(known))

    def wrong(n: int | None) -> bool:
        scores = draw(rng, (n or LOOKS[-1],))
        steady = np.full(len(scores), middle + margin * (1 + 1e-9))
        return said_of(steady, scores, n, margin) == "equivalent"

    return wrong


def wrong_sooner(never: float, rng: Generator) -> Callable[[int | None], bool]:
    """An agent is said to arrive sooner than itself."""

    def wrong(n: int | None) -> bool:
        steps = SPACING * np.ceil(rng.lognormal(2, 0.7, size=(2, n or LOOKS[-1])))
        steps[rng.random(steps.shape) < never] = np.inf
        looks = (
            [(n, ALPHA)] if n else [(m, level_of_look(ALPHA, k + 1)) for k, m in enumerate(LOOKS)]
        )
        return any(
            pair.sooner is not None
            for m, level in looks
            for pair in compare_speed({"x": steps[0, :m], "y": steps[1, :m]}, SPACING, level)
        )

    return wrong


def wrong_bound(share: float, rng: Generator) -> Callable[[int | None], bool]:
    """More runs fail than the bound says."""

    def wrong(n: int | None) -> bool:
        scores = (rng.random(n or LOOKS[-1]) >= share).astype(np.float64)
        looks = (
            [(n, ALPHA)] if n else [(m, level_of_look(ALPHA, k + 1)) for k, m in enumerate(LOOKS)]
        )
        return any(count_failures(scores[:m], 0.5, level).most < share for m, level in looks)

    return wrong


def wrong_unreliable(share: float, rng: Generator) -> Callable[[int | None], bool]:
    """An agent is said to fail more often than itself; what failure is depends on the runs."""

    def wrong(n: int | None) -> bool:
        scores = failing(share)(rng, (2, n or LOOKS[-1]))
        looks = (
            [(n, ALPHA)] if n else [(m, level_of_look(ALPHA, k + 1)) for k, m in enumerate(LOOKS)]
        )
        return any(unreliable(scores[:, :m], level) for m, level in looks)

    return wrong


def unreliable(scores: Scores, level: float) -> bool:
    """Whether one of two agents is said to fail more often."""
    threshold = failure_threshold(0.0, float(np.median(scores, axis=1).max()))
    counts = {str(k): count_failures(row, threshold) for k, row in enumerate(scores)}
    return bool(fail_more_often(counts, level))


def wrong_of_many(draw: Draw, rng: Generator, n: int, studies: int) -> float:
    """Ten times the same agent: the share of studies that tell any two of them apart."""
    found = 0
    for _ in range(studies):
        scores = {str(k): row for k, row in enumerate(draw(rng, (10, n)))}
        judged = judge_pairs(scores, 0.0, ALPHA).values()
        found += any(one.verdict != "undecided" for one in judged)
    return found / studies


def print_errors(studies: int) -> None:
    """Wrong claims, a row for each kind of sentence and of scores."""
    rng = np.random.default_rng(0)
    names = [*(f"{n} seeds" for n in SEEDS), "grown"]
    print(f"Wrong claims, per cent of {studies:,} studies\n")
    print(f"| claim | scores | {' | '.join(names)} |")
    print("|---|---|" + "---|" * len(names))
    rows: list[tuple[str, str, Callable[[int | None], bool]]] = []
    claims = {
        "better or worse: the same agent": wrong_same,
        "the same, paired seeds": wrong_paired,
        "better: steady, at the other's median": wrong_middle,
        "equivalent: the margin apart": wrong_equivalent,
        "equivalent: the margin above a median": wrong_steady_equivalent,
    }
    for claim, make in claims.items():
        for kind, draw in DISTRIBUTIONS.items():
            # No steady agent wins half of its pairs where more than half of the scores are one.
            if make in {wrong_middle, wrong_steady_equivalent} and kind == "heavily tied":
                continue
            rows.append((claim, kind, make(draw, rng)))
    rows += [
        ("sooner: the same agent", f"{never:.0%} never arrive", wrong_sooner(never, rng))
        for never in (0.0, 0.2, 0.6)
    ]
    rows += [
        ("at most so many fail", f"{share:.0%} do", wrong_bound(share, rng))
        for share in (0.05, 0.1, 0.2, 0.5)
    ]
    rows += [
        ("fails more often: the same agent", f"fails in {share:.0%}", wrong_unreliable(share, rng))
        for share in (0.05, 0.3, 0.5)
    ]
    for claim, kind, wrong in rows:
        figures = [f"{100 * found:.1f}" for found in rate(wrong, studies)]
        print(f"| {claim} | {kind} | {' | '.join(figures)} |", flush=True)


def print_errors_of_many(studies: int) -> None:
    """Wrong claims among ten agents."""
    rng = np.random.default_rng(1)
    print(
        f"\nAny of 45 pairs told apart, ten times the same agent, per cent of {studies:,} studies\n"
    )
    print("| scores | 5 seeds | 10 seeds | 20 seeds |\n|---|---|---|---|")
    for kind, draw in DISTRIBUTIONS.items():
        found = [f"{100 * wrong_of_many(draw, rng, n, studies):.1f}" for n in (5, 10, 20)]
        print(f"| {kind} | {' | '.join(found)} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--studies", type=int, default=2000, help="simulated for each figure")
    studies = parser.parse_args().studies
    print_errors(studies)
    print_errors_of_many(max(studies // 10, 1))


if __name__ == "__main__":
    main()
