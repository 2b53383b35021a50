"""How often verdicts are false, and how often they are given: simulated studies.

    nice python benchmarks/verdict_errors.py [TABLE ...] [--quick] [--json FILE]

Studies are drawn from verdict_bank.npz, final scores of many real runs, and from textbook
distributions. The truth is the mean of all scores of an entry of the bank. `verdicts.judge` takes
milliseconds for a study; its rules are here again for all studies at once, and the table "coverage"
compares both.

Figures in brackets leave out words on agents that fail in 1 to 99 % of runs, but did so in none or
all of the study's: no test can know of failures that no run had. A run fails below half of the best
agent's median.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy import special

from rl_yardstick.verdicts import judge

sys.path.append(str(Path(__file__).resolve().parent.parent / "docs" / "scripts"))

from measured_tables import publish

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Shape = tuple[int, int]  # numbers of environments and agents

BANK = Path(__file__).with_name("verdict_bank.npz")
MARGIN, DIFFERENT, TIED = 0.02, 0.04, 0.01  # the level of 5 % in two parts
SAME, ROUNDING = 1e-12, 1e-9
SIZES, LOOKS = (3, 5, 10, 20, 30), (10, 20, 40, 80)
STUDIES = {1: 2000, 7: 500}  # for each figure, by number of environments
GROWING = ("normal", "one fails in 5%, the other never", "one fails in 10%, the other never")
WORDS = {"undecided": 0, "better": 1, "worse": -1, "tied": 2}


# --- Studies drawn from distributions.


class Runs(NamedTuple):
    """Studies of equally many runs of all agents; arrays are by study, environment and agent."""

    scores: Floats  # with runs along a last axis
    mean: Floats  # the truth, as the following
    low: Floats  # the quantile of 1 %
    high: Floats  # the quantile of 99 %
    threshold: Floats  # a run with a lower score failed

    def show_all(self) -> Bools:
        """Whether some of the agent's runs failed and some did not, if that is to be expected."""
        fails: Bools = (self.scores.min(-1) < self.threshold) | (self.low >= self.threshold)
        works: Bools = (self.scores.max(-1) >= self.threshold) | (self.high < self.threshold)
        return fails & works


class Source:
    """Distributions of scores, and how a study chooses those of its agents."""

    def __init__(
        self, laws: Mapping[str, Floats], choose: Callable[[Source, Generator, int], Ints]
    ) -> None:
        self.choose = choose
        ordered = [np.sort(law.astype(np.float64)) for law in laws.values()]
        self.environment = np.array([name.partition("|")[0] for name in laws])
        self.mean, self._median = np.array([(law.mean(), np.median(law)) for law in ordered]).T
        self._low, self._high = np.array([np.quantile(law, (0.01, 0.99)) for law in ordered]).T
        self.varying = np.flatnonzero([np.ptp(law) > SAME for law in ordered])
        self._size = np.array([len(law) for law in ordered])
        self._scores = np.concatenate(ordered)

    def draw(self, shape: Shape, n: int, n_studies: int) -> Runs:
        """Draw studies of ``n`` runs of each agent; always the same."""
        rng = np.random.default_rng([*shape, n])
        chosen = np.array(
            [[self.choose(self, rng, shape[1]) for _ in range(shape[0])] for _ in range(n_studies)]
        )
        start = (np.cumsum(self._size) - self._size)[chosen]
        at = (rng.random((*chosen.shape, n)) * self._size[chosen][..., None]).astype(int)
        best = self._median[chosen].max(-1, keepdims=True)
        return Runs(
            self._scores[start[..., None] + at],
            self.mean[chosen],
            self._low[chosen],
            self._high[chosen],
            np.where(best > 0, best / 2, -np.inf),
        )


def bank() -> dict[str, Source]:
    """Studies of real runs: with different, equal and nearly equal entries of the bank."""
    with np.load(BANK) as stored:
        laws = dict(stored)

    def different(source: Source, rng: Generator, n: int) -> Ints:
        names, counts = np.unique(source.environment, return_counts=True)
        env_id = rng.choice(names[counts >= n])
        return rng.permutation(np.flatnonzero(source.environment == env_id))[:n]

    def same(source: Source, rng: Generator, n: int) -> Ints:
        return np.repeat(rng.choice(source.varying), n)

    def near(source: Source, rng: Generator, n: int) -> Ints:
        apart = np.abs(source.mean[source.varying] - source.mean[rng.choice(source.varying)])
        return rng.choice(source.varying[apart <= 0.03], n)

    return {
        "different agents": Source(laws, different),
        "the same agent": Source(laws, same),
        "means within 0.03": Source(laws, near),
    }


def families() -> dict[str, Source]:
    """Textbook distributions with equal means, and one with means just beyond the margin."""
    share = (np.arange(20_000) + 0.5) / 20_000

    def at(mean: float, law: Floats) -> Floats:
        moved: Floats = law - law.mean() + mean
        return moved

    def normal(mean: float, deviation: float) -> Floats:
        return at(mean, deviation * special.ndtri(share))

    def failing(q: float) -> Floats:
        return np.where(share < q, 0.0, normal(0.95, 0.01))

    tail = -0.04 * np.log(share)
    laws = {
        "normal": (normal(0.6, 0.06),),
        "normal, deviations 1 to 10": (normal(0.6, 0.01), normal(0.6, 0.1)),
        "normal, cut at 1": (np.minimum(normal(0.99, 0.03), 1.0),),
        "four different scores": (np.repeat([0.0, 0.5, 0.9, 1.0], [2000, 2000, 4000, 12_000]),),
        "0 or 1, even": (np.round(share),),
        "exponential": (at(0.4, tail),),
        "exponential, opposite skews": (at(0.5, tail), at(0.5, -tail)),
        **{f"both fail in {q:.0%}": (failing(q),) for q in (0.02, 0.05, 0.1, 0.2)},
        **{
            f"one fails in {q:.0%}, the other never": (normal(failing(q).mean(), 0.01), failing(q))
            for q in (0.02, 0.05, 0.1, 0.2)
        },
        "normal, 0.0201 apart": (normal(0.6, 0.02), normal(0.6201, 0.02)),
    }
    return {
        name: Source(
            {str(k): law for k, law in enumerate(each)},
            lambda source, _, n: np.arange(n) % len(source.mean),
        )
        for name, each in laws.items()
    }


# --- The rules of `judge` and others, for all studies at once; words as numbers, by pair.


def p_values(x: Floats, *, floor: bool = True) -> tuple[Floats, Ints, Floats]:
    """Of each pair: p of a difference, its sign, p of a tie; shape (studies, envs, pairs)."""
    n, (i, j) = x.shape[-1], np.triu_indices(x.shape[-2], 1)
    equal = np.ptp(x, -1) <= SAME * np.maximum(1.0, np.abs(x).max(-1))
    mean = np.where(equal, x[..., 0], x.mean(-1))
    variance = np.where(equal, 0.0, x.var(-1, ddof=1)) / n
    a, b, apart = variance[..., i], variance[..., j], mean[..., i] - mean[..., j]
    error = np.sqrt(a + b)
    lowest = special.stdtr(2 * n - 2, -((2.5 * n * (n + 1)) ** 0.5)) if floor else 0.0
    with np.errstate(all="ignore"):
        freedom = np.where(error > 0, (a + b) ** 2 / (a * a + b * b) * (n - 1), 2 * n - 2)

        def above(ahead: Floats) -> Floats:
            p = np.where(error > 0, special.stdtr(freedom, -ahead / error), ahead < 0)
            return np.where(np.abs(ahead) <= SAME, 0.5, np.maximum(p, lowest))

        p_different = 2 * np.minimum(above(apart), above(-apart))
        p_tied = np.maximum(above(apart + MARGIN), above(MARGIN - apart))
    return p_different, np.sign(apart).astype(int), p_tied


def holm(p: Floats, level: float) -> Bools:
    """The pairs below Holm's thresholds, over all pairs of a study."""
    flat = p.reshape(len(p), -1)
    order = np.argsort(flat, 1, kind="stable")
    allowed = np.take_along_axis(flat, order, 1) <= level / np.arange(flat.shape[1], 0, -1)
    below = np.empty_like(allowed)
    np.put_along_axis(below, order, np.logical_and.accumulate(allowed, 1), 1)
    return below.reshape(p.shape)


def deduced(signs: Ints, tied: Bools, n_agents: int) -> Ints:
    """The words, with those that follow from others."""
    i, j = np.triu_indices(n_agents, 1)
    ahead, same = np.zeros((2, *signs.shape[:2], n_agents, n_agents), bool)
    ahead[..., i, j], ahead[..., j, i] = signs == 1, signs == -1
    same[..., i, j] = same[..., j, i] = tied
    for _ in range(2 * n_agents):
        chain = ahead[..., :, :, None] & ahead[..., None, :, :]
        tied_chain = chain & same[..., :, None, :]
        ties = tied_chain.any(-1) | tied_chain.any(-3)
        ahead, same = ahead | chain.any(-2), same | ties | np.swapaxes(ties, -1, -2)
    return np.where(same[..., i, j], 2, ahead[..., i, j] * 1 - ahead[..., j, i])


def our_words(x: Floats) -> Ints:
    """The words of `judge`."""
    p, sign, p_tied = p_values(x)
    return deduced(np.where(holm(p, DIFFERENT), sign, 0), holm(p_tied, TIED), x.shape[-2])


def welch_words(x: Floats) -> Ints:
    """Welch's test with Holm's correction at 5 %, without ties."""
    p, sign, _ = p_values(x, floor=False)
    return np.where(holm(p, DIFFERENT + TIED), sign, 0)


def bootstrap_words(x: Floats, n_draws: int = 1000) -> Ints:
    """Better or worse if 95 % bootstrap intervals of means do not overlap, as read off plots."""
    n, (i, j) = x.shape[-1], np.triu_indices(x.shape[-2], 1)
    ends = []
    for k, few in enumerate(np.array_split(x, max(len(x) // 50, 1))):
        drawn = np.random.default_rng(k).multinomial(n, np.full(n, 1 / n), n_draws)
        ends.append(np.percentile(few @ drawn.T / n, (2.5, 97.5), axis=-1))
    low, high = np.concatenate(ends, 1)
    words: Ints = (low[..., i] > high[..., j]) * 1 - (high[..., i] < low[..., j])
    return words


def grown(x: Floats) -> tuple[Ints, Ints]:
    """Words and seeds of each agent, if only agents in undecided pairs get more seeds."""
    n_agents, n_looks = x.shape[-2], len(LOOKS)
    i, j = np.triu_indices(n_agents, 1)
    p, sign, p_tied = p_values(x[..., : LOOKS[0]])
    words, lowest, lowest_tied = np.zeros_like(sign), np.ones_like(p), np.ones_like(p)
    signs, seeds = sign, np.zeros(x.shape[:-1], int)
    for n in LOOKS:
        is_open = words == 0
        for k in range(n_agents):
            goes_on = is_open[..., (i == k) | (j == k)].any(-1)
            seeds[..., k] = np.where(goes_on, n, seeds[..., k])
        p, sign, p_tied = p_values(x[..., :n])
        signs = np.where(n_looks * p < lowest, sign, signs)
        lowest = np.where(is_open, np.minimum(lowest, n_looks * p), lowest)
        lowest_tied = np.where(is_open, np.minimum(lowest_tied, n_looks * p_tied), lowest_tied)
        ahead = np.where(is_open, np.where(holm(lowest, DIFFERENT), signs, 0), words % 2 * words)
        tied = np.where(is_open, holm(lowest_tied, TIED), words == 2)
        words = np.where(is_open, deduced(ahead, tied, n_agents), words)
    return words, seeds


# --- Figures of studies.


def apart(runs: Runs) -> Floats:
    """The true differences of the pairs."""
    i, j = np.triu_indices(runs.mean.shape[-1], 1)
    return runs.mean[..., i] - runs.mean[..., j]


def falsity(words: Ints, runs: Runs) -> Bools:
    """Whether better or worse, and whether tied, is false: of shape (2, studies, envs, pairs)."""
    true = np.where(np.abs(apart(runs)) <= ROUNDING, 0.0, apart(runs))
    wrong = np.isin(words, (1, -1)) & (words * true <= 0)
    return np.stack([wrong, (words == 2) & (np.abs(true) >= MARGIN - ROUNDING)])


def per_cent(false: Bools, runs: Runs) -> str:
    """Per cent of studies with a false word; those about agents that show all in brackets."""
    i, j = np.triu_indices(runs.mean.shape[-1], 1)
    shows = runs.show_all()
    counted = (false, false & shows[..., i] & shows[..., j])
    every, shown = (100 * each.any((1, 2)).mean() for each in counted)
    return f"{every:.1f} ({shown:.1f})"


def power(words: Ints, runs: Runs) -> str:
    """Per cent of pairs beyond the margin that get the right word; empty if there are none."""
    beyond = np.abs(apart(runs)) > MARGIN + ROUNDING
    right = words[beyond] == np.sign(apart(runs)[beyond])
    return f"{100 * right.mean():.0f}" if len(right) else ""


def outcome(runs: Runs, words: Ints, seeds: Ints | None = None) -> str:
    """Per cent of studies with a false word of each kind, power, and mean seeds if they vary."""
    if seeds is not None:
        is_seen = np.arange(runs.scores.shape[-1]) < seeds[..., None]
        runs = runs._replace(scores=np.where(is_seen, runs.scores, runs.scores[..., :1]))
    found = [*(per_cent(each, runs) for each in falsity(words, runs)), power(words, runs)]
    told = ", ".join(filter(None, found))
    return told if seeds is None else f"{told}; {seeds.mean():.0f} seeds"


def judged(runs: Runs) -> Counter[str]:
    """How `judge` does on studies: faults by kind, and coverage of the intervals of means."""
    found: Counter[str] = Counter(studies=len(runs.scores))
    truth = zip(runs.scores, runs.mean, runs.show_all(), our_words(runs.scores), strict=True)
    for x, means, shows_all, ours in truth:
        scores = {str(e): dict(zip("abcdefgh", by, strict=False)) for e, by in enumerate(x)}
        study = judge(scores, bounds=(-1.0, 1.0), margin=MARGIN)
        found["others"] += [WORDS[pair.word] for pair in study.pairs] != ours.ravel().tolist()
        better = set()
        for pair in study.pairs:
            low, high = pair.interval
            if pair.word in {"better", "worse"}:
                names = (pair.first, pair.second)[:: WORDS[pair.word]]
                better.add((pair.environment, *names))
            holds = {
                "better": low >= 0,
                "worse": high <= 0,
                "tied": low >= -MARGIN and high <= MARGIN,
                "undecided": low <= 0 <= high,
            }
            holds_all = holds[pair.word] and low <= pair.difference <= high
            found.update(intervals=1, contradictions=not holds_all)
        for e, by_agent in scores.items():
            for a, b, c in permutations(by_agent, 3):
                chain = {(e, a, b), (e, b, c)} <= better
                found.update(chains=chain, intransitive=chain and (e, a, c) not in better)
        for agent, mean, shows in zip(study.agents, means.flat, shows_all.flat, strict=True):
            low, high = agent.mean_interval
            held = low - ROUNDING <= mean <= high + ROUNDING
            found.update(all=1, held=held, showing=shows, showing_held=shows and held)
    return found


# --- The tables: each yields its paragraphs.


def by_size(
    sources: dict[str, Source],
    shapes: Iterable[Shape],
    scale: float,
    cell: Callable[[Runs], str],
    sizes: Iterable[int] = SIZES,
) -> str:
    """A table with a row for each source and shape, and a column for each number of seeds."""
    lines = [["studies", *(f"{n} seeds" for n in sizes)]]
    lines.append(["---"] * len(lines[0]))
    for name, source in sources.items():
        for shape in shapes:
            n_studies = max(int(STUDIES[shape[0]] * scale), 3)
            cells = (cell(source.draw(shape, n, n_studies)) for n in sizes)
            lines.append([f"{name}: {shape[1]} agents, {shape[0]} env.", *cells])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def errors(scale: float) -> Iterator[str]:
    """False words in studies of the bank."""
    yield (
        "Studies of real runs with a false word, per cent: better or worse, tied. In brackets "
        "without agents that fail in 1 to 99 % of runs, but in none or all of the study's. With 3 "
        'seeds all words say "so far", with 5 seeds ties do.'
    )

    def cell(runs: Runs) -> str:
        return ", ".join(per_cent(each, runs) for each in falsity(our_words(runs.scores), runs))

    shapes = [(n_envs, n_agents) for n_envs in (1, 7) for n_agents in (2, 4, 8)]
    yield by_size(bank(), shapes, scale, cell)


def others(scale: float) -> Iterator[str]:
    """The same studies by other methods."""
    yield (
        "Other methods: per cent of studies with a false better or worse; per cent of pairs beyond "
        "the margin that get the right word. `judge` / Welch's test with Holm's correction at 5 % "
        "/ 95 % bootstrap intervals of means that do not overlap."
    )

    def cell(runs: Runs) -> str:
        made = [method(runs.scores) for method in (our_words, welch_words, bootstrap_words)]
        false = (f"{100 * falsity(each, runs)[0].any((1, 2)).mean():.1f}" for each in made)
        right = filter(None, (power(each, runs) for each in made))
        return "; ".join(filter(None, map(" / ".join, (false, right))))

    sources = {name: source for name, source in bank().items() if "within" not in name}
    yield by_size(sources, ((1, 2), (1, 4), (1, 8), (7, 4)), scale, cell)


def textbook(scale: float) -> Iterator[str]:
    """False words in studies of textbook distributions."""
    yield (
        "Studies of textbook distributions with any false word, per cent. Agents have the two "
        "distributions in turn. One that fails in a share q of runs fails in none of n with a "
        "probability of (1 - q)^n."
    )

    def cell(runs: Runs) -> str:
        wrong, tied = falsity(our_words(runs.scores), runs)
        return per_cent(wrong | tied, runs)

    yield by_size(families(), ((1, 2), (7, 4)), scale, cell)


def coverage(scale: float) -> Iterator[str]:
    """`judge` itself: coverage, contradictions, and whether it agrees with the rules here."""
    total: Counter[str] = Counter()

    def cell(runs: Runs) -> str:
        total.update(found := judged(runs))
        shown = f"{100 * found['showing_held'] / found['showing']:.0f}" if found["showing"] else "-"
        return f"{100 * found['held'] / found['all']:.0f} ({shown})"

    yield "95 % intervals of a mean that hold it, per cent; in brackets of agents that show all."
    yield by_size(bank() | families(), ((1, 4),), scale / 20, cell)
    for source in bank().values():
        cell(source.draw((3, 5), 10, int(100 * scale)))
    yield (
        f"In {total['studies']:,} studies `judge` gave other words than the rules of the benchmark "
        f"in {total['others']}; {total['contradictions']} of {total['intervals']:,} intervals of "
        f"differences contradict their word; {total['intransitive']} of {total['chains']:,} chains "
        "of two words better are intransitive."
    )


def growth(scale: float) -> Iterator[str]:
    """Studies that grow, and studies of fixed size."""
    yield (
        f"Studies of fixed size, and (+) studies that grow, with looks at {LOOKS} seeds: per cent "
        "of studies with a false better or worse, and tied (in brackets on agents that show all); "
        "per cent of pairs beyond the margin with the right word; mean seeds."
    )

    def both(runs: Runs) -> str:
        fixed = outcome(runs, our_words(runs.scores))
        if runs.scores.shape[-1] < LOOKS[-1]:
            return fixed
        return f"{fixed} + {outcome(runs, *grown(runs.scores))}"

    some = {name: source for name, source in families().items() if name in GROWING}
    yield by_size(bank() | some, ((1, 2), (1, 4), (7, 4)), scale, both, (10, 20, 80))


# The rows of docs/statistics.md: what is counted, the table, its row, and the place in a cell.
FALSE, FALSE_TIE, RIGHT = "false `better` or `worse`", "false `tied`", "pairs with the right word"
SHOWN = (
    (FALSE, "errors", "different agents: 8 agents, 7 env.", 0),
    (FALSE, "errors", "the same agent: 8 agents, 7 env.", 0),
    (FALSE, "errors", "means within 0.03: 4 agents, 1 env.", 0),
    (FALSE, "errors", "means within 0.03: 8 agents, 7 env.", 0),
    (FALSE, "textbook", "exponential, opposite skews: 2 agents, 1 env.", 0),
    (FALSE, "textbook", "one fails in 5%, the other never: 2 agents, 1 env.", 0),
    (FALSE_TIE, "errors", "different agents: 4 agents, 1 env.", 2),
    (FALSE_TIE, "errors", "different agents: 8 agents, 7 env.", 2),
    (RIGHT, "others", "different agents: 4 agents, 1 env.", 3),
)


def shown(made: Mapping[str, list[str]]) -> str:
    """The table of the page, from the printed tables by name."""
    lines = [["per cent", "studies", *(f"{n} seeds" for n in SIZES[1:])]]
    lines.append(["---"] * len(lines[0]))
    for kind, name, studies, place in SHOWN:
        row = next(r for r in made[name][1].splitlines() if r.startswith(f"| {studies} |"))
        cells = row.removeprefix(f"| {studies} |").strip("| ").split(" | ")
        figures = (re.findall(r"\d+(?:\.\d+)?", cell)[place] for cell in cells[1:])
        told = "" if any(line[0] == kind for line in lines) else kind
        lines.append([told, studies.replace("%", " %"), *figures])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Print the tables."""
    tables = {each.__name__: each for each in (errors, others, textbook, coverage, growth)}
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=", ".join(tables))
    parser.add_argument("--quick", action="store_true", help="a twentieth of the studies")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table of the page")
    args = parser.parse_args()
    names = args.tables or list(tables)
    if args.json and (missing := {name for _, name, *_ in SHOWN} - {*names}):
        parser.error(f"--json needs {', '.join(sorted(missing))} too")
    made: dict[str, list[str]] = {}
    for name in names:
        made[name] = []
        for part in tables[name](0.05 if args.quick else 1.0):
            print(f"{part}\n", flush=True)
            made[name].append(part)
    if args.json:
        publish(args.json, shown(made))


if __name__ == "__main__":
    main()
