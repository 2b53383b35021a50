"""The numbers in the figures, computed once for paper and for the page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy import special

from rl_yardstick.experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from rl_yardstick.experiments.bandits import QUANTILES, PullStatistics
from rl_yardstick.experiments.results import TRAINING_POINTS, StudyResults
from rl_yardstick.experiments.study import AgentSpec, StudySpec, symbol
from rl_yardstick.mdp.transition_model import Floats, Ints
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.run import read_episodes
from rl_yardstick.verdicts import UNBOUNDED, Bounds, curve_band, on_grid, shared_grid

# From this ratio on, the largest values flatten the rest of a linear axis: two decades.
DWARFED = 100

# Colours for kinds of agents, of which colour-blind readers can tell lines and pale bands apart:
# blue, red, green, wine, cyan, black, indigo. Behind them, from dark to light, those of viridis for
# agents swept over a number. The page's style sheet repeats them, with others for the dark theme.
N_KINDS, N_STEPS = 7, 8
COLOURS = (
    *("#0072B2", "#EE6677", "#2CA02C", "#882255", "#17BECF", "#000000", "#332288"),
    *("#440154", "#482979", "#3D4D8A", "#2F6C8E", "#23888E", "#20A486", "#44BF70", "#86D549"),
)

LEAST_VALUES = 3  # the smallest number of values of a swept parameter for colours and a figure

# Ticks of an axis of scores; where most scores are above 0.8, ticks and their places from 0 to 1.
LINEAR = (0.0, 0.5, 1.0)
SCORES, STRETCHED = (0.0, 0.8, 0.9, 1.0), (0.0, 0.35, 0.675, 1.0)

Dash = Literal["solid", "dash", "dashdot", "dot"]
# The colours of kinds and four line styles repeat together: neighbours differ in both, so lines
# differ in greyscale, too, and 28 agents have distinct marks.
DASHES: tuple[Dash, ...] = ("solid", "dash", "dashdot", "dot")


@dataclass(frozen=True)
class Mark:
    """How an agent is drawn."""

    label: str  # the agent's
    colour: int  # the index of its colour in `COLOURS`
    dash: Dash  # Plotly's name for its line style
    # The index of the shape of the dot beside its name on the page: the number of times that the
    # colours have repeated before, modulo 4.
    shape: int = 0


def agent_marks(study: StudySpec) -> dict[str, Mark]:
    """The marks of the agents by label, in the order of the study.

    An agent swept over a number gets a colour by the place of its value among the others.
    """
    marks: dict[str, Mark] = {}
    for n, members in enumerate(numeric_sweeps(study.agents).values()):
        if len(values := sorted({value for value, _ in members})) >= LEAST_VALUES:
            for value, label in members:
                rank = values.index(value)
                colour = N_KINDS + round((N_STEPS - 1) * rank / (len(values) - 1))
                marks[label] = Mark(label, colour, DASHES[(n + rank) % len(DASHES)])
    kinds = [agent.label for agent in study.agents if agent.label not in marks]
    for place, label in enumerate(kinds):
        again, colour = divmod(place, N_KINDS)
        dash, shape = DASHES[place % len(DASHES)], again % len(DASHES)
        marks[label] = Mark(label, colour, dash, shape)
    return {agent.label: marks[agent.label] for agent in study.agents}


def numeric_sweeps(
    agents: Iterable[AgentSpec],
) -> dict[tuple[str, str], list[tuple[float, str]]]:
    """The numbers that agents are swept over, with their labels, by common label and parameter."""
    found: dict[tuple[str, str], list[tuple[float, str]]] = {}
    for agent in agents:
        for name, value in agent.swept.items():
            if len(agent.swept) == 1 and isinstance(value, int | float):
                found.setdefault((agent.group, name), []).append((float(value), agent.label))
    return found


KINDS = ("evaluation", "training")
AXES = ("step", "episode", "seconds")


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
    # Agents with returns on a variant of the environment, which cannot be compared with the
    # optimum.
    on_variant: tuple[str, ...] = ()
    # The axis in the unit of the runs' budget: "step" or "episode".
    budget: str = "step"


def learning_curves(results: StudyResults, one: EnvironmentAnalysis) -> dict[str, LearningCurves]:
    """The curves on an environment, by kind; none where each would be a single point."""
    here = [run.spec for run in results.planned if run.environment == one.environment]
    by_episode = here and all(spec.n_timesteps is None for spec in here)
    agents = [agent.agent for agent in one.agents]
    variants = tuple(agent.agent for agent in one.agents if agent.changes)
    table = results.curves[results.curves["environment"] == one.environment]
    runs: dict[Any, list[pd.DataFrame]] = {}
    for (agent, kind, _), rows in table.groupby(["agent", "kind", "seed"]):
        runs.setdefault((agent, kind), []).append(rows)
    found = {}
    for kind in KINDS:
        # Training returns of a changed environment have other bounds.
        bounds = UNBOUNDED if kind == "training" and variants else one.bounds
        by_axis: dict[str, dict[str, Curve]] = {by: {} for by in AXES}
        for by, agent in product(AXES, agents):
            if (curve := mean_of(runs.get((agent, kind), []), by, bounds)) is not None:
                by_axis[by][agent] = curve
        for by, curves in by_axis.items():
            if all(len(curve.x) == 1 for curve in curves.values()):
                by_axis[by] = {}
        scale = linear_up_to([curve.y for curve in by_axis["step"].values()], one.optimum)
        budget = "episode" if by_episode and by_axis["episode"] else "step"
        on_variant = variants if kind == "training" else ()
        found[kind] = LearningCurves(by_axis, scale, on_variant, budget)
    return found


def mean_of(runs: Sequence[pd.DataFrame], by: str, bounds: Bounds = UNBOUNDED) -> Curve | None:
    """The mean of an agent's runs by step, episode or seconds; None without runs that overlap."""
    curves = [rows[[by, "value"]].to_numpy(np.float64).T for rows in runs]
    if not curves or max(x[0] for x, _ in curves) > min(x[-1] for x, _ in curves):
        return None
    grid = shared_grid([x for x, _ in curves], TRAINING_POINTS)
    band = curve_band([on_grid(x, y, grid) for x, y in curves], bounds)
    return Curve(grid, band.point, band.low, band.high)


def linear_up_to(curves: Iterable[Floats], optimum: float | None) -> float | None:
    """Where a symmetric logarithmic axis ceases to be linear; None where a linear axis shows all.

    It is the optimum's magnitude or, if that is unknown, the largest magnitude in the last quarter
    of the curves, but at least 1. Each curve is in order of time, of shape (n_points,).
    """
    known = [finite for curve in curves if len(finite := curve[np.isfinite(curve)])]
    if not known:
        return None
    ends = [curve[-max(len(curve) // 4, 1) :] for curve in known]
    magnitude = max(float(np.abs(end).max()) for end in ends) if optimum is None else abs(optimum)
    scale = max(magnitude, 1.0)
    return scale if max(float(np.abs(curve).max()) for curve in known) >= DWARFED * scale else None


def episodes_table(results: StudyResults, width: int) -> pd.DataFrame:
    """Training returns of all seeds by agent, environment and block of ``width`` episodes.

    Columns agent, environment, episode (the last of the block), average, minimum, maximum.
    """
    tables = []
    for planned in results.finished:
        if planned.is_batch:
            continue
        returns = read_episodes(planned.path).returns
        labels = {"agent": planned.agent, "environment": planned.environment}
        blocks = (np.arange(len(returns)) // width + 1) * width
        tables.append(pd.DataFrame({**labels, "episode": blocks, "return": returns}))
    if not tables:
        return pd.DataFrame(columns=["agent", "environment", "episode"])
    by = ["environment", "agent", "episode"]
    grouped = pd.concat(tables).groupby(by, sort=False)["return"]
    return grouped.agg(average="mean", minimum="min", maximum="max").reset_index()


N_POINTS = 241


@dataclass(frozen=True)
class Belief:
    """The posteriors of an agent for the arms' mean rewards, in its first run."""

    agent: str  # its label
    moments: Ints  # numbers of pulls, shape (n_moments,)
    points: Floats  # mean rewards at which the densities are evaluated, shape (n_points,)
    densities: Floats  # shape (n_moments, n_contexts, n_arms, n_points)
    # By context and arm; None for an agent that ignores contexts.
    true_means: list[list[float | None]]


def belief(results: StudyResults, agent: str, statistics: PullStatistics) -> Belief:
    """The densities of an agent's posteriors, at all recorded moments."""
    from scipy import stats

    spec = next(planned.spec for planned in results.planned if planned.agent == agent)
    means, parameters = statistics.true_means, statistics.posteriors
    # Parameters: mean and standard deviation of a normal, alpha and beta of a Beta distribution.
    if spec.algorithm.get("likelihood") == "gaussian":
        family, low, high = stats.norm, means.min() - 2, means.max() + 2
    else:
        family, low, high = stats.beta, 0.0, min(2 * float(means.max()), 1.0)
    points = np.linspace(low, high, N_POINTS)
    densities = family.pdf(points, parameters[..., :1], parameters[..., 1:])
    _, n_contexts, n_arms, _ = parameters.shape
    true_means: list[list[float | None]] = [[None] * n_arms] * n_contexts
    if n_contexts == len(means):
        true_means = means.tolist()
    return Belief(agent, statistics.moments, points, densities, true_means)


# Bounds from theory on the regret of bandit agents.


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
    """Lower bound on the growth of the regret per logarithm of the pulls, for Bernoulli arms.

    The bound is asymptotic: after a finite number of pulls the regret may be below it.

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
    from scipy import stats

    return float(stats.norm.expect(lambda x: x * n * special.ndtr(x) ** (n - 1)))


def best_expected_reward(env: gym.Env[object, object]) -> float | None:
    """The highest expected reward of a pull, averaged over contexts and over draws at reset.

    None if it drifts with time, or has no closed form.
    """
    bandit: Any = env.unwrapped
    if getattr(bandit, "drift_std", 0.0) > 0:
        return None
    if getattr(bandit, "redraws", False):
        is_normal = bandit.kind == "gaussian"
        return float(bandit.mean_loc + best_of_normals(bandit.n_arms)) if is_normal else None
    means = getattr(bandit, "means", None)
    if means is None:
        return None
    weights = getattr(bandit, "context_probabilities", np.ones(1))
    return float(np.asarray(weights) @ np.asarray(means).max(axis=1))


# The results of agents on a bandit: regret by pull, shares of the pulls, posteriors.

SPREAD = f"{QUANTILES[-1] - QUANTILES[0]:.0%}"  # of the runs lie between the outer quantiles

Pulls = Mapping[str, PullStatistics]


@dataclass(frozen=True)
class RegretBounds:
    """Bounds on the regret from theory, each of shape (n_points,)."""

    pulls: Ints
    auer: Floats
    lai_robbins: Floats


@dataclass(frozen=True)
class ArmSeries:
    """Arms in the order of contexts, each array of shape (n_contexts * n_arms,)."""

    names: list[str]  # of the arms
    means: Floats  # their true mean rewards
    # By agent, each arm's share of the pulls in its context.
    shares: Mapping[str, Floats]
    # By agent with estimates of the means: mean and standard deviation over runs, at the end.
    estimates: Mapping[str, tuple[Floats, Floats]]


@dataclass(frozen=True)
class PullSeries:
    """The numbers to draw for a bandit."""

    pulls: Pulls  # figures by pull of each agent, the best first
    best: float | None  # the highest expected reward of a pull, if known
    # For Bernoulli arms without contexts that are the same in all runs; else None.
    bounds: RegretBounds | None
    arms: ArmSeries | None  # None where arms differ between runs
    beliefs: tuple[Belief, ...]  # of the agents with posteriors

    @property
    def n_runs(self) -> int:
        """How many runs the figures are over."""
        return len(next(iter(self.pulls.values())).total_reward)


def pull_series(results: StudyResults, environment: EnvironmentAnalysis) -> PullSeries | None:
    """The numbers to draw for a bandit; None for another environment."""
    label = environment.environment
    pulls = {
        agent.agent: results.pulls[agent.agent, label]
        for agent in environment.agents
        if (agent.agent, label) in results.pulls
    }
    if not pulls:
        return None
    spec = next(run.spec for run in results.planned if run.environment == label)
    with closing(make_single_env(spec)) as env:
        best, bounds = best_expected_reward(env), regret_bounds(env, next(iter(pulls.values())))
    known = {agent: found for agent, found in pulls.items() if found.true_means.size}
    beliefs = [belief(results, agent, p) for agent, p in known.items() if len(p.moments)]
    return PullSeries(pulls, best, bounds, arm_series(known), tuple(beliefs))


def mean_regret(statistics: PullStatistics) -> Curve:
    """Cumulative regret: the mean over runs with its 95 % interval."""
    mean, reach = statistics.cumulative_regret, 1.96 * statistics.cumulative_regret_sem
    return Curve(statistics.pulls.astype(np.float64), mean, mean - reach, mean + reach)


def regret_of_runs(statistics: PullStatistics) -> Curve:
    """Cumulative regret: the median over runs, and the outer quantiles as its interval."""
    low, _, median, _, high = statistics.cumulative_regret_quantiles
    return Curve(statistics.pulls.astype(np.float64), median, low, high)


def regret_bounds(env: gym.Env[Any, Any], statistics: PullStatistics) -> RegretBounds | None:
    """The bounds on the regret from theory; None if their conditions do not hold."""
    bandit: Any = env.unwrapped
    means, pulls = statistics.true_means, statistics.pulls
    if bandit.kind != "clicks" or len(means) != 1 or means.max() == means.min():
        return None
    slope = lai_robbins_slope(means[0])
    return RegretBounds(pulls, auer_bound(means[0], pulls), slope * np.log(pulls))


def arm_series(known: Pulls) -> ArmSeries | None:
    """Shares and estimates of arms that are the same in all runs; None if there are none."""
    means = next((statistics.true_means for statistics in known.values()), None)
    if means is None:
        return None
    n_contexts, n_arms = means.shape
    estimates = {
        agent: (
            np.broadcast_to(statistics.estimates, means.shape).ravel(),
            np.broadcast_to(statistics.estimates_std, means.shape).ravel(),
        )
        for agent, statistics in known.items()
        if np.isfinite(statistics.estimates).any()
    }
    where = [f"context {context}, " if n_contexts > 1 else "" for context in range(n_contexts)]
    return ArmSeries(
        names=[f"{context}arm {arm}" for context in where for arm in range(n_arms)],
        means=means.ravel(),
        shares={agent: statistics.shares.ravel() for agent, statistics in known.items()},
        estimates=estimates,
    )


@dataclass(frozen=True)
class Sweep:
    """Means by the one parameter that an agent was swept over."""

    parameter: str  # its symbol, for an axis
    means: Curve  # by its value, with their intervals
    labels: tuple[str, ...]  # of the agents in that order


@dataclass(frozen=True)
class Grid:
    """Means by the two parameters that an agent was swept over."""

    # Their symbols, for the axes: the parameter of the rows and that of the columns.
    parameters: tuple[str, str]
    down: list[str]  # values of the rows' parameter
    across: list[str]  # values of the columns' parameter
    means: Floats  # shape (down, across), NaN where there is no run
    labels: list[list[str]]  # of the agents in the cells; empty where there is none

    def shares(self, *, is_cost: bool) -> Floats:
        """Each mean scaled to [0, 1], from the worst mean to the best."""
        known = self.means[np.isfinite(self.means)]
        low, high = known.min(initial=np.inf), known.max(initial=-np.inf)
        shares = (self.means - low) / (high - low if high > low else 1.0)
        return np.asarray(1 - shares if is_cost else shares)


def sweeps(agents: Sequence[AgentSpec], environment: EnvironmentAnalysis) -> dict[str, Sweep]:
    """The means of each agent swept over one parameter, in the order of its values."""
    found: dict[str, Sweep] = {}
    means = {agent.agent: agent.metric.mean for agent in environment.agents}
    for (group, name), members in numeric_sweeps(a for a in agents if a.label in means).items():
        by_value = dict(members)
        if len(by_value) >= LEAST_VALUES:
            x, labels = zip(*sorted(by_value.items()), strict=True)
            rows = [(e.point, e.low, e.high) for e in map(means.__getitem__, labels)]
            found[group] = Sweep(symbol(name), Curve(np.array(x), *np.array(rows).T), labels)
    return found


def grids(agents: Sequence[AgentSpec], environment: EnvironmentAnalysis) -> dict[str, Grid]:
    """The means of each agent swept over two parameters, by the values of both."""
    found: dict[str, Grid] = {}
    means = {agent.agent: agent.metric.mean for agent in environment.agents}
    groups: dict[tuple[str, ...], list[AgentSpec]] = {}
    for spec in agents:
        if len(spec.swept) == 2 and spec.label in means:
            groups.setdefault((spec.group, *spec.swept), []).append(spec)
    for (group, *names), members in groups.items():
        down, across = ([str(one.swept[name]) for one in members] for name in names)
        rows, columns = list(dict.fromkeys(down)), list(dict.fromkeys(across))
        at = dict(zip(zip(down, across, strict=True), (one.label for one in members), strict=True))
        labels = [[at.get((row, column), "") for column in columns] for row in rows]
        if len(rows) > 1 and len(columns) > 1:
            points = [[means[at].point if at else np.nan for at in row] for row in labels]
            parameters = symbol(names[0]), symbol(names[1])
            found[group] = Grid(parameters, rows, columns, np.array(points), labels)
    return found


@dataclass(frozen=True)
class EnvironmentSeries:
    """The numbers to draw for an environment."""

    environment: EnvironmentAnalysis  # how the agents did on it
    # By kind; None for bandits, whose curves are by pull.
    curves: Mapping[str, LearningCurves] | None
    pulls: PullSeries | None  # on bandits; else None
    sweeps: Mapping[str, Sweep]  # by agent, where it was swept over one parameter
    grids: Mapping[str, Grid] = field(default_factory=dict)  # by agent, where it was swept over two


@dataclass(frozen=True)
class StudySeries:
    """The numbers to draw for a study."""

    analysis: StudyAnalysis  # the study
    marks: Mapping[str, Mark]  # how each agent is drawn
    environments: tuple[EnvironmentSeries, ...]  # by environment


def study_series(analysis: StudyAnalysis) -> StudySeries:
    """Compute all that is drawn; most of the time goes into the intervals of the curves."""
    results, agents = analysis.results, analysis.study.agents
    environments = []
    for one in analysis.environments:
        pulls = pull_series(results, one)
        curves = learning_curves(results, one) if pulls is None else None
        swept = sweeps(agents, one), grids(agents, one)
        environments.append(EnvironmentSeries(one, curves, pulls, *swept))
    return StudySeries(analysis, agent_marks(analysis.study), tuple(environments))
