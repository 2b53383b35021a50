"""The page of a study: settings, the order of sections, and how they become one file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from experiments.looks import read_looks
from experiments.plan import PlannedRun, tuning_seeds
from experiments.results import StudyResults
from experiments.run_files import mixed_versions
from pipeline.files import write_text
from pipeline.signs_of_life import Tell, tell_nobody
from report.page import result_sections, world_sections
from report.page import result_sections as result_sections_module
from report.page.frame import (
    SHARED,
    LearningPage,
    Report,
    Section,
    as_json,
    frame,
    packed,
    setting,
    template_file,
    templates,
)
from report.series import StudySeries
from report.words import look_sentences, seed_sentence

# What a reader needs to do the study again: settings as run, seeds, looks, versions, failures.

ABSENT = "-"


@dataclass(frozen=True)
class MissingRuns:
    """Runs of an agent on an environment that are not there, all for one reason."""

    agent: str  # whose
    environment: str
    seeds: list[int]  # which
    reason: str  # the last line of what they left, or that they have not been done
    details: str  # all that the last of them left


@dataclass(frozen=True)
class SettingsTable:
    """The settings of an environment's runs."""

    agents: list[str]  # the columns
    # By name of the setting, its value for each agent, and whether they differ.
    rows: dict[str, tuple[list[str], bool]]


def settings(report: Report) -> Section | None:
    """Settings by environment, and what holds for the whole study."""
    results = report.analysis.results
    done = [(run, run.run.read_info()) for run in results.finished]
    there = {run.path for run, _ in done}
    missing = [run for run in results.planned if run.path not in there]
    context = {
        "command": report.command,
        "seeds": seed_sentence(results.study.seeds, tuning_seeds(results.study)),
        "absent": ABSENT,
        "tables": [
            _settings_table([(r, info) for r, info in done if r.environment == e.environment])
            for e in report.analysis.environments
        ],
        "versions": _recorded("versions", [info for _, info in done]),
        "machine": _recorded("machine", [info for _, info in done]),
        "looks": _looks(report),
        "mixed": mixed_versions(info for _, info in done),
        "missing": _missing_runs(results, missing),
    }
    return Section("settings", "Settings", context, by_environment=True)


def _settings_table(runs: list[tuple[PlannedRun, Mapping[str, Any]]]) -> SettingsTable:
    columns: dict[str, dict[str, str]] = {}
    for agent in dict.fromkeys(run.agent for run, _ in runs):
        columns[agent] = _column([info for run, info in runs if run.agent == agent])
    names = dict.fromkeys(name for column in columns.values() for name in column)
    rows = {}
    for name in names:
        values = [column.get(name, ABSENT) for column in columns.values()]
        rows[name] = (values, len({*values} - {ABSENT}) > 1)
    return SettingsTable(list(columns), rows)


def _column(infos: list[Mapping[str, Any]]) -> dict[str, str]:
    """The settings of an agent, which its seeds share, and how long its runs were."""
    spec = infos[0]["spec"]
    steps = sorted(info["n_timesteps"] for info in infos)
    lengths = f"{steps[0]:,}" if steps[0] == steps[-1] else f"{steps[0]:,} to {steps[-1]:,}"
    column = {"agent": spec["algo"], "steps run": lengths}
    engines = sorted({str(info["engine"]) for info in infos if info.get("engine")})
    if engines:
        column["engine"] = "; ".join(engines)
    return column | {name: setting(value) for name, value in spec["hyperparams"].items()}


def _recorded(what: str, infos: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """What the runs were done with, by its name; several where runs differ, none of old runs."""
    found: dict[str, set[str]] = {}
    for info in infos:
        for name, value in info.get(what, {}).items():
            found.setdefault(name, set()).add(value)
    return {name: ", ".join(sorted(values)) for name, values in found.items()}


def _looks(report: Report) -> list[list[str]]:
    """By environment, what looks there have been."""
    log = read_looks(report.analysis.results.root)
    return [look_sentences(log.on(one.environment)) for one in report.analysis.environments]


def _missing_runs(results: StudyResults, missing: Iterable[PlannedRun]) -> list[MissingRuns]:
    groups: dict[tuple[str, str, str], MissingRuns] = {}
    damaged = {one.planned.path: one.reason for one in results.left_out}
    for run in missing:
        details = results.failures.get(run.path, "").strip()
        reason = damaged.get(run.path) or (details.splitlines()[-1] if details else "not done yet")
        key = (run.agent, run.environment, reason)
        seeds = groups[key].seeds if key in groups else []
        groups[key] = MissingRuns(*key[:2], [*seeds, run.seed], reason, details)
    return list(groups.values())


# The page: which sections it has, in which order, and how they become one file.

# A new kind of section is such a function, named here.
SECTIONS: tuple[Callable[[Report], Section | None], ...] = (
    result_sections.verdict,
    result_sections_module.overview,
    result_sections.ranking,
    result_sections.curves,
    world_sections.bandits,
    result_sections.comparison,
    result_sections.overall,
    world_sections.policies,
    world_sections.played_episodes,
    result_sections.watching,
    settings,
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
