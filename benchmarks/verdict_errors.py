"""Error rates of a study's sentences, coverage of its intervals, and power of its verdicts.

    nice python benchmarks/verdict_errors.py [TABLE ...] [--studies 1000] [--publish]

Errors: the share of studies with any false sentence, on means, typical runs and failures together,
by distribution of scores, number of agents and seeds. The last column is of studies that grow: 5,
10, 20 and 40 seeds until all is decided. A conditional sentence is false if its condition holds and
its claim does not. The error rate must be at most 5 %; here one look spends all of it.

Environments: the same for studies of 3 and 10 of them. Paired: runs that share their randomness.

Power: how often the agent ahead is found, compared with Welch's test, the Mann-Whitney test and
AdaStop (Mathieu et al., 2023), each at 5 %. Growth: saved runs.

Distributions after Waudby-Smith and Ramdas (2024) and Learned-Miller and Thomas (2019): equal
means, and rare failures or successes that few runs show.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass
from functools import cache, cached_property
from io import StringIO
from itertools import combinations
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import stats

from verdicts import (
    Ends,
    Judgement,
    compare_means,
    count_failures,
    fail_more_often,
    failure_threshold,
    grow,
    judge_pairs,
    level_of_claim,
    level_of_environment,
    look_sizes,
    mean_interval,
)

Scores = NDArray[np.float64]
Draw = Callable[[Generator, int], Scores]

DOCS = Path(__file__).resolve().parent.parent / "docs"
MEASURED = DOCS / "measured"
sys.path.append(str(DOCS / "scripts"))

from measured_tables import publish  # noqa: E402

ALPHA = 0.05
MARGIN = 0.02
ENDS = Ends(0.0, 1.0)
SIZES = (3, 5, 8, 10, 20, 50)
LOOKS = (5, 10, 20, 40)
LARGE = 200_000
# The error of a share or a mean of the large sample below.
SLACK = 0.004


@dataclass(frozen=True)
class Law:
    """A distribution of scores between 0 and 1."""

    draw: Draw

    @cached_property
    def known(self) -> Scores:
        """A large sorted sample, for its mean and shares."""
        return np.sort(self.draw(np.random.default_rng(99), LARGE))

    @cached_property
    def mean(self) -> float:
        """The mean score of a run."""
        return float(self.known.mean())

    def share_below(self, score: float) -> float:
        """The share of runs with a lower score."""
        return float(np.searchsorted(self.known, score - 1e-12)) / LARGE

    def share_above(self, score: float) -> float:
        """The share of runs with a higher score."""
        return 1 - float(np.searchsorted(self.known, score + 1e-12, side="right")) / LARGE


@cache
def share_won(law: Law, other: Law, lead: float = 0.0) -> float:
    """How often a run, with ``lead`` added, beats a run of the other law; ties count half."""
    own = np.random.default_rng(1).choice(law.known, 20_000) + lead
    below = np.searchsorted(other.known, own - 1e-12, side="left")
    up_to = np.searchsorted(other.known, own + 1e-12, side="right")
    return float((below + up_to).mean()) / 2 / LARGE


def normal(mean: float, deviation: float) -> Law:
    """Normal scores, clipped to [0, 1]."""
    return Law(lambda rng, n: np.clip(rng.normal(mean, deviation, n), 0, 1))


def skewed(mean: float, deviation: float, sign: int = 1) -> Law:
    """Exponential scores, skewed upwards or downwards, clipped to [0, 1]."""
    return Law(
        lambda rng, n: np.clip(mean + sign * deviation * (rng.exponential(size=n) - 1), 0, 1)
    )


def heavy(mean: float) -> Law:
    """Scores with heavy tails, clipped to [0, 1]: Student's t with 1.5 degrees of freedom."""
    return Law(lambda rng, n: np.clip(mean + 0.03 * rng.standard_t(1.5, n), 0, 1))


def coin(share: float) -> Law:
    """Bernoulli scores: 1 in this share of runs, else 0."""
    return Law(lambda rng, n: (rng.random(n) < share).astype(np.float64))


def failing(share: float, score: float = 0.95, deviation: float = 0.01) -> Law:
    """Scores near ``score``, but 0 in this share of runs."""
    width = deviation * 12**0.5

    def draw(rng: Generator, n: int) -> Scores:
        scores = score + width * (rng.random(n) - 0.5)
        return np.where(rng.random(n) < share, 0.0, scores)

    return Law(draw)


def steady(score: float) -> Law:
    """A constant score."""
    return Law(lambda rng, n: np.full(n, score))


def tied(rng: Generator, n: int) -> Scores:
    """Four different scores, one of them in most runs."""
    return rng.choice([0.0, 0.5, 0.9, 1.0], n, p=[0.1, 0.1, 0.2, 0.6])


# Two laws with the same mean, or just beyond the margin; further agents repeat them.
FAMILIES: dict[str, tuple[Law, Law]] = {
    "normal": (normal(0.6, 0.06),) * 2,
    "normal, spreads 1 to 5": (normal(0.6, 0.02), normal(0.6, 0.1)),
    "normal, spreads 1 to 10": (normal(0.5, 0.01), normal(0.5, 0.1)),
    "exponential": (skewed(0.4, 0.08),) * 2,
    "exponential and mirrored": (skewed(0.5, 0.08), skewed(0.5, 0.08, -1)),
    "heavy tails": (heavy(0.5),) * 2,
    "heavily tied": (Law(tied),) * 2,
    "0 or 1, even": (coin(0.5),) * 2,
    "0 or 1, 9 in 10": (coin(0.9),) * 2,
    "always 0.5, and 0 or 1": (steady(0.5), coin(0.5)),
    "always 0.1, and 1 in 1 of 10": (steady(0.1), coin(0.1)),
    "all runs alike": (steady(0.86),) * 2,
    **{f"both fail in {p:.0%}": (failing(p),) * 2 for p in (0.02, 0.05, 0.1, 0.3)},
    **{
        f"steady, and fails in {p:.0%}": (failing(0.0, 0.97 * (1 - p)), failing(p, 0.97))
        for p in (0.02, 0.05, 0.1, 0.3)
    },
    "beyond the margin, normal": (normal(0.6, 0.02), normal(0.6205, 0.02)),
    "beyond the margin, one fails in 3 %": (failing(0.03), failing(0.0)),
    "beyond the margin, both fail in 5 %": (failing(0.05, 0.95), failing(0.05, 0.9285)),
}


# False sentences of a study.


def false_of_pair(
    judged: Judgement, laws: tuple[Law, Law], runs: tuple[Scores, Scores], level: float
) -> str:
    """Which sentence on a pair of agents is false, at the level of one pair; empty for none."""
    said, apart = judged.mean, laws[0].mean - laws[1].mean
    if said.verdict == "worse":
        other = Judgement(said.swapped(), "undecided")
        turned = false_of_pair(other, (laws[1], laws[0]), (runs[1], runs[0]), level)
        return turned or _false_typical(judged, laws)
    if said.verdict == "better" and apart <= 1e-4:
        outside = laws[0].share_below(runs[0].min()), laws[1].share_above(runs[1].max())
        if not said.is_conditional:
            return "ahead"
        if max(outside) < compare_means(*runs, level).most_outside:
            return "ahead, if"
    if said.verdict == "equivalent" and abs(apart) > MARGIN + 1e-4:
        pairs = list(zip(laws, runs, strict=True))
        seen = [law.share_below(x.min()) + law.share_above(x.max()) for law, x in pairs]
        # The condition holds only if no further run is outside of those seen.
        if not said.is_conditional or max(seen) == 0:
            return "equivalent, if" if said.is_conditional else "equivalent"
    return _false_typical(judged, laws)


def _false_typical(judged: Judgement, laws: tuple[Law, Law]) -> str:
    wins = share_won(*laws)
    if judged.typical == "equivalent":
        beyond = min(share_won(*laws, MARGIN), share_won(*laws[::-1], MARGIN))
        return "typical runs equal" if beyond < 0.5 - SLACK else ""
    is_false = {"better": wins <= 0.5 + SLACK, "worse": wins >= 0.5 - SLACK}
    return "typical run" if is_false.get(judged.typical, False) else ""


def false_of_failures(laws: Sequence[Law], runs: Sequence[Scores], level: float) -> str:
    """Which sentence on failures is false; empty for none."""
    threshold = failure_threshold(0.0, max(float(np.median(each)) for each in runs))
    if np.isnan(threshold):
        return ""
    share = level_of_claim(level, "failures") / len(runs)
    counts = {str(k): count_failures(each, threshold, share) for k, each in enumerate(runs)}
    fail = [law.share_below(threshold) for law in laws]
    if any(fail[int(k)] > count.most + SLACK for k, count in counts.items()):
        return "limit on failures"
    more = fail_more_often(counts, level_of_claim(level, "fails more"))
    return "fails more often" if any(fail[int(a)] <= fail[int(b)] for a, b in more) else ""


def false_of_study(laws: Sequence[Law], runs: Sequence[Scores], level: float) -> set[str]:
    """The kinds of false sentences of a study with one look."""
    scores = {str(k): each for k, each in enumerate(runs)}
    judged = judge_pairs(scores, MARGIN, level, ends=ENDS)
    share = level_of_claim(level, "means") / len(judged) / (2 if len(laws) > 2 else 1)
    found = {false_of_failures(laws, runs, level)}
    for (a, b), judgement in judged.items():
        i, j = int(a), int(b)
        found.add(false_of_pair(judgement, (laws[i], laws[j]), (runs[i], runs[j]), share))
    return found - {""}


def false_of_grown(laws: Sequence[Law], runs: Sequence[Scores], level: float) -> set[str]:
    """The kinds of false sentences of a study that looks until all is decided."""
    scores = {str(k): each for k, each in enumerate(runs)}
    growth = grow(scores, LOOKS, MARGIN, level, ends=ENDS)
    found: set[str] = set()
    for (a, b), judgement in growth.judged.items():
        n, i, j = LOOKS[growth.looks[a, b] - 1], int(a), int(b)
        both = runs[i][:n], runs[j][:n]
        share = level_of_claim(growth.level, "means") / len(growth.judged)
        found.add(false_of_pair(judgement, (laws[i], laws[j]), both, share))
    shown = [runs[k][: growth.seeds[str(k)]] for k in range(len(runs))]
    return (found | {false_of_failures(laws, shown, growth.level)}) - {""}


# The tables.


def row(cells: Iterable[object]) -> None:
    """Print a row of a table in Markdown."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def heading(cells: Sequence[object]) -> None:
    """Print the heading of a table."""
    row(cells)
    print("|" + "---|" * len(cells))


def print_errors(studies: int) -> None:
    """Print the shares of studies with a false sentence."""
    print(
        f"\nStudies with a false sentence, per cent of {studies:,}, the highest of 2, 4 and 10 "
        "agents; of which kind, where over 1; with ten agents a tenth\nas many studies\n"
    )
    heading(["scores", *(f"{n} seeds" for n in SIZES), "grown"])
    for name, both in FAMILIES.items():
        by_agents = []
        for n_agents in (2, 4, 10):
            rng = np.random.default_rng(n_agents)
            n_studies = studies if n_agents < 10 else max(studies // 10, 1)
            laws = [both[k % 2] for k in range(n_agents)]
            cells = []
            for n in (*SIZES, None):
                judge = false_of_study if n else false_of_grown
                found: Counter[str] = Counter()
                n_false = 0
                for _ in range(n_studies):
                    false = judge(laws, [law.draw(rng, n or LOOKS[-1]) for law in laws], ALPHA)
                    n_false += bool(false)
                    found.update(false)
                many = [kind for kind, times in found.items() if times > n_studies / 100]
                cells.append(" ".join([f"{100 * n_false / n_studies:.1f}", *sorted(many)]))
            by_agents.append(cells)
        highest = (
            max(cells, key=lambda cell: float(cell.split()[0]))
            for cells in zip(*by_agents, strict=True)
        )
        row([name, *highest])


def print_environments(studies: int) -> None:
    """Print the shares of studies of several environments with a false sentence."""
    n_agents, n = 4, 10
    print(
        f"\nStudies of {n_agents} agents and {n} seeds with a false sentence on any environment or "
        f"on all together, per cent of {studies:,}\n"
    )
    heading(["scores", "1 environment", "3 environments", "10 environments"])
    never = 0
    for name, both in FAMILIES.items():
        laws, cells = [both[k % 2] for k in range(n_agents)], []
        for n_environments in (1, 3, 10):
            rng, n_false = np.random.default_rng(n_environments), 0
            level = level_of_environment(ALPHA, n_environments)
            for _ in range(studies):
                runs = [[law.draw(rng, n) for law in laws] for _ in range(n_environments)]
                found = set().union(*(false_of_study(laws, each, level) for each in runs))
                if n_environments > 1:
                    means = np.mean(runs, axis=0)  # by agent and seed
                    together = {str(k): each for k, each in enumerate(means)}
                    found |= _false_together(laws, together, level)
                n_false += bool(found)
            cells.append(f"{100 * n_false / studies:.1f}")
        if set(cells) == {"0.0"}:
            never += 1
        else:
            row([name, *cells])
    row([f"each of the {never} others", *["0.0"] * 3])


def _false_together(laws: Sequence[Law], means: dict[str, Scores], level: float) -> set[str]:
    """False unconditional verdicts on the agents' means over environments."""
    judged = judge_pairs(means, MARGIN, level, ends=ENDS)
    found = set()
    for (a, b), judgement in judged.items():
        apart, said = laws[int(a)].mean - laws[int(b)].mean, judgement.mean
        is_false = {
            "better": apart <= 1e-4,
            "worse": apart >= -1e-4,
            "equivalent": abs(apart) > MARGIN + 1e-4,
        }
        if not said.is_conditional and is_false.get(said.verdict, False):
            found.add("all environments")
    return found


def print_paired(studies: int) -> None:
    """Print errors and power for runs of one seed that share their randomness."""
    print(f"\nShared randomness: false, and found ahead paired and not, per cent of {studies:,}\n")
    heading(["correlation", *(f"{n} seeds" for n in (5, 10, 20))])
    for correlation in (0.0, 0.4, 0.8):
        cells = []
        for n in (5, 10, 20):
            rng, found = np.random.default_rng(n), np.zeros(3)
            for _ in range(studies):
                shared, first, second = rng.normal(0.0, 0.06, (3, n))
                own = correlation**0.5 * shared
                x, y = (own + (1 - correlation) ** 0.5 * each + 0.6 for each in (first, second))
                for k, lead, paired in ((0, 0.0, True), (1, 0.06, True), (2, 0.06, False)):
                    runs = {"x": np.clip(x + lead, 0, 1), "y": np.clip(y, 0, 1)}
                    judged = judge_pairs(runs, MARGIN, ALPHA, ends=ENDS, paired=paired)
                    said = judged["x", "y"].mean.verdict
                    found[k] += said == "better" or (said == "worse" and not lead)
            cells.append(", ".join(f"{100 * share:.1f}" for share in found / studies))
        row([correlation, *cells])


def print_coverage(studies: int) -> None:
    """Print the coverage of intervals of a mean, and of a difference of means."""
    print(f"\n95 % intervals that hold the truth, lowest of all laws, per cent of {studies:,}\n")
    heading(["interval", *(f"{n} seeds" for n in SIZES)])
    means: dict[int, tuple[float, str]] = {}
    gaps: dict[int, tuple[float, str]] = {}
    for name, (first, second) in FAMILIES.items():
        for n in SIZES:
            rng, held = np.random.default_rng(n), np.zeros(2)
            for _ in range(studies):
                x, y = first.draw(rng, n), second.draw(rng, n)
                (low, high), own = mean_interval(y, ALPHA), mean_interval(x, ALPHA)
                apart = first.mean - second.mean
                # The interval of a difference contains these bounds, which are computed faster.
                least = min(own[0] - y.mean(), x.mean() - high)
                most = max(own[1] - y.mean(), x.mean() - low)
                is_held = least <= apart <= most
                if not is_held:
                    gap = compare_means(x, y, ALPHA)
                    is_held = gap.low - 1e-4 <= apart <= gap.high + 1e-4
                held += low - 1e-4 <= second.mean <= high + 1e-4, is_held
            for worst, share in zip((means, gaps), 100 * held / studies, strict=True):
                worst[n] = min(worst.get(n, (101.0, "")), (float(share), name))
    for kind, worst in (("mean", means), ("difference of means", gaps)):
        row([kind, *(f"{share:.1f} ({name})" for share, name in worst.values())])


POWER: dict[str, tuple[Law, Law]] = {
    "normal, 1 standard deviation apart": (normal(0.66, 0.06), normal(0.6, 0.06)),
    "normal, 2 standard deviations apart": (normal(0.72, 0.06), normal(0.6, 0.06)),
    "exponential, 1 standard deviation apart": (skewed(0.6, 0.08), skewed(0.52, 0.08)),
    "never fails, fails in 10 %": (failing(0.0), failing(0.1)),
    "never fails, fails in 30 %": (failing(0.0), failing(0.3)),
    "never fails, fails in 60 %": (failing(0.0), failing(0.6)),
    "always 0.95, and 0.985 but fails in 10 %": (failing(0.0), failing(0.1, 0.9856)),
    "0.99 and 0.3": (failing(0.0, 0.99), failing(0.0, 0.3)),
}


def print_power(studies: int) -> None:
    """Print how often the agent with the higher mean is found ahead."""
    tests = "verdict without a condition, verdict, Welch, Mann and Whitney, AdaStop"
    print(f"\nThe agent ahead is found, per cent of {studies:,} studies: {tests}\n")
    sizes = (5, 10, 20, 50)
    heading(["scores", *(f"{n} seeds" for n in sizes)])
    for name, (first, second) in POWER.items():
        cells = []
        for n in sizes:
            rng, found = np.random.default_rng(n), np.zeros(5)
            for _ in range(studies):
                x, y = first.draw(rng, n), second.draw(rng, n)
                mean = judge_pairs({"x": x, "y": y}, 0.0, ALPHA, ends=ENDS)["x", "y"].mean
                is_ahead = mean.verdict == "better"
                found += (
                    is_ahead and not mean.is_conditional,
                    is_ahead,
                    stats.ttest_ind(x, y, equal_var=False).pvalue <= ALPHA and x.mean() > y.mean(),
                    stats.mannwhitneyu(x, y).pvalue <= ALPHA and x.mean() > y.mean(),
                    adastop(x, y, 5, rng) and x.mean() > y.mean(),
                )
            cells.append(", ".join(f"{100 * share:.0f}" for share in found / studies))
        row([name, *cells])
    print(f"\nThe best of four is found, and another is called best, per cent of {studies:,}\n")
    heading(["scores", *(f"{n} seeds" for n in sizes)])
    for lead in (0.0, 1.0, 2.0):
        laws = [normal(0.6 + lead * 0.06, 0.06), *[normal(0.6, 0.06)] * 3]
        cells = []
        for n in sizes:
            rng, hits = np.random.default_rng(n), Counter[str]()
            for _ in range(studies):
                scores = {str(k): law.draw(rng, n) for k, law in enumerate(laws)}
                judged = judge_pairs(scores, 0.0, ALPHA, ends=ENDS)
                wins = Counter(
                    a if each.mean.verdict == "better" else b
                    for (a, b), each in judged.items()
                    if each.mean.verdict in ("better", "worse")
                )
                hits.update(name for name, n_won in wins.items() if n_won == len(laws) - 1)
            n_wrong = sum(times for name, times in hits.items() if name != "0" or not lead)
            cells.append(f"{100 * hits['0'] / studies:.0f}, {100 * n_wrong / studies:.1f}")
        row([f"{lead:g} standard deviations ahead of three others", *cells])


def adastop(first: Scores, second: Scores, group: int, rng: Generator, n_draws: int = 500) -> bool:
    """Whether AdaStop finds a difference, in groups of ``group`` seeds, with ALPHA in all."""
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
        # The number of draws that may cross here, by the error rate left so far.
        room = int(ALPHA * (k + 1) / n_groups * n_draws) - int((~alive).sum())
        bound = np.sort(permuted[alive, k])[::-1][min(room, alive.sum() - 1)]
        if found[k] > bound + 1e-12:
            return True
        alive &= permuted[:, k] <= bound + 1e-12
    return False


GROWN: dict[str, list[Law]] = {
    "as the headline": [
        *(steady(1.0), normal(0.984, 0.002)),
        *(failing(0.0, 0.98), failing(0.05, 0.98), failing(0.1, 0.9)),
    ],
    "two agents, 1 standard deviation apart": [normal(0.66, 0.06), normal(0.6, 0.06)],
    "two agents, the same": [normal(0.6, 0.01)] * 2,
    "five agents, 0 to 4 standard deviations": [
        normal(0.5 + 0.06 * apart, 0.06) for apart in (0, 0, 1, 2, 4)
    ],
}


def print_growth(studies: int) -> None:
    """Print runs and decided pairs of fixed and growing studies."""
    print(f"\nMean number of runs, per cent of pairs decided, {studies:,} studies\n")
    fixed, most = (10, 30, 50), (30, 50)
    heading(["scores", *(f"{n} seeds" for n in fixed), *(f"grown to {n}" for n in most)])
    for name, laws in GROWN.items():
        rng, found = np.random.default_rng(6), Counter[str]()
        for _ in range(studies):
            scores = {str(k): law.draw(rng, fixed[-1]) for k, law in enumerate(laws)}
            for n in fixed:
                first = {key: values[:n] for key, values in scores.items()}
                judged = judge_pairs(first, MARGIN, ALPHA, decided={}, ends=ENDS).values()
                found[f"fixed {n}"] += sum(each.is_decided for each in judged)
                found[f"fixed {n} runs"] += n * len(laws)
            for n in most:
                first = {key: values[:n] for key, values in scores.items()}
                sizes = look_sizes(fixed[0], n, len(laws), ALPHA)
                growth = grow(first, sizes, MARGIN, ALPHA, ends=ENDS)
                found[f"grown {n}"] += sum(each.is_decided for each in growth.judged.values())
                found[f"grown {n} runs"] += sum(growth.seeds.values())
        n_pairs = len(list(combinations(laws, 2)))
        keys = [*(f"fixed {n}" for n in fixed), *(f"grown {n}" for n in most)]
        cells = [
            f"{found[f'{key} runs'] / studies:.0f}, {100 * found[key] / studies / n_pairs:.0f}"
            for key in keys
        ]
        row([name, *cells])


TABLES: dict[str, Callable[[int], None]] = {
    "errors": print_errors,
    "environments": print_environments,
    "paired": print_paired,
    "coverage": print_coverage,
    "power": print_power,
    "growth": print_growth,
}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=", ".join(TABLES))
    parser.add_argument("--studies", type=int, default=1000, help="simulated for each figure")
    parser.add_argument("--publish", action="store_true", help=f"write into {MEASURED}")
    args = parser.parse_args()
    for name in args.tables or TABLES:
        with ExitStack() as stack:
            if args.publish:
                text = stack.enter_context(redirect_stdout(StringIO()))
            TABLES[name](args.studies)
        if args.publish:
            publish(MEASURED / f"verdict-{name}.json", text.getvalue())


if __name__ == "__main__":
    main()
