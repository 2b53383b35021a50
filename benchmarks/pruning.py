"""What ending trials early saves and errs, on a toy whose scores are as those of learning agents.

A setting has a typical score and a share of seeds on which it fails; seeds are harder or easier for
all settings alike. Settings are drawn at random; the search goes through them one by one, and
chooses the highest mean among those that it has judged on all seeds.

    python benchmarks/pruning.py            # some minutes
    python benchmarks/pruning.py 20         # fewer searches on each toy, in less time
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from tuning.pruning import PRUNERS, Scores, is_hopeless

SEEDS = (3, 5, 10, 20)
N_TRIALS = 25
N_SEARCHES = 50
# How much of what makes a run fail is the seed's, whatever the setting.
SHARED = 0.3


@dataclass(frozen=True)
class Toy:
    """Where settings come from.

    Attributes:
        name: what is said of it.
        rarity: how rare good settings are: quality is uniform on [0, 1] to this power.
        failing: the share of seeds on which the worst setting fails.
        spread: the standard deviation of scores of runs that do not fail.
    """

    name: str
    rarity: float
    failing: float
    spread: float


TOYS = (
    Toy("seeds fail", 1.0, 0.9, 0.02),
    Toy("seeds fail, good settings are rare", 3.0, 0.9, 0.05),
    Toy("no seed fails, scores are noisy", 1.0, 0.0, 0.15),
)


@dataclass(frozen=True)
class Outcome:
    """What a search came to.

    Attributes:
        n_runs: how many runs it did.
        truth: the true mean of what it chose.
        lost: whether it ended what it would have chosen without ending any.
    """

    n_runs: int
    truth: float
    lost: bool


class Settings:
    """Settings drawn from a toy, and their scores on seeds.

    Args:
        toy: where they come from.
        n_settings: how many.
        n_seeds: how many seeds each has.
        rng: draws them.
    """

    def __init__(self, toy: Toy, n_settings: int, n_seeds: int, rng: np.random.Generator) -> None:
        quality = rng.uniform(size=(n_settings, 1)) ** toy.rarity
        self._typical, self._failing = 0.5 + 0.5 * quality, toy.failing * (1 - quality) ** 2
        self._toy, self._rng = toy, rng
        self.scores = self._draw(n_seeds)
        # Close enough: a thousand seeds and more.
        self.truth = self._draw(1000).mean(axis=1)

    def _draw(self, n_seeds: int) -> np.ndarray:
        shape = (len(self._typical), n_seeds)
        of_seeds, own = self._rng.normal(size=(1, n_seeds)), self._rng.normal(size=shape)
        luck = np.sqrt(SHARED) * of_seeds + np.sqrt(1 - SHARED) * own
        fails = luck < ndtri(self._failing)
        well = np.minimum(self._typical + self._toy.spread * self._rng.normal(size=shape), 1.0)
        return np.where(fails, well * self._rng.uniform(0.0, 0.6, size=shape), well)


def search(settings: Settings, method: str, most_runs: int) -> tuple[int, list[int]]:
    """Go through settings until there are none left, or no runs; runs done, and those judged."""
    n_settings, n_seeds = settings.scores.shape
    others: list[Scores] = []
    judged: list[int] = []
    n_runs = 0
    for number in range(n_settings):
        scores: dict[int, float] = {}
        for seed in range(n_seeds):
            if n_runs == most_runs:
                return n_runs, judged
            scores[seed] = float(settings.scores[number, seed])
            n_runs += 1
            whole = len(scores) == n_seeds
            if not whole and number and is_hopeless(scores, others, method, n_seeds=n_seeds):
                break
            if whole:
                judged.append(number)
        others.append(scores)
    return n_runs, judged


def chosen(settings: Settings, judged: list[int]) -> int:
    """The setting with the highest mean over its seeds."""
    return max(judged, key=lambda number: float(settings.scores[number].mean()))


def outcomes(n_seeds: int, method: str, n_searches: int) -> Iterator[tuple[Outcome, float]]:
    """Searches through so many settings; and what the same number of runs would have come to."""
    for toy in TOYS:
        for seed in range(n_searches):
            rng = np.random.default_rng(seed)
            settings = Settings(toy, N_TRIALS * 4, n_seeds, rng)
            _, judged = search(settings, method, N_TRIALS * n_seeds)
            at_equal_cost = float(settings.truth[chosen(settings, judged)])
            settings.scores = settings.scores[:N_TRIALS]
            n_runs, judged = search(settings, method, N_TRIALS * n_seeds)
            choice = chosen(settings, judged)
            without = chosen(settings, list(range(N_TRIALS)))
            outcome = Outcome(n_runs, float(settings.truth[choice]), without not in judged)
            yield outcome, at_equal_cost


def main() -> None:
    """Print a table for each number of seeds."""
    n_searches = int(sys.argv[1]) if sys.argv[1:] else N_SEARCHES
    print(f"{N_TRIALS} trials a search, {n_searches} searches on each of {len(TOYS)} toys\n")
    print("| seeds | pruner | runs | lost | true score of the choice | at equal runs |")
    print("|---|---|---|---|---|---|")
    for n_seeds in SEEDS:
        for method in PRUNERS:
            rows = list(outcomes(n_seeds, method, n_searches))
            runs = np.mean([o.n_runs for o, _ in rows]) / (N_TRIALS * n_seeds)
            lost = np.mean([o.lost for o, _ in rows])
            truth = np.mean([o.truth for o, _ in rows])
            equal = np.mean([at_equal_cost for _, at_equal_cost in rows])
            print(
                f"| {n_seeds} | `{method}` | {runs:.0%} | {lost:.0%} | {truth:.4f} | {equal:.4f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
