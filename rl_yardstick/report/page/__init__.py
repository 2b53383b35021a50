"""A study as one self-contained page: `write_report`.

A page is a list of sections. Each is made by a function that takes a `Report` and returns a
`Section`, or None if there is nothing to show. The section's template is
``templates/<name>.html``; its script, if it has one, is ``templates/<name>.js``.
"""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

from markupsafe import Markup

from rl_yardstick.experiments import plan
from rl_yardstick.experiments.results import StudyResults
from rl_yardstick.pipeline.files import read_text, write_text
from rl_yardstick.pipeline.run import RECORD, versions
from rl_yardstick.report.page import frame, result_sections, world_sections
from rl_yardstick.report.page.frame import Report, Section

# To add a section, list its function here.
SECTIONS: tuple[Callable[[Report], Section | None], ...] = (
    result_sections.verdict,
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


def current_files(results: StudyResults, command: str) -> list[Path]:
    """A study's figures and page, if this version made them from the same runs; else none."""
    root, mark = results.root, _mark(results, command).encode()
    page, drawn = root / "report.html", [*root.glob("figures/*"), *root.glob("learning/*/*.html")]
    is_current = drawn and page.exists() and page.read_bytes().endswith(mark)
    return sorted([*drawn, page], key=lambda one: one.stat().st_mtime_ns) if is_current else []


def write_report(report: Report, path: Path) -> None:
    """Write the page of a study: one self-contained file, which needs no network."""
    sections = [section for make in SECTIONS if (section := make(report)) is not None]
    mark = _mark(report.analysis.results, report.command)
    write_text(path, render(report, sections) + mark)


def _mark(results: StudyResults, command: str) -> str:
    """The last line of a page: a digest of what it was made from."""
    records = [results.root / plan.RECORD, *(run.path / RECORD for run in results.finished)]
    texts = [read_text(path) for path in records if path.exists()]
    told = command, versions(), results.left_out, results.failures, *texts
    return f"\n<!-- {sha256(repr(told).encode()).hexdigest()} -->\n"


def render(report: Report, sections: list[Section]) -> str:
    """The page as HTML; the data of a script are in the HTML element with its name."""
    environment = frame.templates()
    study, environments = report.analysis.study, report.analysis.environments
    shared = {"study": study, "environments": environments, "marks": report.series.marks}
    bodies = {}
    for section in sections:
        template = environment.get_template(f"{section.name}.html")
        is_there = [item is not None for item in section.places]
        body = template.render(**shared, is_there=is_there, **section.context)
        bodies[section.name] = Markup(body)  # noqa: S704  # escaped already
    facts = ("optimum", "optimum_at_least", "optimum_is_proven", "baseline")
    places = [
        {
            "label": one.environment,
            "agents": [agent.agent for agent in one.agents],
            **{name: getattr(one, name) for name in facts},
        }
        for one in environments
    ]
    data = {"page": {"agents": list(report.series.marks.values()), "environments": places}}
    for section in sections:
        found = {section.name: section.data}
        found |= {f"{section.name}-{place}": item for place, item in enumerate(section.places)}
        data |= {name: item for name, item in found.items() if item is not None}
    moving = [section for section in sections if section.data is not None or section.places]
    scripts = [*frame.SHARED, *(f"{section.name}.js" for section in moving), "paper.js"]
    return environment.get_template("page.html").render(
        title=study.title,
        study=study,
        environments=environments,
        sections=sections,
        bodies=bodies,
        is_sweep=any(one.sweeps or one.grids for one in report.series.environments),
        data={name: frame.packed(frame.as_json(one)) for name, one in data.items()},
        **frame.page_frame(scripts),
    )
