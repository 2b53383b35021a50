"""A study in the terminal, and as files of comma-separated values."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from experiments.analysis import AgentAnalysis, EnvironmentAnalysis, StudyAnalysis
from experiments.pull_statistics import QUANTILES, PullStatistics
from experiments.study_results import StudyResults, read_episodes
from experiments.study_spec import METRIC_WORDS, StudySpec
from pipeline.files import replacing
from report.sentences import environment_sentences, interval, number

MOST_AGENT_WIDTH = 20


def print_analysis(console: Console, analysis: StudyAnalysis) -> None:
    """Print a table for each environment, and what it says in words."""
    for environment in analysis.environments:
        console.print()
        pulls = _pulls_on(analysis.results, environment)
        console.print(
            _bandit_ranking(analysis, environment, pulls)
            if pulls
            else _ranking(analysis, environment)
        )
        for sentence in environment_sentences(analysis.study, environment):
            console.print(f"  {sentence}", highlight=False, markup=False)


def _ranking(analysis: StudyAnalysis, environment: EnvironmentAnalysis) -> Table:
    table = Table(
        title=_title(environment),
        caption=_caption(analysis.study, environment),
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("agent", overflow="fold", min_width=_agent_width(environment))
    has_score = any(agent.score is not None for agent in environment.agents)
    headings = ["mean", "IQM", *(["score"] if has_score else []), "training"]
    headings += ["steps", "solved", "time"]
    for heading in headings:
        table.add_column(heading, justify="right")
    for agent in environment.agents:
        table.add_row(escape(agent.agent), *_cells(agent, has_score))
    return table


def _agent_width(environment: EnvironmentAnalysis) -> int:
    """Room for the agents' names; longer ones go over several lines."""
    return min(max(len(agent.agent) for agent in environment.agents), MOST_AGENT_WIDTH)


def _pulls_on(results: StudyResults, environment: EnvironmentAnalysis) -> dict[str, PullStatistics]:
    """On a bandit, figures by pull of each agent."""
    return {
        agent: statistics
        for (agent, label), statistics in results.pulls.items()
        if label == environment.environment
    }


def _bandit_ranking(
    analysis: StudyAnalysis, environment: EnvironmentAnalysis, pulls: dict[str, PullStatistics]
) -> Table:
    caption = (
        f"regret: sum over the pulls of a run, with 95 % intervals over {analysis.study.n_seeds} "
        "runs; simple regret: of recommending the arm pulled most; reward, best arm: at the last "
        "pulls"
    )
    quantiles = f"{QUANTILES[0]:.0%} to {QUANTILES[-1]:.0%} of runs"
    table = Table(
        title=escape(environment.environment),
        caption=caption,
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("agent", overflow="fold", min_width=_agent_width(environment))
    for heading in ("mean regret", quantiles, "simple regret", "reward", "best arm", "time"):
        table.add_column(heading, justify="right")
    for agent in environment.agents:
        if agent.agent not in pulls:
            continue
        statistics = pulls[agent.agent]
        low, *_, high = np.quantile(statistics.total_regret, QUANTILES)
        table.add_row(
            escape(agent.agent),
            interval(agent.regret),
            f"{number(low)} to {number(high)}",
            number(statistics.simple_regret[-1]),
            number(statistics.reward[-1]),
            f"{statistics.optimal[-1]:.1%}",
            f"{number(agent.seconds.point)} s",
        )
    return table


def _caption(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    text = (
        f"mean, IQM: {METRIC_WORDS[study.metric]}, with 95 % intervals over {study.n_seeds} seeds"
    )
    text += "; training: return of the last 100 training episodes"
    if environment.threshold is not None:
        text += f"; steps: until a return of {number(environment.threshold)}, the median run"
    return text


def _title(environment: EnvironmentAnalysis) -> str:
    title = escape(environment.environment)
    if environment.optimum is not None:
        title += f": optimum {number(environment.optimum)}"
        title += f", best blind policy {number(environment.best_blind)}"
    return title


def _cells(agent: AgentAnalysis, has_score: bool) -> list[str]:
    cells = [interval(agent.metric.mean), interval(agent.metric.iqm)]
    if has_score:
        cells.append("-" if agent.score is None else interval(agent.score.mean))
    cells.append(interval(agent.last_episodes))
    threshold = agent.steps_to_threshold
    if threshold is None or math.isnan(threshold.share_reached.point):
        cells += ["-", "-"]
    else:
        cells += [number(threshold.median.point), f"{threshold.share_reached.point:.0%}"]
    return [*cells, f"{number(agent.seconds.point)} s"]


def write_tables(results: StudyResults) -> list[Path]:
    """Write ``summary.csv``, a row for each run, and ``curves.csv.gz``, all learning curves."""
    summary, curves = results.root / "summary.csv", results.root / "curves.csv.gz"
    with replacing(summary) as draft:
        results.summary.to_csv(draft, index=False)
    with replacing(curves) as draft:
        results.curves.to_csv(draft, index=False, float_format="%.8g", compression="gzip")
    return [summary, curves]


def episodes_table(results: StudyResults, width: int) -> pd.DataFrame:
    """Training returns by blocks of episodes, over all seeds of an agent.

    Args:
        results: the runs.
        width: episodes in a block.

    Returns:
        Columns agent, environment, episode (the last of the block), average, minimum, maximum.
    """
    rows = []
    for planned in results.planned:
        if planned.is_finished:
            returns = read_episodes(planned.run).returns
            block = pd.Series(range(len(returns))) // width
            rows.append(
                pd.DataFrame(
                    {
                        "agent": planned.agent,
                        "environment": planned.environment,
                        "episode": (block + 1) * width,
                        "return": returns,
                    }
                )
            )
    if not rows:
        return pd.DataFrame(columns=["agent", "environment", "episode"])
    grouped = pd.concat(rows).groupby(["environment", "agent", "episode"], sort=False)["return"]
    return grouped.agg(average="mean", minimum="min", maximum="max").reset_index()


def print_episodes_table(console: Console, table: pd.DataFrame, width: int) -> None:
    """Print the table of `episodes_table`, agents side by side."""
    for environment, rows in table.groupby("environment", sort=False):
        title = f"{environment}: return per {width} episodes (average, min, max; all seeds)"
        printed = Table(title=escape(title), title_justify="left")
        printed.add_column("episode", justify="right")
        agents = list(dict.fromkeys(rows["agent"]))
        for agent in agents:
            printed.add_column(escape(str(agent)), justify="right")
        by_episode = rows.set_index(["episode", "agent"])
        for episode in sorted(set(rows["episode"])):
            cells = []
            for agent in agents:
                if (episode, agent) not in by_episode.index:
                    cells.append("-")
                    continue
                row = by_episode.loc[(episode, agent)]
                cells.append("  ".join(number(row[c]) for c in ("average", "minimum", "maximum")))
            printed.add_row(f"{episode:,}", *cells)
        console.print()
        console.print(printed)
