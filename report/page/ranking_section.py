"""The agents of each environment in a table that can be sorted."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from experiments.analysis import AgentAnalysis, EnvironmentAnalysis
from experiments.study_spec import COSTS, METRIC_WORDS
from report.page.markup import bar, interval_alone
from report.page.sections import Report, Section
from report.sentences import number
from verdicts import Estimate, ThresholdSummary


@dataclass(frozen=True)
class Cell:
    """One cell.

    Attributes:
        text: what it says.
        value: what it is sorted by; None puts it last.
        note: what stands below in small print.
        bar: low end, point and high end, each between 0 and 1, of a bar to draw; or None.
    """

    text: str
    value: float | None
    note: str = ""
    bar: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        title: its heading.
        help: what it means, in a few words.
        cell: what it says on an agent.
    """

    title: str
    help: str
    cell: Callable[[AgentAnalysis], Cell]


def section(report: Report) -> Section | None:
    """A table for each environment."""
    study = report.analysis.study
    tables = [
        (columns, [(agent, [c.cell(agent) for c in columns]) for agent in environment.agents])
        for environment in report.analysis.environments
        if (columns := _columns(environment))
    ]
    context = {
        "tables": tables,
        "metric": METRIC_WORDS[study.metric],
        "order": "ascending" if study.metric in COSTS else "descending",
    }
    return Section("ranking", "Ranking", context, by_environment=True)


def _columns(environment: EnvironmentAnalysis) -> list[Column]:
    """The columns that some agent has something to say in."""
    agents = environment.agents
    columns = [
        Column("Mean", "over seeds", lambda agent: _figure(agent.metric.mean)),
        Column("IQM", "middle half", lambda agent: _figure(agent.metric.iqm)),
        Column("Median", "over seeds", lambda agent: _figure(agent.metric.median)),
    ]
    if any(agent.score is not None for agent in agents):
        columns.append(Column("Score", "1 is optimal", _score))
    optimum = environment.optimum
    if optimum is not None:
        columns.append(
            Column("Gap", "to the optimum", lambda agent: _figure(_gap(optimum, agent.final)))
        )
    if any(agent.success_rate is not None for agent in agents):
        columns.append(Column("Success", "in the end", _success))
    if environment.threshold is not None:
        title = f"to {number(environment.threshold)}"
        columns += [
            Column("Steps", title, lambda agent: _threshold(agent.steps_to_threshold)),
            Column("Episodes", title, lambda agent: _threshold(agent.episodes_to_threshold)),
        ]
    return [
        *columns,
        Column("Training", "seconds", lambda agent: _figure(agent.seconds)),
        Column("Runs", "finished", _runs),
    ]


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _figure(estimate: Estimate) -> Cell:
    return Cell(number(estimate.point), _known(estimate.point), interval_alone(estimate))


def _gap(optimum: float, final: Estimate) -> Estimate:
    return replace(
        final, point=optimum - final.point, low=optimum - final.high, high=optimum - final.low
    )


def _score(agent: AgentAnalysis) -> Cell:
    if agent.score is None:
        return Cell("-", None)
    mean = agent.score.mean
    return replace(_figure(mean), bar=None if math.isnan(mean.point) else bar(mean))


def _success(agent: AgentAnalysis) -> Cell:
    rate = agent.success_rate
    if rate is None or math.isnan(rate.point):
        return Cell("-", None)
    note = f"{rate.low:.0%} to {rate.high:.0%}" if interval_alone(rate) else ""
    return Cell(f"{rate.point:.1%}", rate.point, note)


def _threshold(summary: ThresholdSummary | None) -> Cell:
    if summary is None:
        return Cell("-", None)
    reached = f"{summary.share_reached.point:.0%} of runs"
    return Cell(number(summary.median.point), _known(summary.median.point), reached)


def _runs(agent: AgentAnalysis) -> Cell:
    missing = f"{agent.n_missing} missing" if agent.n_missing else ""
    return Cell(f"{agent.n_runs}", agent.n_runs, missing)
