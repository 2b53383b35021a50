"""Links to the pages that play how the agents learnt."""

from __future__ import annotations

from report.page.sections import Report, Section


def section(report: Report) -> Section | None:
    """The links, by environment; None where no pages were asked for."""
    if not report.learning:
        return None
    groups = [
        [page for page in report.learning if page.environment == environment.environment]
        for environment in report.analysis.environments
    ]
    return Section("watching", "See it learn", {"groups": groups}, by_environment=True)
