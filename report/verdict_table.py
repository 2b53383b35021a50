"""A study as Markdown or LaTeX, to stand in a page or a paper: verdicts, failures and cost."""

from __future__ import annotations

import math
from typing import Literal

from experiments.analysis import MARK, AgentAnalysis, EnvironmentAnalysis, StudyAnalysis
from experiments.plan import tuning_seeds
from experiments.results import StudyResults
from experiments.study import COSTS, METRIC_WORDS, StudySpec
from report.conclusions import conclusion, none_has_learnt, on_changes
from report.markdown import MARKDOWN
from report.markup_language import MarkupLanguage
from report.seed_sentence import seed_sentence
from report.wording import enumeration, interval, number, seeds
from verdicts import Verdict

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
