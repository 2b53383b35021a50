"""The page: which sections it has, in which order, and how they become one file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from markupsafe import Markup

from pipeline.files import write_text
from pipeline.signs_of_life import Tell, tell_nobody
from report.page import (
    bandit_section,
    film_section,
    overview_section,
    policy_section,
    result_sections,
    settings_section,
)
from report.page.markup import SHARED, as_json, frame, packed, template_file, templates
from report.page.sections import LearningPage, Report, Section
from report.series.study_series import StudySeries

# A new kind of section is such a function, named here.
SECTIONS: tuple[Callable[[Report], Section | None], ...] = (
    result_sections.verdict,
    overview_section.section,
    result_sections.ranking,
    result_sections.curves,
    bandit_section.section,
    result_sections.comparison,
    result_sections.overall,
    policy_section.section,
    film_section.section,
    result_sections.watching,
    settings_section.section,
)


def write_report(
    series: StudySeries,
    path: Path,
    command: str,
    tell: Tell = tell_nobody,
    learning: Sequence[LearningPage] = (),
) -> None:
    """Write the page of a study, one file that needs nothing else and no network.

    Args:
        series: the numbers that its figures show.
        path: the file, which is replaced.
        command: the command that reproduces the study.
        tell: told how far the writing is.
        learning: the pages that play trainings, where they were asked for.
    """
    report = Report(series, command, tell, learning)
    sections = []
    for place, make in enumerate(SECTIONS, start=1):
        tell(f"section {place} of {len(SECTIONS)}")
        section = make(report)
        if section is not None:
            sections.append(section)
    tell("all sections as one file")
    write_text(path, render(report, sections))


def render(report: Report, sections: list[Section]) -> str:
    """The page as HTML."""
    environment = templates()
    study = report.analysis.study
    marks = report.series.marks
    bodies = {
        section.name: Markup(  # noqa: S704  # a template's output, escaped already
            environment.get_template(f"{section.name}.html").render(
                {
                    **section.context,
                    "study": study,
                    "environments": report.analysis.environments,
                    "marks": marks,
                }
            )
        )
        for section in sections
    }
    return environment.get_template("page.html").render(
        title=study.title,
        study=study,
        environments=report.analysis.environments,
        sections=sections,
        bodies=bodies,
        is_sweep=any(one.sweeps or one.grids for one in report.series.environments),
        data=_data(report, sections),
        **frame(_own_script(sections)),
    )


def _own_script(sections: list[Section]) -> str:
    """The scripts of the page and of its sections, as one."""
    names = [*SHARED, *(f"{section.name}.js" for section in sections), "paper.js"]
    return "\n".join(text for name in names if (text := template_file(name)) is not None)


def _data(report: Report, sections: list[Section]) -> dict[str, str]:
    """What the scripts work with, by the name of its element: packed JSON."""
    page = {
        "agents": [vars(mark) for mark in report.series.marks.values()],
        "environments": [
            {
                "label": environment.environment,
                "optimum": environment.optimum,
                "optimum_at_least": environment.optimum_at_least,
                "baseline": environment.baseline,
                "agents": [agent.agent for agent in environment.agents],
            }
            for environment in report.analysis.environments
        ],
    }
    data = {"page": page, **{section.name: section.data for section in sections}}
    for section in sections:
        data |= {f"{section.name}-{place}": item for place, item in enumerate(section.places)}
    return {name: packed(as_json(item)) for name, item in data.items() if item is not None}
