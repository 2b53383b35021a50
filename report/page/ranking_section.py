"""The agents of each environment in a table that can be sorted."""

from __future__ import annotations

from typing import Any

from experiments.analysis import EnvironmentAnalysis
from experiments.study_spec import METRIC_WORDS, StudySpec
from report.conclusions import on_changes
from report.page.sections import Report, Section
from report.ranking_columns import COLUMNS, Row, filled
from report.wording import number


def section(report: Report) -> Section | None:
    """A table for each environment."""
    study = report.analysis.study
    context = {
        "tables": [_table(study, environment) for environment in report.analysis.environments],
        "metric": METRIC_WORDS[study.metric],
    }
    return Section("ranking", "Ranking", context, by_environment=True)


def _table(study: StudySpec, environment: EnvironmentAnalysis) -> dict[str, Any]:
    """Headings, and by agent the cells below them."""
    rows = [Row(agent, environment) for agent in environment.agents]
    columns = filled([column for column in COLUMNS if column.page], rows)
    threshold = number(environment.threshold)
    return {
        "headings": [
            {
                "title": column.page,
                "help": column.help.format(threshold=threshold),
                "order": column.order(study),
            }
            for column, _ in columns
        ],
        "rows": [
            (row.agent, [cells[place] for _, cells in columns]) for place, row in enumerate(rows)
        ],
        "changes": on_changes([environment]),
    }
