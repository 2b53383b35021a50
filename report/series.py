"""The numbers that figures show, computed once for those on paper and those on the page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import integrate, special, stats

from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.bandits import QUANTILES, PullStatistics
from experiments.results import (
    StudyResults,
    curves_by_agent,
    mean_curve,
    read_episodes,
    stored_curves,
    values_over_seeds,
)
from experiments.study import AgentSpec, StudySpec, symbol
from mdp.transition_model import Floats, Ints
from pipeline.environments import make_single_env
from pipeline.signs_of_life import Tell, tell_nobody
from verdicts import Estimate

# One colour and one line style for each agent, the same in every figure of a study.

# Okabe and Ito's colours, told apart by colour-blind readers too. The page's style sheet has them
# as well, with others for a dark theme.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")

Dash = Literal["solid", "dash", "dashdot", "dot"]
# Seven colours and four line styles go round together: neighbours differ in both, so that lines are
# told apart in grey too, and 28 agents have marks of their own.
DASHES: tuple[Dash, ...] = ("solid", "dash", "dashdot", "dot")


@dataclass(frozen=True)
class Mark:
    """How an agent is drawn."""

    label: str  # the agent's
    colour: int  # the place of its colour in `COLOURS`
    dash: Dash  # its line style, as Plotly calls it
    # How often the colours have been gone through before: the page gives the dot beside a name
    # another shape each time.
    shape: int = 0


def agent_marks(study: StudySpec) -> dict[str, Mark]:
    """The marks of the agents by label, in the order of the study."""
    marks = {}
    for place, label in enumerate(agent.label for agent in study.agents):
        dash = DASHES[place % len(DASHES)]
        again, colour = divmod(place, len(COLOURS))
        marks[label] = Mark(label, colour, dash, again % len(DASHES))
    return marks


# Learning curves of all agents, by step, episode and wall time.

KINDS = ("evaluation", "training")
AXES = ("step", "episode", "seconds")

# Returns that are so many times larger than what matters flatten a linear axis.
DWARFED = 10


@dataclass(frozen=True)
class Curve:
    """A line and its interval, each of shape (n_points,); NaN where there is no interval."""

    x: Floats
    y: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class LearningCurves:
    """The mean curves on an environment."""

    # By axis, and then by agent, the best first; an agent without a curve is left out.
    by_axis: Mapping[str, Mapping[str, Curve]]
    # Where a symmetric logarithmic axis of returns ceases to be linear; None for a linear axis.
    linear_up_to: float | None
    # Agents whose returns are of a variant of the environment, so that they are not to be held
    # against the optimum.
    on_variant: tuple[str, ...] = ()


def learning_curves(
    results: StudyResults, environment: EnvironmentAnalysis
) -> dict[str, LearningCurves]:
    """The curves on an environment, by kind."""
    found = {}
    variants = tuple(agent.agent for agent in environment.agents if agent.on_variant)
    runs = curves_by_agent(results, environment.environment)
    for kind in KINDS:
        by_axis: dict[str, dict[str, Curve]] = {by: {} for by in AXES}
        for agent in (each.agent for each in environment.agents):
            of_agent: list[Any] = runs.get((agent, kind), [])
            if stored := stored_curves(results, environment.environment, agent, kind):
                of_agent = [*of_agent, *stored]
            for by in AXES:
                if (curve := _curve(of_agent, by)) is not None:
                    by_axis[by][agent] = curve
        scale = linear_up_to([curve.y for curve in by_axis["step"].values()], environment.optimum)
        found[kind] = LearningCurves(by_axis, scale, variants if kind == "training" else ())
    return found


def _curve(runs: Sequence[Any], by: str) -> Curve | None:
    try:
        found = mean_curve(runs, by)
    except ValueError:
        return None  # a clock that was set back has made wall times fall
    if found is None:
        return None
    points, band = found
    return Curve(points, band.point, band.low, band.high)


def linear_up_to(curves: Iterable[Floats], optimum: float | None) -> float | None:
    """Where a symmetric logarithmic axis ceases to be linear; None where a linear axis shows all.

    It is the optimum's magnitude or, where that is not known, the largest of the returns that the
    curves end with. The curves are in the order of time, each of shape (n_points,).
    """
    known = [finite for curve in curves if len(finite := curve[np.isfinite(curve)])]
    if not known:
        return None
    if optimum is None:
        optimum = max(float(np.abs(curve[-max(len(curve) // 4, 1) :]).max()) for curve in known)
    scale = max(abs(optimum), 1.0)
    return scale if max(float(np.abs(curve).max()) for curve in known) > DWARFED * scale else None


# Training returns, summed up by blocks of episodes.


def episodes_table(results: StudyResults, width: int) -> pd.DataFrame:
    """Training returns of all seeds by agent, environment and block of ``width`` episodes.

    Columns agent, environment, episode (the last of the block), average, minimum, maximum.
    """
    rows = []
    for planned in results.in_folders:
        returns = read_episodes(planned.run).returns
        columns = {
            "agent": planned.agent,
            "environment": planned.environment,
            "episode": (np.arange(len(returns)) // width + 1) * width,
            "return": returns,
        }
        rows.append(pd.DataFrame(columns))
    if not rows:
        return pd.DataFrame(columns=["agent", "environment", "episode"])
    grouped = pd.concat(rows).groupby(["environment", "agent", "episode"], sort=False)["return"]
    return grouped.agg(average="mean", minimum="min", maximum="max").reset_index()


# What Thompson sampling believes of its arms, as densities to draw.

N_POINTS = 241


@dataclass(frozen=True)
class Belief:
    """What an agent believed of the arms in its first run."""

    agent: str  # its label
    moments: Ints  # after how many pulls, shape (n_moments,)
    points: Floats  # mean rewards that the densities are given at, shape (n_points,)
    densities: Floats  # shape (n_moments, n_contexts, n_arms, n_points)
    # By context and arm; None for an agent that knows no contexts.
    true_means: list[list[float | None]]


def belief(results: StudyResults, agent: str, statistics: PullStatistics) -> Belief:
    """The densities of an agent's beliefs, at all moments that were kept."""
    spec = next(planned.spec for planned in results.planned if planned.agent == agent)
    means = statistics.true_means
    # Parameters: of a normal distribution mean and standard deviation, of a Beta distribution both.
    if spec.hyperparams.algorithm.get("likelihood") == "gaussian":
        family, low, high = stats.norm, means.min() - 2, means.max() + 2
    else:
        family, low, high = stats.beta, 0.0, min(2 * float(means.max()), 1.0)
    points = np.linspace(low, high, N_POINTS)
    parameters = statistics.posteriors
    _, n_contexts, n_arms, _ = parameters.shape
    return Belief(
        agent,
        statistics.moments,
        points,
        family.pdf(points, parameters[..., :1], parameters[..., 1:]),
        means.tolist() if n_contexts == len(means) else [[None] * n_arms] * n_contexts,
    )


# What is known of the regret of bandit agents beforehand.


def auer_bound(means: ArrayLike, pulls: ArrayLike) -> Floats:
    """An upper bound on the expected regret of UCB1, by pulls, for rewards between 0 and 1.

    Source: Auer, Cesa-Bianchi and Fischer (2002), theorem 1.
    """
    arms = np.asarray(means, dtype=np.float64)
    gaps = arms.max() - arms
    gaps = gaps[gaps > 0]
    rate = (8 / gaps).sum()
    return np.asarray(rate * np.log(pulls) + (1 + np.pi**2 / 3) * gaps.sum())


def lai_robbins_slope(means: ArrayLike) -> float:
    """How fast the regret on Bernoulli arms must grow with the logarithm of the pulls, in the end.

    The bound is asymptotic: after a finite number of pulls an agent may lie below it.

    Args:
        means: of the arms, shape (n_arms,), strictly between 0 and 1.

    Source: Lai and Robbins (1985), theorem 1.
    """
    arms = np.asarray(means, dtype=np.float64)
    best = arms.max()
    worse = arms[arms < best]
    divergence = special.rel_entr(worse, best) + special.rel_entr(1 - worse, 1 - best)
    return float(((best - worse) / divergence).sum())


def best_of_normals(n: int) -> float:
    """The expected maximum of ``n`` independent standard normal variables."""
    value, _ = integrate.quad(
        lambda x: x * n * stats.norm.pdf(x) * stats.norm.cdf(x) ** (n - 1), -np.inf, np.inf
    )
    return float(value)


def best_expected_reward(env: gym.Env[object, object]) -> float | None:
    """The highest expected reward of a pull, over contexts and whatever is drawn at reset.

    None where it moves with time, or has no simple form.
    """
    bandit = env.unwrapped
    if getattr(bandit, "drift_std", 0.0) > 0:
        return None
    if getattr(bandit, "redraws", False):
        if bandit.kind != "gaussian":  # type: ignore[attr-defined]
            return None
        return float(bandit.mean_loc + best_of_normals(bandit.n_arms))  # type: ignore[attr-defined]
    means = getattr(bandit, "means", None)
    if means is None:
        return None
    weights = getattr(bandit, "context_probabilities", np.ones(1))
    return float(np.asarray(weights) @ np.asarray(means).max(axis=1))


# What agents make of a bandit: regrets by pull, where pulls went, what is believed.

SPREAD = f"{QUANTILES[-1] - QUANTILES[0]:.0%}"  # of the runs lie between the outer quantiles

Pulls = Mapping[str, PullStatistics]


@dataclass(frozen=True)
class RegretBounds:
    """What theory says of the regret, each of shape (n_points,)."""

    pulls: Ints
    auer: Floats
    lai_robbins: Floats


@dataclass(frozen=True)
class ArmSeries:
    """Arms in the order of contexts, each array of shape (n_contexts * n_arms,)."""

    names: list[str]  # what the arms are called
    means: Floats  # their true mean rewards
    # By agent, the share of the pulls in the context that went to them.
    shares: Mapping[str, Floats]
    # By agent that has some, final estimates of the means, mean and standard deviation over runs.
    estimates: Mapping[str, tuple[Floats, Floats]]


@dataclass(frozen=True)
class PullSeries:
    """What there is to draw of a bandit."""

    pulls: Pulls  # figures by pull of each agent, the best first
    best: float | None  # the highest expected reward of a pull, where it is known
    # For a single row of Bernoulli arms that stay as they are; else None.
    bounds: RegretBounds | None
    arms: ArmSeries | None  # None where arms differ between runs
    beliefs: tuple[Belief, ...]  # of the agents that have some

    @property
    def n_runs(self) -> int:
        """How many runs the figures are over."""
        return len(next(iter(self.pulls.values())).total_reward)


def pull_series(results: StudyResults, environment: EnvironmentAnalysis) -> PullSeries | None:
    """What there is to draw of an environment; None where it is no bandit."""
    label = environment.environment
    pulls = {
        agent.agent: results.pulls[agent.agent, label]
        for agent in environment.agents
        if (agent.agent, label) in results.pulls
    }
    if not pulls:
        return None
    env = make_single_env(next(p for p in results.planned if p.environment == label).spec)
    try:
        best, bounds = best_expected_reward(env), regret_bounds(env, next(iter(pulls.values())))
    finally:
        env.close()
    known = {agent: found for agent, found in pulls.items() if found.true_means.size}
    beliefs = [belief(results, agent, p) for agent, p in known.items() if len(p.moments)]
    return PullSeries(pulls, best, bounds, arm_series(known), tuple(beliefs))


def mean_regret(statistics: PullStatistics) -> Curve:
    """Cumulative regret: the mean over runs with its 95 % interval."""
    mean, reach = statistics.cumulative_regret, 1.96 * statistics.cumulative_regret_sem
    return Curve(statistics.pulls.astype(np.float64), mean, mean - reach, mean + reach)


def regret_of_runs(statistics: PullStatistics) -> Curve:
    """Cumulative regret: the median run between the outer quantiles."""
    low, *_, high = statistics.cumulative_regret_quantiles
    median = statistics.cumulative_regret_quantiles[QUANTILES.index(0.5)]
    return Curve(statistics.pulls.astype(np.float64), median, low, high)


def regret_bounds(env: gym.Env[Any, Any], statistics: PullStatistics) -> RegretBounds | None:
    """What theory says beforehand, where its conditions hold."""
    bandit: Any = env.unwrapped
    means, pulls = statistics.true_means, statistics.pulls
    if bandit.kind != "clicks" or len(means) != 1 or means.max() == means.min():
        return None
    slope = lai_robbins_slope(means[0])
    return RegretBounds(pulls, auer_bound(means[0], pulls), slope * np.log(pulls))


def arm_series(known: Pulls) -> ArmSeries | None:
    """Shares and estimates of agents on arms that all runs share; None without such an agent."""
    if not known:
        return None
    means = next(iter(known.values())).true_means
    contexts, arms = means.shape
    return ArmSeries(
        names=[
            f"arm {arm}" if contexts == 1 else f"context {context}, arm {arm}"
            for context in range(contexts)
            for arm in range(arms)
        ],
        means=means.ravel(),
        shares={agent: statistics.shares.ravel() for agent, statistics in known.items()},
        estimates={
            agent: (
                np.broadcast_to(statistics.estimates, means.shape).ravel(),
                np.broadcast_to(statistics.estimates_std, means.shape).ravel(),
            )
            for agent, statistics in known.items()
            if np.isfinite(statistics.estimates).any()
        },
    )


# What each run has come to, and the means with their intervals.

LEAST_VALUES = 3  # of a parameter, for a figure of it


@dataclass(frozen=True)
class AgentRuns:
    """The runs of an agent that have a figure."""

    agent: str  # its label
    mean: Estimate  # their mean with its interval
    seeds: Ints  # which runs, shape (n_runs,)
    values: Floats  # what they have come to, likewise


@dataclass(frozen=True)
class Sweep:
    """Means by the one parameter that an agent was swept over."""

    parameter: str  # what it is called on an axis
    means: Curve  # by its value, with their intervals
    labels: tuple[str, ...]  # of the agents in that order


@dataclass(frozen=True)
class Grid:
    """Means by the two parameters that an agent was swept over."""

    # What they are called on axes: the one that goes down and the one across.
    parameters: tuple[str, str]
    down: list[str]  # their values
    across: list[str]
    means: Floats  # shape (down, across), NaN where there is no run
    labels: list[list[str]]  # of the agents there; empty where there is none

    def shares(self, *, is_cost: bool) -> Floats:
        """How far each mean is on the way from the worst to the best: 0 to 1."""
        known = self.means[np.isfinite(self.means)]
        low, high = known.min(initial=np.inf), known.max(initial=-np.inf)
        shares = (self.means - low) / (high - low if high > low else 1.0)
        return np.asarray(1 - shares if is_cost else shares)


def run_series(results: StudyResults, environment: EnvironmentAnalysis) -> list[AgentRuns]:
    """The runs on an environment, by what the verdicts are about; the best agent first."""
    values = values_over_seeds(results, environment.environment, results.study.metric)
    found = []
    for agent in environment.agents:
        there = np.flatnonzero(np.isfinite(values[agent.agent]))
        runs, seeds = values[agent.agent][there], there + results.study.first_seed
        found.append(AgentRuns(agent.agent, agent.metric.mean, seeds, runs))
    return found


def sweeps(agents: Sequence[AgentSpec], environment: EnvironmentAnalysis) -> dict[str, Sweep]:
    """By agent that was swept over one parameter, the means in the order of its values."""
    found: dict[str, Sweep] = {}
    means = {agent.agent: agent.metric.mean for agent in environment.agents}
    for (group, name), members in _groups(agents, environment, 1).items():
        numbers = [(one.swept[name], one.label) for one in members]
        by_value = {float(x): label for x, label in numbers if isinstance(x, int | float)}
        if len(by_value) >= LEAST_VALUES:
            x, labels = zip(*sorted(by_value.items()), strict=True)
            rows = [(e.point, e.low, e.high) for e in map(means.__getitem__, labels)]
            found[group] = Sweep(symbol(name), Curve(np.array(x), *np.array(rows).T), labels)
    return found


def grids(agents: Sequence[AgentSpec], environment: EnvironmentAnalysis) -> dict[str, Grid]:
    """By agent that was swept over two parameters, the means over the values of both."""
    found: dict[str, Grid] = {}
    means = {agent.agent: agent.metric.mean for agent in environment.agents}
    for (group, *names), members in _groups(agents, environment, 2).items():
        down, across = ([str(one.swept[name]) for one in members] for name in names)
        rows, columns = list(dict.fromkeys(down)), list(dict.fromkeys(across))
        at = dict(zip(zip(down, across, strict=True), (one.label for one in members), strict=True))
        labels = [[at.get((row, column), "") for column in columns] for row in rows]
        if len(rows) > 1 and len(columns) > 1:
            points = [[means[at].point if at else np.nan for at in row] for row in labels]
            parameters = symbol(names[0]), symbol(names[1])
            found[group] = Grid(parameters, rows, columns, np.array(points), labels)
    return found


def with_best_mean(environment: EnvironmentAnalysis, labels: Sequence[str]) -> list[str]:
    """Those of these agents that have the best mean."""
    means = {a.agent: a.metric.mean.point for a in environment.agents if a.agent in labels}
    best = next(iter(means.values()), math.nan)
    return [label for label, mean in means.items() if math.isclose(mean, best)]


def _groups(
    agents: Sequence[AgentSpec], environment: EnvironmentAnalysis, n_parameters: int
) -> dict[tuple[str, ...], list[AgentSpec]]:
    """By label and parameters of each sweep over so many, its agents that have a mean there."""
    groups: dict[tuple[str, ...], list[AgentSpec]] = {}
    there = {agent.agent for agent in environment.agents}
    for spec in agents:
        if len(spec.swept) == n_parameters and spec.label in there:
            groups.setdefault((spec.group, *spec.swept), []).append(spec)
    return groups


# All numbers that the figures of a study show: drawn on paper and on the page from the same.


@dataclass(frozen=True)
class EnvironmentSeries:
    """What there is to draw of an environment."""

    environment: EnvironmentAnalysis  # how the agents did on it
    # By kind; on bandits None, which have theirs by pull.
    curves: Mapping[str, LearningCurves] | None
    runs: Sequence[AgentRuns]  # the best agent first
    pulls: PullSeries | None  # on bandits; else None
    sweeps: Mapping[str, Sweep]  # by agent, where it was swept over one parameter
    grids: Mapping[str, Grid] = field(default_factory=dict)  # by agent, where it was swept over two


@dataclass(frozen=True)
class StudySeries:
    """What there is to draw of a study."""

    analysis: StudyAnalysis  # the study
    marks: Mapping[str, Mark]  # how each agent is drawn
    environments: tuple[EnvironmentSeries, ...]  # by environment


def study_series(analysis: StudyAnalysis, tell: Tell = tell_nobody) -> StudySeries:
    """Compute all that is drawn; most of the time goes into the intervals of the curves."""
    results, agents = analysis.results, analysis.study.agents
    environments = []
    for one in analysis.environments:
        tell(one.environment)
        pulls = pull_series(results, one)
        found = EnvironmentSeries(
            environment=one,
            curves=learning_curves(results, one) if pulls is None else None,
            runs=run_series(results, one),
            pulls=pulls,
            sweeps=sweeps(agents, one),
            grids=grids(agents, one),
        )
        environments.append(found)
    return StudySeries(analysis, agent_marks(analysis.study), tuple(environments))
