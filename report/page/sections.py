"""What the page and its sections have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

from envs.layout import GridLayout
from experiments.analysis import StudyAnalysis
from experiments.plan import PlannedRun
from pipeline.signs_of_life import Tell, tell_nobody
from report.series.study_series import StudySeries
from verdicts import Estimate


@dataclass(frozen=True)
class LearningPage:
    """The page that plays the first training of an agent.

    Attributes:
        agent: its label.
        environment: that of the environment.
        seed: of the training.
        place: the file, seen from the folder of the study; empty where there is none.
        words: what it shows, or why there is none.
        size: of the file, in bytes.
    """

    agent: str
    environment: str
    seed: int
    place: str
    words: str
    size: int = 0

    @property
    def link(self) -> str:
        """The place as an address."""
        return quote(self.place)


@dataclass(frozen=True)
class Report:
    """What a page is made from.

    Attributes:
        series: the numbers that its figures show.
        command: the command that reproduces the study.
        tell: told how far the slow parts are.
        learning: the pages that play trainings, where they were asked for.
    """

    series: StudySeries
    command: str
    tell: Tell = tell_nobody
    learning: Sequence[LearningPage] = ()

    @property
    def analysis(self) -> StudyAnalysis:
        """The study."""
        return self.series.analysis


@dataclass(frozen=True)
class Section:
    """One part of the page.

    Attributes:
        name: that of its template and script, and its anchor.
        title: its heading.
        context: what its template is filled with.
        data: what its script works with, to be written as JSON; None where there is no such thing.
        places: likewise what it works with on each environment, in their order, read when that is
            chosen; None for one that it has nothing on.
        by_environment: whether it shows the environment that is chosen at the top of the page.
            Its template marks what belongs to environment i by ``data-environment="i"``.
    """

    name: str
    title: str
    context: Mapping[str, Any] = field(default_factory=dict)
    data: Any = None
    places: Sequence[Any] = ()
    by_environment: bool = False


def first_runs(analysis: StudyAnalysis) -> list[list[PlannedRun]]:
    """The first run of each agent that has finished, for each environment.

    A batch leaves no agent.
    """
    first: dict[tuple[str, str], PlannedRun] = {}
    for run in analysis.results.finished:
        is_new = (run.agent, run.environment) not in first
        if is_new and not run.is_batch:
            first[run.agent, run.environment] = run
    return [
        [
            first[agent.agent, environment.environment]
            for agent in environment.agents
            if (agent.agent, environment.environment) in first
        ]
        for environment in analysis.environments
    ]


def estimate_data(estimate: Estimate) -> dict[str, float]:
    """A figure and its interval, for scripts."""
    return {"point": estimate.point, "low": estimate.low, "high": estimate.high}


def layout_data(layout: GridLayout) -> dict[str, Any]:
    """Where states lie on a map, for scripts."""
    return {
        "rows": layout.rows,
        "moves": layout.moves,
        "names": dict(layout.names),
        "layers": [layout.collected_in(layer) for layer in range(layout.n_layers)],
    }
