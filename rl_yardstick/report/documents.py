"""A study as files: CSV, Markdown and LaTeX."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from rl_yardstick.experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from rl_yardstick.experiments.plan import tuning_seeds
from rl_yardstick.experiments.results import StudyResults
from rl_yardstick.pipeline.errors import visible
from rl_yardstick.pipeline.files import replacing, write_json, write_text
from rl_yardstick.report import words
from rl_yardstick.report.words import enumeration, interval, number, score_number, seed_sentence

# A markup is named by the suffix of its files and of its templates.
Markup = Literal["md", "tex"]
MARKUPS: tuple[Markup, ...] = get_args(Markup)

PLAIN_NAME = re.compile(r"[\w.=+-]+")


# What Markdown takes for markup: no underscores inside words, no brackets without a link.
_MARKUP = re.compile(r"[\\`*<>|~&]|(?<!\w)_|_(?!\w)|\](?=[(\[:])|^[#+-]")


def name_of(label: str) -> str:
    """A label in Markdown: code if it is a plain name, else escaped text."""
    return f"`{label}`" if PLAIN_NAME.fullmatch(label) else markdown_text(label)


def markdown_text(text: str) -> str:
    """Escape a text for Markdown, on one line."""
    return _MARKUP.sub(lambda found: "\\" + found[0], " ".join(visible(text).split()))


_PREAMBLE = r"% Taken in by \input; above it: \usepackage{booktabs,graphicx}"
_MINUS = "\N{MINUS SIGN}"
_SIGNS = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"{\char34}",  # active in some languages
    "`": r"{\char96}",
    **{sign: f"\\{sign}" for sign in "{}$&#%_"},
    "±": r"$\pm$",
    "\N{MULTIPLICATION SIGN}": r"$\times$",
    "·": r"$\cdot$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "∞": r"$\infty$",
    _MINUS: "$-$",
    "…": r"\ldots{}",
    "†": r"$\dagger$",
    # The symbols of settings.
    "α": r"$\alpha$",
    "γ": r"$\gamma$",
    "ε": r"$\varepsilon$",
    "λ": r"$\lambda$",
    "κ": r"$\kappa$",
}
_BEFORE_A_NUMBER = re.compile(r"(?<![\w.)\]}-])-(?=[\d.∞])")
# LaTeX joins two hyphens, commas or apostrophes into one character. At the start of a row or an
# item it reads a bracket or an asterisk as an argument of the command before.
_LIGATURES = re.compile(r"(?<=-)(?=-)|(?<=,)(?=,)|(?<=')(?=')")
_COMMAND_ARGUMENT = re.compile(r"^[\[*]")


def latex_text(text: str) -> str:
    """Escape a text for LaTeX, on one line; the engine must know its letters."""
    line = _BEFORE_A_NUMBER.sub(_MINUS, " ".join(visible(text).split()))
    line = _LIGATURES.sub("\0", _COMMAND_ARGUMENT.sub(lambda found: f"\0{found[0]}", line))
    return "".join("{}" if sign == "\0" else _SIGNS.get(sign, sign) for sign in line)


def _latex_name(label: str) -> str:
    text = latex_text(label)
    return f"\\texttt{{{text}}}" if PLAIN_NAME.fullmatch(label) else text


_FILTERS: Mapping[Markup, Mapping[str, Callable[[str], str]]] = {
    "md": {"text": markdown_text, "name": name_of},
    "tex": {"text": latex_text, "name": _latex_name},
}


@cache
def _templates(markup: Markup) -> Environment:
    environment = Environment(  # noqa: S701  # no HTML; what is markup here the filters escape
        loader=PackageLoader("rl_yardstick.report"),
        variable_start_string="<<",
        variable_end_string=">>",
        block_start_string="<%",
        block_end_string="%>",
        trim_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters.update(_FILTERS[markup], table=partial(table_as, markup))
    return environment


NOTHING = "-"


class Cell(NamedTuple):
    """A table cell: a figure and the notes after it, where LaTeX needs markup for ± only."""

    figure: str
    is_bold: bool = False
    notes: str = ""


class Row(NamedTuple):
    """An agent's figures, and whether it was trained on a changed environment."""

    label: str
    is_changed: bool
    cells: list[Cell]


class Table(NamedTuple):
    """The content of a table, in plain text."""

    headings: list[str]
    rows: list[Row]
    caption: str


def verdicts_as(markup: Markup, analysis: StudyAnalysis, command: str) -> str:
    """The whole study: its seeds, the headline table, and each environment's verdicts."""
    study = analysis.study
    template = _templates(markup).get_template(f"verdicts.{markup}")
    content = template.render(
        title=study.title,
        command=visible(command),
        seeds=seed_sentence(study.seeds, tuning_seeds(study)),
        unseen=words.unseen_sentence(analysis),
        headline=headline(analysis),
        environments=[
            (one.environment, ranking(analysis.results, one), words.conclusion(study, one))
            for one in analysis.environments
        ],
    )
    return content if markup == "md" else f"{_PREAMBLE}\n\n{content}"


def table_as(markup: Markup, table: Table) -> str:
    """A table with its caption."""
    return _templates(markup).get_template(f"table.{markup}").render(table=table)


def headline(analysis: StudyAnalysis) -> Table:
    """The table of agents by environments; its caption explains the marks."""
    environments = analysis.environments
    changed = {a.agent for one in environments for a in one.agents if a.changes}
    found = [_cells(analysis, environment) for environment in environments]
    rows = [
        Row(name, name in changed, [cells.get(name, Cell(NOTHING)) for cells in found])
        for name in (agent.label for agent in analysis.study.agents)
    ]
    return Table(["", *(one.environment for one in environments)], rows, _legend(analysis))


def _legend(analysis: StudyAnalysis) -> str:
    study, environments = analysis.study, analysis.environments
    what = f"{study.metric_words.capitalize()}: the mean; scores where they are known."
    if all(one.is_score for one in environments):
        what = "Mean score: 1 is the optimum, 0 the best random or constant policy, and less "
        what += "counts as 0."
        names = [one.environment for one in environments if one.optimum_at_least is not None]
        if names:
            what += f" On {enumeration(names)} the optimum is bracketed: 1 is the upper end."
            what = " ".join([what, *words.unproven_sentences(environments)])
    text = (
        f"{what} ±: the standard deviation of runs. Bold: the best agents, where another is worse."
    )
    if words.processor_seconds(analysis.results):
        text += " In brackets: processor time of the median run."
    return " ".join([text, *words.on_changes(environments)])


def _cells(analysis: StudyAnalysis, environment: EnvironmentAnalysis) -> dict[str, Cell]:
    best = environment.best.agents
    is_for_all = len(best) == len(environment.agents)  # none is worse
    if is_for_all or words.none_has_learnt(analysis.study, environment):
        best = ()
    costs, cells = words.processor_seconds(analysis.results), {}
    for agent in environment.agents:
        figure = number(agent.metric.mean.point)
        if environment.is_score:
            figure = score_number(agent.runs.mean)
        cost = costs.get((agent.agent, environment.environment))
        spread, runs = number(float(f"{agent.spread:.2g}")), agent.runs
        notes = "" if spread == "0" else f" ± {spread}"
        notes += "" if cost is None else f" ({words.duration(cost)})"
        notes += f", {runs.failed} of {runs.n} failed" if runs.failed else ""
        notes += f", {agent.n_missing} missing" if agent.n_missing else ""
        cells[agent.agent] = Cell(figure, agent.agent in best, notes)
    return cells


def ranking(results: StudyResults, environment: EnvironmentAnalysis) -> Table:
    """The agents of an environment with their figures, the best first.

    A column in which no agent has a figure is left out.
    """
    costs, found = words.processor_seconds(results), {}
    for agent in environment.agents:
        runs, stays = agent.runs, agent.steps_to_stay
        cost = costs.get((agent.agent, environment.environment))
        found[agent.agent, bool(agent.changes)] = {
            "mean": interval(agent.metric.mean),
            "median": number(agent.metric.median.point),
            "score": NOTHING if agent.score is None else interval(agent.score, score_number),
            "failed": NOTHING if runs.failed is None else f"{runs.failed} of {runs.n}",
            "stays from": NOTHING if stays is None else number(stays.median.point),
            "processor time": NOTHING if cost is None else words.duration(cost),
        }
    table = pd.DataFrame.from_dict(found, orient="index")
    kept = table.loc[:, (table != NOTHING).any()]
    rows = [Row(*of, list(map(Cell, cells))) for of, cells in zip(found, kept.values, strict=True)]
    metric = results.study.metric_words
    caption = f"{environment.environment}: {metric}, with 95 % intervals over seeds."
    return Table(["", *kept], rows, caption)


PAIR_COLUMNS = (
    *("environment", "first", "second", "verdict", "word", "so_far", "difference", "low", "high"),
    *("p_different", "p_tied", "n", "seeds_needed"),
)


def write_tables(results: StudyResults) -> list[Path]:
    """Write ``summary.csv``, a row for each run, and ``curves.csv.gz``, all learning curves."""
    # The default compression level takes twice the time to save one more per cent of the size.
    rows: Any = {"mode": "wb", "index": False, "lineterminator": "\n"}
    summary, curves = results.root / "summary.csv", results.root / "curves.csv.gz"
    with replacing(summary) as path:
        results.summary.to_csv(path, **rows)
    with (
        replacing(curves) as path,
        path.open("wb") as file,
        gzip.GzipFile("", "wb", 6, file, mtime=0) as packed,
    ):
        results.curves.to_csv(packed, float_format="%.8g", **rows)
    return [summary, curves]


def write_verdicts(analysis: StudyAnalysis, command: str) -> list[Path]:
    """Write the verdicts: as Markdown and LaTeX for texts, as CSV and JSON for programs."""
    said, root = analysis.verdicts, analysis.results.root
    rows = [
        {**asdict(pair), "verdict": pair.text, "low": pair.interval[0], "high": pair.interval[1]}
        for pair in said.pairs
    ]
    written = [root / "verdicts.csv", root / "verdicts.json"]
    with replacing(written[0]) as file:
        table = pd.DataFrame(rows, columns=PAIR_COLUMNS)
        table.to_csv(file, mode="wb", index=False, lineterminator="\n")
    best = {environment: {**asdict(b), "text": str(b)} for environment, b in said.best.items()}
    write_json(written[1], {**asdict(said), "pairs": rows, "best": best})
    for markup in MARKUPS:
        written.append(analysis.results.root / f"verdicts.{markup}")
        write_text(written[-1], verdicts_as(markup, analysis, command))
    return written
