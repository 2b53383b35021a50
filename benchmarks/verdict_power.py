"""How often differences, equivalence and failures are found, over kinds of scores.

    nice python benchmarks/verdict_power.py [--studies 400]

Beside the verdicts stand Welch's t test and AdaStop (Mathieu and others, 2023): a permutation test
of the difference of means, sequential over groups of seeds. `verdict_errors.py` says how often
verdicts are wrong.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from numpy.random import Generator
from scipy import stats

from verdict_errors import ALPHA, DISTRIBUTIONS, Scores, failing, unreliable, verdict
from verdicts import level_of_look


def adastop(first: Scores, second: Scores, group: int, rng: Generator, n_draws: int = 1000) -> bool:
    """Whether AdaStop tells two agents apart: groups of ``group`` seeds, ALPHA over all of them."""
    n_groups = len(first) // group
    grouped = np.stack([first, second]).reshape(2, n_groups, group)
    pooled = grouped.transpose(1, 0, 2).reshape(n_groups, 2 * group)
    order = rng.random((n_draws, n_groups, 2 * group)).argsort(axis=-1)
    drawn = np.take_along_axis(np.broadcast_to(pooled, order.shape), order, axis=-1)
    moved = drawn[..., :group].sum(-1) - drawn[..., group:].sum(-1)
    observed = pooled[:, :group].sum(-1) - pooled[:, group:].sum(-1)
    permuted, found = np.abs(moved.cumsum(1)), np.abs(observed.cumsum())
    alive = np.ones(n_draws, dtype=bool)
    for k in range(n_groups):
        # As many of the draws may cross here as the error rate spent so far has left.
        room = int(ALPHA * (k + 1) / n_groups * n_draws) - int((~alive).sum())
        bound = np.sort(permuted[alive, k])[::-1][min(room, alive.sum() - 1)]
        if found[k] > bound + 1e-12:
            return True
        alive &= permuted[:, k] <= bound + 1e-12
    return False


def failing_more(share: float) -> Callable[[Generator, int], tuple[Scores, Scores]]:
    """The same agent, but one fails in so large a share of runs."""
    return lambda rng, n: (failing(0.0)(rng, (n,)), failing(share)(rng, (n,)))


def shifted(kind: str, shift: float) -> Callable[[Generator, int], tuple[Scores, Scores]]:
    """The same agent, but one scores so much more."""

    def draw(rng: Generator, n: int) -> tuple[Scores, Scores]:
        x, y = DISTRIBUTIONS[kind](rng, (2, n))
        return x + shift, y

    return draw


ALTERNATIVES: dict[str, Callable[[Generator, int], tuple[Scores, Scores]]] = {
    "normal, 1 standard deviation apart": shifted("normal", 1),
    "normal, 2 standard deviations apart": shifted("normal", 2),
    "exponential, 1 standard deviation apart": shifted("exponential", 1),
    "log-normal, 1 interquartile range apart": shifted("log-normal", 1.45),
    "fails in 5 %, 0.02 apart": shifted("fails in 5 %", 0.02),
    "one fails in 40 %, the other never": failing_more(0.4),
}


def print_power(studies: int) -> None:
    """Differences found: at one look, and over groups of five seeds."""
    rng = np.random.default_rng(2)
    print(f"\nDifferences found, per cent of {studies:,} studies; Welch, AdaStop, verdict\n")
    print("| scores | 5 seeds | 10 seeds | 20 seeds | 5, 10, 15, 20 seeds |")
    print("|---|---|---|---|---|")
    for kind, draw in ALTERNATIVES.items():
        cells = []
        for n, group in ((5, 5), (10, 10), (20, 20), (20, 5)):
            n_looks = n // group
            found = np.zeros(3)
            for _ in range(studies):
                x, y = draw(rng, n)
                looks = [(x[:m], y[:m]) for m in range(group, n + 1, group)]
                level = level_of_look(ALPHA, 1, n_looks)
                found += (
                    any(stats.ttest_ind(*xy, equal_var=False).pvalue <= level for xy in looks),
                    adastop(x, y, group, rng),
                    any(verdict(*xy, level) in {"better", "worse"} for xy in looks),
                )
            cells.append(", ".join(f"{100 * share:.0f}" for share in found / studies))
        print(f"| {kind} | {' | '.join(cells)} |", flush=True)


def print_power_of_equivalence(studies: int) -> None:
    """Equivalence found between an agent and itself, beside two one-sided Welch tests."""
    rng = np.random.default_rng(3)
    print(f"\nEquivalence found, per cent of {studies:,} studies; Welch, verdict\n")
    print("| scores, margin | 5 seeds | 10 seeds | 20 seeds | 50 seeds |\n|---|---|---|---|---|")
    for kind, margin in (("normal", 1.0), ("exponential", 1.0), ("fails in 5 %", 0.02)):
        cells = []
        for n in (5, 10, 20, 50):
            found = np.zeros(2)
            for _ in range(studies):
                x, y = DISTRIBUTIONS[kind](rng, (2, n))
                sides = [
                    stats.ttest_ind(a + margin, b, equal_var=False, alternative="greater").pvalue
                    for a, b in ((x, y), (y, x))
                ]
                found += (max(sides) <= ALPHA, verdict(x, y, ALPHA, margin) == "equivalent")
            cells.append(", ".join(f"{100 * share:.0f}" for share in found / studies))
        print(f"| {kind}, {margin:g} | {' | '.join(cells)} |", flush=True)


def print_power_of_failures(studies: int) -> None:
    """How often an agent that fails is said to fail more often than one that never does."""
    rng = np.random.default_rng(4)
    print(f"\nFailures told from none, per cent of {studies:,} studies\n")
    print("| fails in | 5 seeds | 10 seeds | 20 seeds | 50 seeds |\n|---|---|---|---|---|")
    for share in (0.1, 0.2, 0.4):
        found = [
            np.mean(
                [unreliable(np.stack(failing_more(share)(rng, n)), ALPHA) for _ in range(studies)]
            )
            for n in (5, 10, 20, 50)
        ]
        print(f"| {share:.0%} | {' | '.join(f'{100 * each:.0f}' for each in found)} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--studies", type=int, default=400, help="simulated for each figure")
    studies = parser.parse_args().studies
    print_power(studies)
    print_power_of_equivalence(studies)
    print_power_of_failures(studies)


if __name__ == "__main__":
    main()
