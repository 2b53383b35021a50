"""All verdicts on an environment at a glance: a row and a column for each agent."""

from __future__ import annotations

from experiments.analysis import EnvironmentAnalysis
from verdicts import Verdict

SIGNS: dict[Verdict, str] = {"better": ">", "worse": "<", "equivalent": "=", "undecided": "?"}
PHRASES: dict[Verdict, str] = {
    "better": "is better than",
    "worse": "is worse than",
    "equivalent": "is equivalent to",
    "undecided": "is undecided against",
}
LEGEND = "> better than the agent of the column, < worse, = equivalent, ? undecided"


def verdict_matrix(environment: EnvironmentAnalysis) -> list[list[Verdict | None]]:
    """By row and column, the verdict on the row's agent against the column's; None on itself."""
    verdicts: dict[tuple[str, str], Verdict] = {}
    for pair in environment.pairs:
        for seen in (pair, pair.swapped()):
            verdicts[seen.first, seen.second] = seen.verdict
    names = [agent.agent for agent in environment.agents]
    return [[verdicts.get((row, column)) for column in names] for row in names]


def says_more(environment: EnvironmentAnalysis) -> bool:
    """Whether there is more to be seen than a sentence says: three agents or more, and verdicts."""
    decided = [pair for pair in environment.pairs if pair.verdict != "undecided"]
    return len(environment.agents) > 2 and bool(decided)
