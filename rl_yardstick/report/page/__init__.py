"""A study as one self-contained page: `write_report`.

A page is a list of sections. Each is made by a function that takes a `Report` and returns a
`Section`, or None if there is nothing to show. The section's template is
``templates/<name>.html``; its script, if it has one, is ``templates/<name>.js``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from markupsafe import Markup

from rl_yardstick.pipeline.files import write_text
from rl_yardstick.report.page import frame, result_sections, world_sections
from rl_yardstick.report.page.frame import Report, Section

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
    """The page as HTML; the data of a script are in the HTML element with its name."""
    environment = frame.templates()
    study, environments = report.analysis.study, report.analysis.environments
    shared = {"study": study, "environments": environments, "marks": report.series.marks}
    bodies = {
        section.name: Markup(  # noqa: S704  # a template's output, escaped already
            environment.get_template(f"{section.name}.html").render(**shared, **section.context)
        )
        for section in sections
    }
    places = [
        {
            "label": one.environment,
            "optimum": one.optimum,
            "optimum_at_least": one.optimum_at_least,
            "optimum_is_proven": one.optimum_is_proven,
            "baseline": one.baseline,
            "agents": [agent.agent for agent in one.agents],
        }
        for one in environments
    ]
    data = {"page": {"agents": list(report.series.marks.values()), "environments": places}}
    for section in sections:
        data[section.name] = section.data
        data |= {f"{section.name}-{place}": item for place, item in enumerate(section.places)}
    moving = [section for section in sections if section.data is not None or section.places]
    scripts = [*frame.SHARED, *(f"{section.name}.js" for section in moving), "paper.js"]
    return environment.get_template("page.html").render(
        title=study.title,
        study=study,
        environments=environments,
        sections=sections,
        bodies=bodies,
        is_sweep=any(one.sweeps or one.grids for one in report.series.environments),
        data={
            name: frame.packed(frame.as_json(one)) for name, one in data.items() if one is not None
        },
        **frame.page_frame(scripts),
    )
