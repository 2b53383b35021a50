"""Analyses the runs of a study: figures with intervals, verdicts on pairs, failed runs.

It also says how soon agents reach the threshold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
import pandas as pd

from rl_yardstick import verdicts
from rl_yardstick.agents.registry import ALGORITHMS
from rl_yardstick.envs.brackets import return_bounds
from rl_yardstick.experiments.results import StudyResults, values_over_seeds
from rl_yardstick.experiments.study import COSTS, OF_TRAINING, StudySpec
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.environments import make_single_env, training_changes
from rl_yardstick.pipeline.evaluation.yardstick import FAILED, Yardstick
from rl_yardstick.verdicts import Best, Bounds, Estimate, Pair, Study, Summary, ThresholdSummary

ON_THE_SCALE = ("final", "best")  # metrics on the scale of the best random or constant policy
FIXED_POLICIES = ("planning", "reference")  # families of agents that do not learn
UNIT: Bounds = (0.0, 1.0)  # of scores
MARGIN = 0.02  # of the gap between the best random or constant policy and the optimum
OVERALL = "all environments"  # the name of the comparison of scores over all environments


# --- the evidence for verdicts --------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """The evidence for verdicts on an environment."""

    environment: str  #: its label
    #: By agent, the metric of its seeds, shape (n_seeds,): NaN for a missing run.
    values: Mapping[str, Floats] = field(default_factory=dict)
    seeds: Mapping[str, int] = field(default_factory=dict)  #: by agent, its planned seeds
    optimum: float | None  #: the highest expected return of any policy, or an upper bound of it
    optimum_at_least: float | None = None  #: a lower bound, if ``optimum`` is an upper one
    baseline: float | None  #: expected return of the best random or constant policy, or None
    threshold: float | None  #: the return that counts as solved, or None
    bounds: Bounds  #: the least and the greatest possible return
    certain: frozenset[str] = frozenset()  #: the agents that do not depend on chance
    is_score: bool  #: whether verdicts are on scores, from the baseline (0) to the optimum (1)
    is_cost: bool = False  #: whether a lower metric is better
    margin: float  #: the largest difference that does not matter, in scores or else in the metric

    @cached_property
    def scores(self) -> dict[str, Floats]:
        """By agent, what verdicts compare, one for each of its seeds; higher is better.

        Scores are cut at 0 and 1: less than the best random or constant policy counts as 0.
        """
        given = {name: values[: self.seeds[name]] for name, values in self.values.items()}
        if not self.is_score:
            return {name: -values if self.is_cost else values for name, values in given.items()}
        zero, one = self.baseline or 0.0, self.optimum or 0.0
        return {name: np.clip((x - zero) / (one - zero), 0, 1) for name, x in given.items()}


def evidence_of(results: StudyResults) -> list[Evidence]:
    """Collect the evidence on each environment on which a run has finished."""
    there = set(results.summary["environment"])
    return [_evidence_on(results, e.label) for e in results.study.environments if e.label in there]


def _evidence_on(results: StudyResults, environment: str) -> Evidence:
    study, table = results.study, results.summary
    table = table[table["environment"] == environment]
    optimum, baseline = _first(table, "optimum"), _first(table, "baseline")
    is_score, margin = False, study.margin or 0.0
    if study.metric in ON_THE_SCALE and optimum is not None and baseline is not None:
        is_score = Yardstick(optimum, baseline).has_scale
        if is_score:
            margin = MARGIN if study.margin is None else study.margin / (optimum - baseline)
    # Agents that do not learn are certain if policies are evaluated exactly.
    is_exact = (table["exact"] == True).all()  # noqa: E712  # None is neither True nor False
    families = {a.label: ALGORITHMS[a.algo].family for a in study.agents if a.algo}
    fixed = [name for name, family in families.items() if family in FIXED_POLICIES]
    seeds = dict.fromkeys((agent.label for agent in study.agents), 0)
    for run in results.planned:
        if run.environment == environment:
            seeds[run.agent] += run.n_runs
    return Evidence(
        environment=environment,
        values=values_over_seeds(results, environment, study.metric),
        seeds=seeds,
        optimum=optimum,
        optimum_at_least=_first(table, "optimum_at_least"),
        baseline=baseline,
        threshold=_first(table, "threshold"),
        bounds=_bounds(results, environment, optimum),
        certain=frozenset(fixed if is_exact else ()),
        is_score=is_score,
        is_cost=study.metric in COSTS,
        margin=margin,
    )


def _bounds(results: StudyResults, environment: str, optimum: float | None) -> Bounds:
    """The least and the greatest possible metric: of a return, a regret, or a time."""
    study = results.study
    if study.metric in COSTS:
        return 0.0, np.inf
    first = {run.agent: run for run in results.planned if run.environment == environment}
    if not next(iter(first.values())).spec.env_id:
        return verdicts.UNBOUNDED  # an environment of somebody else's runs that is not known here
    if study.metric in OF_TRAINING and any(training_changes(r.spec) for r in first.values()):
        return verdicts.UNBOUNDED  # returns of training on a changed environment
    with closing(make_single_env(next(iter(first.values())).spec)) as env:
        low, high = return_bounds(env)
    return low, high if optimum is None or study.metric in OF_TRAINING else min(high, optimum)


def _first(table: pd.DataFrame, column: str) -> float | None:
    known = table[column].dropna()
    return None if known.empty else float(known.iloc[0])


def _verdicts_on(
    study: StudySpec,
    evidence: Sequence[Evidence],
    looks: Sequence[int],
    overall: Mapping[str, Floats] | None = None,
) -> Study:
    """The verdicts on all pairs; ``overall`` has mean scores over all environments by seed."""
    scores: dict[str, Mapping[str, Floats]] = {one.environment: one.scores for one in evidence}
    bounds = {one.environment: UNIT if one.is_score else one.bounds for one in evidence}
    for one in evidence:
        if one.is_cost:
            bounds[one.environment] = (-one.bounds[1], -one.bounds[0])
    margin = {one.environment: one.margin for one in evidence}
    baseline = {one.environment: 0.0 if one.is_score else None for one in evidence}
    if overall is not None:
        scores[OVERALL], bounds[OVERALL] = overall, UNIT
        margin[OVERALL], baseline[OVERALL] = MARGIN, None
    return verdicts.judge(
        scores,
        bounds=bounds,
        margin=margin,
        baseline=baseline,
        certain={(one.environment, name) for one in evidence for name in one.certain},
        paired=study.shared_randomness,
        against=study.against,
        looks=looks,
    )


def looked(results: StudyResults, looks: Sequence[int]) -> Study:
    """The verdicts of a growing study after all looks that its runs allow.

    All looks are computed from the scores, however often somebody ran the command.
    """
    return _verdicts_on(results.study, evidence_of(results), looks)


# --- all environments together --------------------------------------------------------------------


@dataclass(frozen=True)
class OverallAnalysis:
    """The comparison of agents over all environments, by their scores."""

    scores: Mapping[str, Summary]  #: figures by agent, the best first
    pairs: tuple[Pair, ...]  #: better ranked agent first; none in a growing study
    best: Best | None  #: None in a growing study
    thresholds: Floats  #: the scores of the profiles, shape (n,)
    profiles: Mapping[str, Floats]  #: by agent, the share of runs above each of these


def scores_over_all(results: StudyResults) -> dict[str, Floats] | None:
    """By agent, its scores, shape (n_seeds, n_environments); None where they are not known."""
    labels = [environment.label for environment in results.study.environments]
    columns = [values_over_seeds(results, label, "score") for label in labels]
    scores = {
        agent.label: np.column_stack([np.clip(column[agent.label], 0, 1) for column in columns])
        for agent in results.study.agents
    }
    known = all(np.isfinite(matrix).any(axis=0).all() for matrix in scores.values())
    return scores if known and len(labels) > 1 else None


def _overall(scores: Mapping[str, Floats], said: Study) -> OverallAnalysis:
    means = {agent: matrix.mean(axis=1) for agent, matrix in scores.items()}
    summaries = {agent: verdicts.summarise(values, UNIT) for agent, values in means.items()}
    order = sorted(means, key=lambda agent: summaries[agent].mean.point, reverse=True)
    thresholds = np.linspace(0, 1, 101)
    profiles = {name: verdicts.performance_profile(scores[name], thresholds) for name in order}
    return OverallAnalysis(
        scores={agent: summaries[agent] for agent in order},
        pairs=_in_order([pair for pair in said.pairs if pair.environment == OVERALL], order),
        best=said.best.get(OVERALL),
        thresholds=thresholds,
        profiles=profiles,
    )


def _in_order(pairs: Sequence[Pair], names: Sequence[str]) -> tuple[Pair, ...]:
    """The pairs with the better ranked agent first, in the order of both."""
    place = {name: k for k, name in enumerate(names)}
    there = [pair for pair in pairs if pair.first in place and pair.second in place]
    turned = [p if place[p.first] < place[p.second] else p.swapped() for p in there]
    return tuple(sorted(turned, key=lambda pair: (place[pair.first], place[pair.second])))


# --- each environment -----------------------------------------------------------------------------

MARK = "†"  # of agents that were trained on a changed environment


@dataclass(frozen=True)
class AgentAnalysis:
    """The results of one agent on one environment."""

    agent: str  #: its label
    runs: verdicts.AgentRuns  #: its runs as the verdicts compare them
    spread: float  #: the standard deviation of these over runs
    n_runs: int  #: finished runs
    n_missing: int  #: unfinished runs
    metric: Summary  #: the metric of the verdicts, over seeds
    #: The final policy's score, cut at 0 and 1; None if its scale is not known.
    score: Estimate | None
    final: Estimate  #: mean return of the final policy
    last_episodes: Estimate  #: mean return of the last training episodes
    regret: Estimate  #: on bandits, the sum over all pulls; else NaN
    #: Steps until the learning curve first reached the threshold, steps and episodes until it
    #: reached the threshold for good; None without a threshold or curves.
    steps_to_threshold: ThresholdSummary | None
    steps_to_stay: ThresholdSummary | None
    episodes_to_stay: ThresholdSummary | None
    success_rate: Estimate | None  #: of the final policy; None if not reported
    seconds: Estimate  #: processor time of training
    changes: tuple[str, ...] = ()  #: of the environment in training, in words
    stochastic: Estimate | None = None  #: exact return of the policy that acts in training
    acts_by: str = ""  #: this policy in words
    #: Exact discounted return of the final policy, the agent's discount, and the optimum under it.
    discounted: Estimate | None = None
    discount: float | None = None
    discounted_optimum: float | None = None

    @property
    def marked(self) -> str:
        """The label, with a mark if the agent was trained on a changed environment."""
        return f"{self.agent} {MARK}" if self.changes else self.agent


@dataclass(frozen=True, kw_only=True)
class EnvironmentAnalysis(Evidence):
    """The comparison of agents on one environment."""

    env_id: str  #: its Gymnasium id
    exact: bool  #: whether all final returns are exact expectations, not means of episodes
    agents: tuple[AgentAnalysis, ...]  #: the agents, the best first
    pairs: tuple[Pair, ...]  #: all pairs, better ranked agent first
    best: Best  #: the agents than which no other is shown to be better
    failure_threshold: float | None  #: the score below which a run failed; None if not defined
    missing: Mapping[str, int] = field(default_factory=dict)  #: runs, also by agents without one
    looks: tuple[int, ...] = ()  #: the seeds at each look, if the study grows until it is decided
    optimum_is_proven: bool = True  #: whether the upper bound is proven
    #: In a partially observable environment, the optimum of agents that see the state, and the
    #: input of the policies whose optimum is the scale: ``observation`` or ``memory``.
    full_optimum: float | None = None
    measured_by: str | None = None
    optima: Mapping[str, float] = field(default_factory=dict)  #: by agent, if they differ
    #: The agents whose mean final return exceeds the upper bound by more than six standard errors.
    impossible: tuple[str, ...] = ()


@dataclass(frozen=True)
class StudyAnalysis:
    """The analysis of a study."""

    results: StudyResults  #: the runs
    verdicts: Study  #: the verdicts on all pairs
    environments: tuple[EnvironmentAnalysis, ...]  #: by environment
    overall: OverallAnalysis | None  #: None for one environment, or if a score is not known

    @property
    def study(self) -> StudySpec:
        """The study's specification."""
        return self.results.study


def analyse(results: StudyResults, looks: Sequence[int] = ()) -> StudyAnalysis:
    """Analyse the runs of a study; ``looks`` are the seeds at each look, if it grows."""
    evidence = evidence_of(results)
    scores = scores_over_all(results)
    means = {name: matrix.mean(axis=1) for name, matrix in scores.items()} if scores else None
    said = _verdicts_on(results.study, evidence, looks, None if looks else means)
    environments = tuple(_analyse_environment(results, one, said, looks) for one in evidence)
    return StudyAnalysis(results, said, environments, _overall(scores, said) if scores else None)


def _analyse_environment(
    results: StudyResults, evidence: Evidence, said: Study, looks: Sequence[int]
) -> EnvironmentAnalysis:
    table, environment = results.summary, evidence.environment
    table = table[table["environment"] == environment]
    of_runs = {runs.name: runs for runs in said.agents if runs.environment == environment}
    agents = [_analyse_agent(results, evidence, runs) for runs in of_runs.values()]
    missing = {agent.agent: agent.n_missing for agent in agents}
    agents = [agent for agent in agents if agent.n_runs]
    last = -np.inf  # agents without a figure
    agents.sort(key=lambda a: last if np.isnan(a.runs.mean) else a.runs.mean, reverse=True)
    names, threshold = [agent.agent for agent in agents], said.failure_threshold[environment]
    return EnvironmentAnalysis(
        **{one.name: getattr(evidence, one.name) for one in fields(evidence)},
        env_id=str(table["env_id"].iloc[0]),
        exact=bool((table["exact"] == True).all()),  # noqa: E712  # None is neither True nor False
        agents=tuple(agents),
        pairs=_in_order([p for p in said.pairs if p.environment == environment], names),
        best=said.best[environment],
        failure_threshold=None if np.isnan(threshold) else threshold,
        missing=missing,
        looks=tuple(looks),
        optimum_is_proven=not (table["optimum_is_proven"] == False).any(),  # noqa: E712  # likewise
        full_optimum=_first(table, "full_optimum") if "full_optimum" in table else None,
        measured_by=_only(table["measured_by"]) or None if "measured_by" in table else None,
        optima=_differing_optima(table),
        impossible=_impossible(evidence, table),
    )


def _impossible(evidence: Evidence, table: pd.DataFrame) -> tuple[str, ...]:
    most = evidence.optimum
    if most is None or evidence.optimum_at_least is None:
        return ()
    found = []
    for agent, rows in table.groupby("agent", sort=False):
        finals = rows["final"].dropna().to_numpy(np.float64)
        error = float(finals.std(ddof=1)) / len(finals) ** 0.5 if len(finals) > 1 else np.inf
        if float(finals.mean()) - 6 * error > most + abs(most) * 1e-6:
            found.append(str(agent))
    return tuple(found)


def _differing_optima(table: pd.DataFrame) -> dict[str, float]:
    """By agent, the optimum on the first seed, as maps and arms may depend on the seed."""
    known = table[table["seed"] == table["seed"].min()].dropna(subset=["optimum"])
    optima = {str(row["agent"]): float(row["optimum"]) for _, row in known.iterrows()}
    alike = len(optima) < 2 or np.allclose([*optima.values()], next(iter(optima.values())))
    return {} if alike else optima


def _analyse_agent(
    results: StudyResults, evidence: Evidence, runs: verdicts.AgentRuns
) -> AgentAnalysis:
    study, table, environment = results.study, results.summary, evidence.environment
    agent = runs.name
    table = table[(table["environment"] == environment) & (table["agent"] == agent)]
    n_seeds = evidence.seeds[agent]

    def values(column: str) -> Floats:
        column_of = table.set_index("seed")[column].reindex(study.seeds[:n_seeds])
        return column_of.to_numpy(dtype=np.float64, na_value=np.nan)

    def mean(column: str, bounds: Bounds = verdicts.UNBOUNDED) -> Estimate:
        return verdicts.mean_over_runs(values(column), bounds)

    def steps(column: str) -> ThresholdSummary | None:
        found = verdicts.summarise_steps(values(column))
        return found if found.median.n else None

    def known(column: str, bounds: Bounds = verdicts.UNBOUNDED) -> Estimate | None:
        return mean(column, bounds) if table[column].notna().any() else None

    finite = evidence.scores[agent][np.isfinite(evidence.scores[agent])]
    optimum, baseline, score = evidence.optimum, evidence.baseline, None
    if optimum is not None and baseline is not None and Yardstick(optimum, baseline).has_scale:
        score = verdicts.mean_over_runs(np.clip(values("score"), 0, 1), UNIT)
    of_returns = evidence.bounds if study.metric in ON_THE_SCALE else verdicts.UNBOUNDED
    specs = {run.labels: run.spec for run in results.planned if run.spec.env_id}
    spec = specs.get((agent, environment))
    return AgentAnalysis(
        agent=agent,
        runs=runs,
        spread=float(finite.std(ddof=1)) if len(finite) > 1 else 0.0,
        n_runs=len(table),
        n_missing=n_seeds - len(table),
        metric=verdicts.summarise(values(study.metric), evidence.bounds),
        score=score,
        final=mean("final", of_returns),
        last_episodes=mean("last_episodes"),
        regret=mean("regret", (0.0, np.inf)),
        steps_to_threshold=steps("steps_to_threshold"),
        steps_to_stay=steps("steps_to_stay"),
        episodes_to_stay=steps("episodes_to_stay"),
        success_rate=known("success_rate", UNIT),
        seconds=mean("cpu_seconds", (0.0, np.inf)),
        changes=() if spec is None else training_changes(spec),
        stochastic=known("stochastic_return"),
        acts_by=_only(table["acts_by"]),
        discounted=known("discounted_return"),
        discount=_first(table, "discount"),
        discounted_optimum=_first(table, "discounted_optimum"),
    )


def _only(texts: pd.Series) -> str:
    """The text that is the same in all runs; empty if it differs."""
    found = texts.dropna().unique()
    return str(found[0]) if len(found) == 1 else ""


def worst_failed_run(results: StudyResults) -> str | None:
    """The folder of the run with the lowest exact score, if it has failed; random agents apart."""
    table = results.summary
    table = table[(table["exact"] == True) & (table["algo"] != "random")]  # noqa: E712  # likewise
    scores = table["score"].astype(float)
    return str(table["path"].iloc[int(scores.argmin())]) if scores.min() < FAILED else None
