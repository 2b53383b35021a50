"""A study as files: CSV, Markdown and LaTeX."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from experiments.analysis import MARK, AgentAnalysis, EnvironmentAnalysis, StudyAnalysis
from experiments.plan import tuning_seeds
from experiments.results import StudyResults
from experiments.study import COSTS, METRIC_WORDS, StudySpec
from pipeline.errors import visible
from pipeline.files import replacing, write_text
from report.conclusions import conclusion, none_has_learnt, on_changes
from report.words import enumeration, interval, number, seed_sentence, seeds
from verdicts import Verdict

# What a markup language has to be able to do so that a study can be written in it.


@dataclass(frozen=True)
class MarkupLanguage:
    """How text becomes markup. All take plain text, but for ``table``, whose cells are markup."""

    preamble: Callable[[str], str]  # what stands above all else, of the whole text below it
    title: Callable[[str], str]  # of the whole, and of a part
    heading: Callable[[str], str]
    command: Callable[[str], str]  # a line for a terminal
    text: Callable[[str], str]  # a paragraph in which nothing is markup
    items: Callable[[Sequence[str]], str]  # a list of such texts
    name: Callable[[str], str]  # a label
    figure: Callable[[str], str]  # numbers and units
    bold: Callable[[str], str]  # such a figure, made to stand out
    # By headings, rows, and a caption; none has line breaks.
    table: Callable[[Sequence[str], Sequence[Sequence[str]], str], str]


# Text and tables as Markdown.

PLAIN_NAME = re.compile(r"[\w.=+-]+")
# What would be read as markup: not underscores inside words, nor brackets that are no link.
_MARKUP = re.compile(r"[\\`*<>|~&]|(?<!\w)_|_(?!\w)|\](?=[(\[:])|^[#+-]")


def markdown_table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], caption: str = ""
) -> str:
    """Lines of a table, and the caption below; all Markdown already, with no line breaks."""
    lines = [headings, ["---"] * len(headings), *rows]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"{table}\n\n{caption}" if caption else table


def name_of(label: str) -> str:
    """A label as code where it is a plain name, else as text."""
    return f"`{label}`" if PLAIN_NAME.fullmatch(label) else markdown_text(label)


def markdown_text(text: str) -> str:
    """Text in which nothing is markup."""
    return _MARKUP.sub(lambda found: "\\" + found[0], " ".join(visible(text).split()))


MARKDOWN = MarkupLanguage(
    preamble=lambda _: "",
    title=lambda text: f"# {markdown_text(text)}",
    heading=lambda text: f"## {markdown_text(text)}",
    command=lambda text: f"`{visible(text).replace('`', ' ')}`",
    text=markdown_text,
    items=lambda texts: "\n".join(f"- {markdown_text(text)}" for text in texts),
    name=name_of,
    figure=str,
    bold=lambda text: f"**{text}**",
    table=markdown_table,
)


# Text and tables as LaTeX, to be taken into a paper by ``\input``.

_PREAMBLE = r"% Taken in by \input; above it: \usepackage{booktabs,graphicx}"
_FOREIGN = "% With XeLaTeX or LuaLaTeX, and a font that has these signs: "

_WIDE = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"

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
}
_NOT_IN_OT1 = "ÐÞðþ«»"  # of Latin-1, all of which pdfLaTeX has with other fonts alone

_BEFORE_A_NUMBER = re.compile(r"(?<![\w.)\]}-])-(?=[\d.∞])")
# Two hyphens or commas become one sign. At the start of a row or an item brackets and asterisks
# would be read as a wish of its command.
_LIGATURES = re.compile(r"(?<=-)(?=-)|(?<=,)(?=,)|(?<=')(?=')")
_COMMAND_ARGUMENT = re.compile(r"^[\[*]")


def latex_text(text: str) -> str:
    """Text in which nothing is markup, as any TeX engine sets it that knows its letters."""
    line = _BEFORE_A_NUMBER.sub(_MINUS, " ".join(visible(text).split()))
    line = _LIGATURES.sub("\0", _COMMAND_ARGUMENT.sub(lambda found: f"\0{found[0]}", line))
    return "".join("{}" if sign == "\0" else _SIGNS.get(sign) or _letter(sign) for sign in line)


def _letter(sign: str) -> str:
    """A small Greek letter by its command, and whatever else as it is."""
    greek, _, name = unicodedata.name(sign, "").partition(" SMALL LETTER ")
    return f"${_greek(name)}$" if greek == "GREEK" and _greek(name) else sign


def _greek(name: str) -> str:
    known = "ALPHA BETA GAMMA DELTA EPSILON ZETA ETA THETA KAPPA LAMDA MU NU XI PI RHO SIGMA TAU"
    if name not in [*known.split(), "PHI", "CHI", "PSI", "OMEGA"]:
        return ""
    return "\\" + {"LAMDA": "lambda", "EPSILON": "varepsilon"}.get(name, name.lower())


def latex_table(headings: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> str:
    """A table with the rules of booktabs, made narrower where it is wider than the text."""
    body = [
        r"\toprule",
        f"{' & '.join(headings)} \\\\",
        r"\midrule",
        *(f"{' & '.join(row)} \\\\" for row in rows),
        r"\bottomrule",
    ]
    return "\n".join(
        [
            r"\begin{table}[htbp]",
            r"\centering",
            f"\\caption{{{caption}}}",
            _WIDE,
            f"\\begin{{tabular}}{{l{'r' * (len(headings) - 1)}}}",
            *body,
            r"\end{tabular}}",
            r"\end{table}",
        ]
    )


def _preamble(content: str) -> str:
    foreign = sorted({sign for sign in content if ord(sign) > 0xFF or sign in _NOT_IN_OT1})
    return "\n".join([_PREAMBLE, *([_FOREIGN + " ".join(foreign)] if foreign else [])])


def _items(texts: Sequence[str]) -> str:
    lines = [f"\\item {latex_text(text)}" for text in texts]
    return "\n".join([r"\begin{itemize}", *lines, r"\end{itemize}"])


LATEX = MarkupLanguage(
    preamble=_preamble,
    title=lambda text: f"\\section*{{{latex_text(text)}}}",
    heading=lambda text: f"\\subsection*{{{latex_text(text)}}}",
    command=lambda text: f"{{\\raggedright\\ttfamily {latex_text(text)}\\par}}",
    text=latex_text,
    items=_items,
    name=lambda label: (
        f"\\texttt{{{latex_text(label)}}}" if PLAIN_NAME.fullmatch(label) else latex_text(label)
    ),
    figure=latex_text,
    bold=lambda text: f"\\textbf{{{latex_text(text)}}}",
    table=latex_table,
)


# A study as Markdown or LaTeX, to stand in a page or a paper: verdicts, failures and cost.

# Against the agent whose median run is the highest: shown equivalent or itself, undecided, worse.
Standing = Literal["best", "open", "behind"]

NOTHING = "-"

_SEEN_BY_THE_LEADER: dict[Verdict, Standing] = {
    "equivalent": "best",
    "worse": "best",
    "undecided": "open",
    "better": "behind",
}


def verdicts_as(markup: MarkupLanguage, analysis: StudyAnalysis, command: str) -> str:
    """The whole study: what seeds it has, the headline, and for each environment the verdicts."""
    study = analysis.study
    parts = [
        markup.title(study.title),
        markup.command(command),
        markup.text(seed_sentence(study.seeds, tuning_seeds(study))),
        headline(analysis, markup),
    ]
    for environment in analysis.environments:
        parts += [
            markup.heading(environment.environment),
            ranking(analysis.results, environment, markup),
            markup.items(conclusion(study, environment).everything),
        ]
    content = "\n\n".join(parts) + "\n"
    preamble = markup.preamble(content)
    return f"{preamble}\n\n{content}" if preamble else content


def headline(analysis: StudyAnalysis, markup: MarkupLanguage = MARKDOWN) -> str:
    """A table of agents by environments, and what its marks mean."""
    study, environments = analysis.study, analysis.environments
    found = [_cells(analysis, environment, markup) for environment in environments]
    changed = {a.agent for one in environments for a in one.agents if a.changes}
    rows = [
        [
            _name(markup, agent.label, agent.label in changed),
            *(cells.get(agent.label, NOTHING) for cells in found),
        ]
        for agent in study.agents
    ]
    headings = ["", *(markup.text(one.environment) for one in environments)]
    return markup.table(headings, rows, markup.text(_legend(study, analysis)))


def _name(markup: MarkupLanguage, label: str, changed: bool) -> str:
    return f"{markup.name(label)} {markup.text(MARK)}" if changed else markup.name(label)


def _legend(study: StudySpec, analysis: StudyAnalysis) -> str:
    agents = [agent for environment in analysis.environments for agent in environment.agents]
    if all(_has_score(study, agent) for agent in agents):
        what = "Score of the median run: 1 is the optimum, 0 the best random or constant policy."
        what += _on_brackets(analysis)
    else:
        what = f"{METRIC_WORDS[study.metric].capitalize()}: the median run."
    extreme = "lowest" if study.metric in COSTS else "highest"
    text = (
        f"{what} Bold: the {extreme}, and what is shown to be equivalent to it in the typical run. "
        f"?: not told apart from it by {seeds(study.n_seeds)}. Plain: shown to be worse."
    )
    if processor_seconds(analysis.results):
        text += " In brackets: processor time of the median run."
    return " ".join([text, *on_changes(analysis.environments)])


def _on_brackets(analysis: StudyAnalysis) -> str:
    names = [e.environment for e in analysis.environments if e.optimum_at_least is not None]
    if not names:
        return ""
    return f" On {enumeration(names)} the optimum is bracketed: 1 is the upper end."


def _cells(
    analysis: StudyAnalysis, environment: EnvironmentAnalysis, markup: MarkupLanguage
) -> dict[str, str]:
    """The cell of each agent that has a run."""
    study, places = analysis.study, standings(analysis.study, environment)
    costs = processor_seconds(analysis.results)
    cells = {}
    for agent in environment.agents:
        value = _typical(study, agent)
        is_best = places.get(agent.agent) == "best"
        text = markup.bold(value) if is_best else markup.figure(value)
        text += " ?" if places.get(agent.agent) == "open" else ""
        cost = costs.get((agent.agent, environment.environment))
        text += "" if cost is None else f" ({duration(cost)})"
        cells[agent.agent] = ", ".join([text, *_troubles(environment, agent)])
    return cells


def _typical(study: StudySpec, agent: AgentAnalysis) -> str:
    if _has_score(study, agent):
        assert agent.score is not None
        return f"{agent.score.median.point:.3f}"
    return number(agent.metric.median.point)


def _has_score(study: StudySpec, agent: AgentAnalysis) -> bool:
    return (
        study.metric == "final"
        and agent.score is not None
        and not math.isnan(agent.score.median.point)
    )


def _troubles(environment: EnvironmentAnalysis, agent: AgentAnalysis) -> list[str]:
    """Runs that failed, and runs that are not there."""
    count = environment.failures.get(agent.agent)
    told = [f"{count.n_failed} of {count.n} failed"] if count is not None and count.n_failed else []
    return told + ([f"{agent.n_missing} missing"] if agent.n_missing else [])


def standings(study: StudySpec, environment: EnvironmentAnalysis) -> dict[str, Standing]:
    """How each agent stands against the one whose median run is the best.

    Empty where no agent has learnt anything, or there is no figure.
    """
    sign = -1.0 if study.metric in COSTS else 1.0
    known = [a for a in environment.agents if not math.isnan(a.metric.median.point)]
    if not known or none_has_learnt(study, environment):
        return {}
    leader = max(known, key=lambda agent: sign * agent.metric.median.point).agent
    found: dict[str, Standing] = {leader: "best"}
    for pair in environment.pairs:
        if leader in (pair.first, pair.second):
            seen = pair if pair.first == leader else pair.swapped()
            found[seen.second] = _SEEN_BY_THE_LEADER[seen.verdict]
    return found


def ranking(
    results: StudyResults, environment: EnvironmentAnalysis, markup: MarkupLanguage = MARKDOWN
) -> str:
    """The agents of an environment with their figures, the best first."""
    costs = processor_seconds(results)
    rows = []
    for agent in environment.agents:
        count, stays = environment.failures.get(agent.agent), agent.steps_to_stay
        cost = costs.get((agent.agent, environment.environment))
        figures = [
            interval(agent.metric.median),
            interval(agent.metric.mean),
            NOTHING if agent.score is None else number(agent.score.median.point),
            NOTHING if count is None else f"{count.n_failed} of {count.n}",
            NOTHING if stays is None else number(stays.median.point),
            NOTHING if cost is None else duration(cost),
        ]
        name = _name(markup, agent.agent, bool(agent.changes))
        rows.append([name, *map(markup.figure, figures)])
    headings = ["", "median", "mean", "score", "failed", "stays from", "processor time"]
    # A column in which no agent has a figure is left out.
    kept = [k for k, of in enumerate(zip(*rows, strict=True)) if not set(of) <= {NOTHING}]
    rows, headings = [[row[k] for k in kept] for row in rows], [headings[k] for k in kept]
    metric = METRIC_WORDS[results.study.metric]
    caption = f"{environment.environment}: {metric}, with 95 % intervals over seeds."
    return markup.table(headings, rows, markup.text(caption))


def processor_seconds(results: StudyResults) -> dict[tuple[str, str], float]:
    """By agent and environment, the median over runs; only where all of them were measured."""
    table = results.summary
    found = {}
    for (agent, environment), rows in table.groupby(["agent", "environment"], sort=False):
        times = rows["cpu_seconds"].astype(float)
        if len(times) and times.notna().all():
            found[str(agent), str(environment)] = float(times.median())
    return found


def duration(time: float) -> str:
    """Seconds with two significant digits."""
    if time <= 0:
        return "0 s"
    digits = 1 - math.floor(math.log10(time))
    return f"{round(time, digits):,.{max(digits, 0)}f} s"


# A study as files: comma-separated values, and verdicts for a page or a paper.

# Of the last per cent of its size, the library's own choice is paid with half of the time.
GZIP: Any = {"method": "gzip", "compresslevel": 6}


def write_tables(results: StudyResults) -> list[Path]:
    """Write ``summary.csv``, a row for each run, and ``curves.csv.gz``, all learning curves."""
    summary, curves = results.root / "summary.csv", results.root / "curves.csv.gz"
    with replacing(summary) as file:
        results.summary.to_csv(file, mode="wb", index=False, lineterminator="\n")
    with replacing(curves) as file:
        results.curves.to_csv(
            file,
            mode="wb",
            index=False,
            float_format="%.8g",
            compression=GZIP,
            lineterminator="\n",
        )
    return [summary, curves]


def write_verdicts(analysis: StudyAnalysis, command: str) -> list[Path]:
    """Write ``verdicts.md`` and ``verdicts.tex``: what the study has shown, to be pasted."""
    written = []
    for suffix, markup in ((".md", MARKDOWN), (".tex", LATEX)):
        written.append((analysis.results.root / "verdicts").with_suffix(suffix))
        write_text(written[-1], verdicts_as(markup, analysis, command))
    return written
