"""What studies save, and how often they are wrong, that grow until every pair is decided.

    nice python benchmarks/growing_studies.py [--studies 400] [--scores summary.csv]

The studies grow by the very function that ``compare.py --until-decided`` uses. Wrong claims: the
same agent several times, and agents that lie the margin apart; the promise is 5 % of studies.
Savings: runs, and pairs that are decided, beside a fixed number of seeds. ``--scores`` draws the
scores of each agent from those of a real study's runs, by environment, with replacement.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.random import Generator
from scipy import stats

from verdict_errors import ALPHA, DISTRIBUTIONS, MARGIN, Draw, Scores
from verdicts import Growth, grow, judge_pairs, level_of_look, look_sizes

LEVEL = level_of_look(ALPHA, 1)
FIRST, MOST = 10, 50
FIXED = (10, 30, 50)
Study = dict[str, Scores]


def grown(scores: Mapping[str, Scores], margin: float, first: int = FIRST) -> Growth:
    """A study that has grown; seeds that nobody asked for are not looked at."""
    most = len(next(iter(scores.values())))
    return grow(scores, look_sizes(first, most, len(scores), LEVEL), margin, LEVEL)


def drawn(draw: Draw, rng: Generator, n_agents: int, n: int = MOST) -> Study:
    """Several times the same agent."""
    return {str(k): row for k, row in enumerate(draw(rng, (n_agents, n)))}


def wrong_same(draw: Draw, rng: Generator, n_agents: int) -> bool:
    """Whether an agent is called better or worse than itself, at any look."""
    judged = grown(drawn(draw, rng, n_agents), 0.0).judged.values()
    return any(each.verdict in {"better", "worse"} for each in judged)


def wrong_equivalent(draw: Draw, rng: Generator, n_agents: int) -> bool:
    """Whether any two agents are called equivalent that lie the margin apart, each from the next.

    Beside them stand agents that are further apart, which are decided early.
    """
    margin = MARGIN * float(stats.iqr(draw(np.random.default_rng(0), (10_001,))) or 0.1)
    scores = {
        name: row + int(name) * margin * (1 + 1e-9)
        for name, row in drawn(draw, rng, n_agents).items()
    }
    judged = grown(scores, margin).judged.values()
    return any(each.verdict == "equivalent" for each in judged)


def print_errors(studies: int) -> None:
    """Wrong claims of studies that grow."""
    rng = np.random.default_rng(5)
    print(f"Wrong claims while growing from {FIRST} to {MOST} seeds, % of {studies:,} studies\n")
    print(
        "| claim | scores | 2 agents | 3 agents | 5 agents | 10 agents |\n|---|---|---|---|---|---|"
    )
    claims: dict[str, Callable[[Draw, Generator, int], bool]] = {
        "better or worse: the same agent": wrong_same,
        "equivalent: the margin apart": wrong_equivalent,
    }
    for claim, wrong in claims.items():
        for kind, draw in DISTRIBUTIONS.items():
            cells = [
                # Of ten agents there are 45 pairs to judge.
                np.mean([wrong(draw, rng, n) for _ in range(studies if n < 10 else studies // 4)])
                for n in (2, 3, 5, 10)
            ]
            print(
                f"| {claim} | {kind} | {' | '.join(f'{100 * c:.1f}' for c in cells)} |", flush=True
            )


def like_the_headline(rng: Generator, n: int = MOST) -> Study:
    """Scores as in the README's table: a table that always finds the optimum, and networks."""
    networks = 0.97 + 0.03 * rng.beta(4, 1, size=(3, n))
    failed = rng.random((3, n))
    networks[1] = np.where(failed[1] < 0.05, 0.53, networks[1])
    networks[2] = np.where(failed[2] < 0.1, -0.55, networks[2] - 0.1)
    return {
        "qlearning": np.ones(n),
        "sarsa": 0.984 + 0.002 * rng.normal(size=n),
        "dqn": networks[0],
        "double_dqn": networks[1],
        "ppo": networks[2],
    }


def shifted(kind: str, shifts: tuple[float, ...]) -> Callable[[Generator], Study]:
    """Agents of one kind of scores, each so much above the first."""

    def draw(rng: Generator) -> Study:
        return {
            str(k): row + shift
            for k, (row, shift) in enumerate(
                zip(DISTRIBUTIONS[kind](rng, (len(shifts), MOST)), shifts, strict=True)
            )
        }

    return draw


def resampled(table: pd.DataFrame) -> Callable[[Generator], Study]:
    """Scores of the runs in a table of one environment, drawn with replacement."""
    scores = {str(agent): rows["score"].to_numpy() for agent, rows in table.groupby("agent")}
    return lambda rng: {name: rng.choice(there, MOST) for name, there in scores.items()}


def print_savings(worlds: Mapping[str, tuple[Callable[[Generator], Study], float]], n: int) -> None:
    """Runs, and the share of pairs that are decided, of fixed studies and of those that grow."""
    rng = np.random.default_rng(6)
    columns = [*(f"fixed {seeds}" for seeds in FIXED), *(f"grown to {most}" for most in FIXED[1:])]
    print(f"\nMean number of runs and % of pairs decided, {n:,} studies\n")
    print(f"| scores | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    for name, (draw, margin) in worlds.items():
        found: dict[str, list[tuple[float, float]]] = {column: [] for column in columns}
        for _ in range(n):
            scores = draw(rng)
            for seeds in FIXED:
                first = {agent: row[:seeds] for agent, row in scores.items()}
                judged = judge_pairs(first, margin, LEVEL).values()
                share = np.mean([each.verdict != "undecided" for each in judged])
                found[f"fixed {seeds}"].append((seeds * len(scores), float(share)))
            for most in FIXED[1:]:
                growth = grown({agent: row[:most] for agent, row in scores.items()}, margin)
                share = np.mean([e.verdict != "undecided" for e in growth.judged.values()])
                found[f"grown to {most}"].append((sum(growth.seeds.values()), float(share)))
        means = [np.mean(found[column], axis=0) for column in columns]
        cells = [f"{runs:.0f}, {100 * share:.0f}" for runs, share in means]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def worlds_of(path: Path | None) -> dict[str, tuple[Callable[[Generator], Study], float]]:
    """What studies are simulated of: a real one's environments, or made-up scores."""
    if path is not None:
        table = pd.read_csv(path)
        return {
            str(name): (resampled(rows.dropna(subset=["score"])), 0.02)
            for name, rows in table.groupby("environment", sort=False)
        }
    return {
        "as the headline, margin 0.02": (like_the_headline, 0.02),
        "two agents, normal, 1 apart": (shifted("normal", (0.0, 1.0)), 0.0),
        "two agents, normal, the same, margin 1": (shifted("normal", (0.0, 0.0)), 1.0),
        "five agents, normal, 0 to 4, margin 1": (shifted("normal", (0, 0, 1, 2, 4)), 1.0),
        "five agents, exponential, 0 to 4, margin 1": (
            shifted("exponential", (0, 0, 1, 2, 4)),
            1.0,
        ),
        "five agents that fail in 5 %, 0 to 0.05, margin 0.02": (
            shifted("fails in 5 %", (0, 0, 0, 0.02, 0.05)),
            0.02,
        ),
    }


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--studies", type=int, default=400, help="simulated for each figure")
    parser.add_argument("--scores", type=Path, help="a summary.csv, whose runs are resampled")
    args = parser.parse_args()
    if args.scores is None:
        print_errors(args.studies)
    print_savings(worlds_of(args.scores), args.studies)


if __name__ == "__main__":
    main()
