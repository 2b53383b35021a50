"""Figures of a study on bandits, in the forms that the textbooks have."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import PercentFormatter

from experiments.pull_statistics import QUANTILES, PullStatistics
from experiments.study_results import StudyResults
from experiments.study_spec import file_name
from pipeline.environments import make_single_env
from report.figures.figure_style import COLOURS, agent_style, figure
from report.figures.posteriors import density, grid, is_normal, truth
from report.figures.regret_bounds import auer_bound, best_expected_reward, lai_robbins_slope

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# More agents than this make no readable lines; a study of parameters shows them by parameter.
MOST_LINES = 14

Pulls = dict[str, PullStatistics]


def write_bandit_figures(results: StudyResults, folder: Path) -> list[Path]:
    """Draw what the study has pulls for, into ``folder``; the files."""
    paths: list[Path] = []
    for environment in results.study.environments:
        pulls = {
            agent.label: results.pulls[agent.label, environment.label]
            for agent in results.study.agents
            if (agent.label, environment.label) in results.pulls
        }
        if not pulls:
            continue
        name = file_name(environment.label)
        if len(pulls) <= MOST_LINES:
            paths += _testbed(results, environment.label, pulls, folder / f"{name}_pulls")
            paths += _regret(results, environment.label, pulls, folder / f"{name}_regret")
        known = {agent: p for agent, p in pulls.items() if p.true_means.size}
        if known and len(known) <= MOST_LINES:
            paths += _arms(results, known, folder / f"{name}_arms")
        for agent, statistics in known.items():
            if len(statistics.moments):
                path = folder / f"{name}_{file_name(agent)}_posteriors"
                paths += _posteriors(results, agent, statistics, path)
    return paths


def _environment(results: StudyResults, environment: str) -> Any:
    """The bandit itself, for what is known of it."""
    run = next(p for p in results.planned if p.environment == environment)
    return make_single_env(run.spec)


def _testbed(results: StudyResults, environment: str, pulls: Pulls, path: Path) -> list[Path]:
    """Average reward and share of optimal arms by pull: figure 2.2 of Sutton and Barto."""
    written: list[Path] = []
    env = _environment(results, environment)
    best = best_expected_reward(env)
    env.close()
    with figure(path, written, n_columns=2) as (left, right):
        for agent, statistics in pulls.items():
            style = agent_style(results.study, agent)
            left.plot(statistics.pulls, statistics.reward, linewidth=1, label=agent, **style)
            right.plot(statistics.pulls, statistics.optimal, linewidth=1, **style)
        if best is not None:
            left.axhline(best, color="0.35", linewidth=1, label="best possible")
        left.set(xlabel="pulls", ylabel="average reward")
        right.set(xlabel="pulls", ylabel="runs that pull a best arm", ylim=(0, 1))
        right.yaxis.set_major_formatter(PercentFormatter(1))
        n_runs = len(next(iter(pulls.values())).total_reward)
        left.set_title(f"{environment}, {n_runs:,} runs", loc="left")
        _shared_legend(left)
    return written


def _regret(results: StudyResults, environment: str, pulls: Pulls, path: Path) -> list[Path]:
    """Cumulative regret on a logarithmic axis of pulls, with what theory says of it."""
    written: list[Path] = []
    has_simple = any(np.isfinite(p.simple_regret).any() for p in pulls.values())
    with figure(path, written, n_columns=1 + has_simple) as (left, *others):
        for agent, statistics in pulls.items():
            style = agent_style(results.study, agent)
            x, mean = statistics.pulls, statistics.cumulative_regret
            reach = 1.96 * statistics.cumulative_regret_sem
            low, *_, high = statistics.cumulative_regret_quantiles
            left.plot(x, mean, linewidth=1.5, label=agent, **style)
            left.fill_between(
                x, mean - reach, mean + reach, color=style["color"], alpha=0.3, linewidth=0
            )
            left.fill_between(x, low, high, color=style["color"], alpha=0.08, linewidth=0)
            for right in others:
                right.plot(x, statistics.simple_regret, linewidth=1.5, **style)
        _draw_bounds(left, results, environment, next(iter(pulls.values())))
        left.set(xscale="log", xlabel="pulls", ylabel="cumulative regret")
        width = f"{QUANTILES[-1] - QUANTILES[0]:.0%}"
        left.set_title(f"{environment}: mean, 95 % interval, {width} of runs", loc="left")
        for right in others:
            right.set(xscale="log", xlabel="pulls", ylabel="simple regret")
            right.set_title("of recommending the arm pulled most", loc="left")
        _shared_legend(left)
    return written


def _draw_bounds(
    axes: Axes, results: StudyResults, environment: str, statistics: PullStatistics
) -> None:
    """Bounds for a single row of Bernoulli arms that stay as they are."""
    env = _environment(results, environment)
    is_bernoulli = env.unwrapped.kind == "clicks" and statistics.true_means.shape[0] == 1
    env.close()
    if not is_bernoulli:
        return
    means, x = statistics.true_means[0], statistics.pulls
    ceiling = axes.get_ylim()[1]
    bound = auer_bound(means, x)
    shown = bound <= 1.5 * ceiling
    axes.plot(
        x[shown], bound[shown], color="0.35", linestyle="--", linewidth=1, label="Auer, for UCB1"
    )
    slope = lai_robbins_slope(means)
    axes.plot(
        x, slope * np.log(x), color="0.35", linestyle=":", linewidth=1, label="Lai-Robbins slope"
    )
    # An agent that never learns would leave no height for the others.
    axes.set_ylim(0, min(ceiling, 1.1 * bound[-1]))


def _arms(results: StudyResults, pulls: Pulls, path: Path) -> list[Path]:
    """By context, how often each arm was pulled, and what its mean was taken for."""
    first = next(iter(pulls.values()))
    n_contexts, n_arms = first.true_means.shape
    written: list[Path] = []
    width = 0.8 / len(pulls)
    with figure(path, written, n_columns=2, height=4.2 * max(n_contexts / 2, 1)) as (left, right):
        places = np.arange(n_contexts * n_arms)
        for index, (agent, statistics) in enumerate(pulls.items()):
            colour = agent_style(results.study, agent)["color"]
            offset = places + (index - (len(pulls) - 1) / 2) * width
            left.bar(offset, statistics.shares.ravel(), width, color=colour, label=agent)
            if statistics.estimates.size:
                right.errorbar(
                    offset,
                    np.broadcast_to(statistics.estimates, first.true_means.shape).ravel(),
                    np.broadcast_to(statistics.estimates_std, first.true_means.shape).ravel(),
                    fmt="o",
                    markersize=3,
                    linewidth=1,
                    color=colour,
                )
        right.plot(places, first.true_means.ravel(), "_", color="black", markersize=30, zorder=3)
        names = [
            f"arm {arm}" if n_contexts == 1 else f"context {context}\narm {arm}"
            for context in range(n_contexts)
            for arm in range(n_arms)
        ]
        for axes in (left, right):
            axes.set_xticks(places, names)
        left.set(ylabel="share of the pulls", ylim=(0, 1))
        left.yaxis.set_major_formatter(PercentFormatter(1))
        left.set_title("pulls, by context", loc="left")
        right.set(ylabel="mean reward")
        right.set_title(
            "final estimates, mean and spread over runs; bars are the truth", loc="left"
        )
        _shared_legend(left)
    return written


def _posteriors(results: StudyResults, agent: str, known: PullStatistics, path: Path) -> list[Path]:
    """What Thompson sampling believed of each arm in its first run, at a few moments."""
    written: list[Path] = []
    normal = is_normal(results, agent)
    x = grid(known.true_means, is_normal=normal)
    n_contexts = known.posteriors.shape[1]
    with figure(
        path, written, n_columns=len(known.moments), n_rows=n_contexts, height=3.2 * n_contexts
    ) as panels:
        for panel, axes in enumerate(panels):
            context, moment = divmod(panel, len(known.moments))
            for arm, parameters in enumerate(known.posteriors[moment, context]):
                colour = COLOURS[arm % len(COLOURS)]
                y = density(parameters, x, is_normal=normal)
                axes.plot(x, y, linewidth=1.5, label=f"arm {arm}", color=colour)
                mean = truth(known, context, arm)
                if mean is not None:
                    axes.axvline(mean, color=colour, linestyle=":", linewidth=1)
            axes.set(xlabel="mean reward", ylabel="density")
            place = f", context {context}" if n_contexts > 1 else ""
            axes.set_title(f"{agent}{place}, after {known.moments[moment]:,} pulls", loc="left")
        panels[0].legend(frameon=False)
    return written


def _shared_legend(axes: Axes) -> None:
    handles, names = axes.get_legend_handles_labels()
    axes.figure.legend(
        handles, names, loc="outside lower center", ncols=min(len(names), 4), frameon=False
    )
