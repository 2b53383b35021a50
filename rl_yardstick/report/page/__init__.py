"""A study as one self-contained page: `write_report`.

A page is a list of sections. Each is made by a function that takes a `Report` and returns a
`Section`, or None if there is nothing to show. The section's template is
``templates/<name>.html``; its script, if it has one, is ``templates/<name>.js``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from markupsafe import Markup

from rl_yardstick.pipeline.files import write_text
from rl_yardstick.report.page import result_sections, world_sections
from rl_yardstick.report.page.frame import (
    SHARED,
    Report,
    Section,
    as_json,
    packed,
    page_frame,
    templates,
)

# To add a section, list its function here.
SECTIONS: tuple[Callable[[Report], Section | None], ...] = (
    result_sections.verdict,
    result_sections.overview,
    result_sections.ranking,
    result_sections.curves,
    world_sections.bandits,
    result_sections.comparison,
    result_sections.overall,
    world_sections.why,
    world_sections.diagnosis,
    world_sections.policies,
    world_sections.played_episodes,
    result_sections.watching,
    result_sections.settings,
)


def write_report(report: Report, path: Path) -> None:
    """Write the page of a study: one self-contained file, which needs no network."""
    sections = [section for make in SECTIONS if (section := make(report)) is not None]
    write_text(path, render(report, sections))


def render(report: Report, sections: list[Section]) -> str:
    """The page as HTML."""
    environment = templates()
    study, environments = report.analysis.study, report.analysis.environments
    shared = {"study": study, "environments": environments, "marks": report.series.marks}
    bodies = {
        section.name: Markup(  # noqa: S704  # a template's output, escaped already
            environment.get_template(f"{section.name}.html").render(**shared, **section.context)
        )
        for section in sections
    }
    moving = [section for section in sections if section.data is not None or section.places]
    scripts = [*SHARED, *(f"{section.name}.js" for section in moving), "paper.js"]
    return environment.get_template("page.html").render(
        title=study.title,
        study=study,
        environments=environments,
        sections=sections,
        bodies=bodies,
        is_sweep=any(one.sweeps or one.grids for one in report.series.environments),
        data={name: packed(as_json(item)) for name, item in _data(report, sections).items()},
        **page_frame(scripts),
    )


def _data(report: Report, sections: list[Section]) -> dict[str, Any]:
    """The data of the scripts, by the name of the HTML element that holds it."""
    page = {
        "agents": list(report.series.marks.values()),
        "environments": [
            {
                "label": environment.environment,
                "optimum": environment.optimum,
                "optimum_at_least": environment.optimum_at_least,
                "optimum_is_proven": environment.optimum_is_proven,
                "baseline": environment.baseline,
                "agents": [agent.agent for agent in environment.agents],
            }
            for environment in report.analysis.environments
        ],
    }
    data = {"page": page, **{section.name: section.data for section in sections}}
    for section in sections:
        data |= {f"{section.name}-{place}": item for place, item in enumerate(section.places)}
    return {name: item for name, item in data.items() if item is not None}
