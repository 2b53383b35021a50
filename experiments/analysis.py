"""From the runs of a study to judgements: estimates with intervals, verdicts on pairs, ranks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
import pandas as pd

from experiments.reliability import agents_without_chance, failures, speeds
from experiments.seed_values import RESAMPLING_SEED, values_over_seeds
from experiments.study_results import StudyResults
from experiments.study_spec import COSTS, StudySpec
from mdp.array_types import Floats
from pipeline.environments import trains_on_variant
from pipeline.signs_of_life import Tell, tell_nobody
from verdicts import (
    FEWEST_SEEDS,
    Band,
    Estimate,
    FailureCount,
    PairComparison,
    SpeedComparison,
    Summary,
    ThresholdSummary,
    compare_pairs,
    estimate,
    fail_more_often,
    fewest_seeds,
    level_of_look,
    performance_profile,
    probability_of_improvement,
    summarise,
    summarise_steps,
)

LOOK = 1  # how often a study has been looked at
ALPHA = 0.05  # of the studies, at most, say anything wrong on an environment
MARGIN = 0.02  # of the way from the best blind policy to the optimum


@dataclass(frozen=True)
class AgentAnalysis:
    """How one agent did on one environment.

    Attributes:
        agent: its label.
        algo: its name in the table of agents.
        n_runs: runs that finished.
        n_missing: runs that did not.
        metric: estimates of what the verdicts are about, over seeds.
        score: the same of the final policy between the best blind policy (0) and the optimum (1);
            None where those are not known.
        final: mean return of the final policy.
        area: mean return over the learning curve.
        last_episodes: mean return of the last training episodes.
        regret: on bandits, the sum over all pulls; else without a figure.
        steps_to_threshold: when the learning curve reached the threshold; None without one.
        steps_to_stay: when it reached the threshold for good; likewise.
        episodes_to_threshold: likewise.
        success_rate: of the final policy; None where the environment does not say.
        seconds: time that training took.
        on_variant: whether it was trained on a variant of the environment, whose returns are not to
            be held against those of evaluations or the optimum.
    """

    agent: str
    algo: str
    n_runs: int
    n_missing: int
    metric: Summary
    score: Summary | None
    final: Estimate
    area: Estimate
    last_episodes: Estimate
    regret: Estimate
    steps_to_threshold: ThresholdSummary | None
    episodes_to_threshold: ThresholdSummary | None
    success_rate: Estimate | None
    seconds: Estimate
    on_variant: bool = False
    steps_to_stay: ThresholdSummary | None = None


@dataclass(frozen=True)
class EnvironmentAnalysis:
    """How the agents compare on one environment.

    Attributes:
        environment: its label.
        env_id: its Gymnasium id.
        optimum: the highest expected return that any policy has, or None.
        best_blind: that of the best policy that ignores what it observes, or None.
        threshold: the return that counts as solved, or None.
        margin: the difference within which agents count as equivalent.
        exact: whether all final returns are expectations rather than means of episodes.
        agents: the agents, the best first.
        pairs: every two of them, the better ranked first.
        missing: by agent, also those of which no run has finished, the runs that are not there.
        fewest: with how few seeds any two agents can be told apart.
        failures: by agent, the runs that failed; empty where nothing says what that is.
        unreliable: the pairs of agents of which the first is shown to fail more often.
        speeds: every two agents, as to which of them stays above the threshold sooner.
    """

    environment: str
    env_id: str
    optimum: float | None
    best_blind: float | None
    threshold: float | None
    margin: float
    exact: bool
    agents: tuple[AgentAnalysis, ...]
    pairs: tuple[PairComparison, ...]
    missing: Mapping[str, int] = field(default_factory=dict)
    fewest: int = FEWEST_SEEDS
    failures: Mapping[str, FailureCount] = field(default_factory=dict)
    unreliable: tuple[tuple[str, str], ...] = ()
    speeds: tuple[SpeedComparison, ...] = ()


@dataclass(frozen=True)
class OverallAnalysis:
    """How the agents compare over all environments, by their scores.

    Attributes:
        scores: estimates by agent, the best first.
        improvement: by two agents' labels, the probability that the first scores higher.
        thresholds: scores at which the profiles are given, shape (n,).
        profiles: by agent, the share of runs that score higher than each of them.
    """

    scores: Mapping[str, Summary]
    improvement: Mapping[tuple[str, str], Estimate]
    thresholds: Floats
    profiles: Mapping[str, Band]


@dataclass(frozen=True)
class StudyAnalysis:
    """What a study has shown.

    Attributes:
        results: the runs.
        environments: by environment.
        overall: over all of them; None for a single one, or where a score is not known.
    """

    results: StudyResults
    environments: tuple[EnvironmentAnalysis, ...]
    overall: OverallAnalysis | None

    @property
    def study(self) -> StudySpec:
        """What was asked for."""
        return self.results.study


def analyse(results: StudyResults, tell: Tell = tell_nobody) -> StudyAnalysis:
    """Judge the runs of a study."""
    environments = []
    for environment in results.study.environments:
        tell(environment.label)
        if (results.summary["environment"] == environment.label).any():
            environments.append(_analyse_environment(results, environment.label))
    tell("all environments")
    return StudyAnalysis(results, tuple(environments), _analyse_overall(results))


def _first(table: pd.DataFrame, column: str) -> float | None:
    known = table[column].dropna()
    return None if known.empty else float(known.iloc[0])


def _analyse_environment(results: StudyResults, environment: str) -> EnvironmentAnalysis:
    study, table = results.study, results.summary
    table = table[table["environment"] == environment]
    metric = values_over_seeds(results, environment, study.metric)
    sign = -1.0 if study.metric in COSTS else 1.0
    agents = [_analyse_agent(results, environment, agent.label) for agent in study.agents]
    missing = {agent.agent: agent.n_missing for agent in agents}
    agents = [agent for agent in agents if agent.n_runs]
    agents.sort(key=lambda agent: _rank(sign * agent.metric.mean.point), reverse=True)
    optimum, blind = _first(table, "optimum"), _first(table, "best_blind")
    margin = study.margin
    if margin is None:
        span = 0.0 if optimum is None or blind is None else optimum - blind
        margin = MARGIN * span
    names = [agent.agent for agent in agents]
    scores = {name: sign * metric[name] for name in names}
    certain = agents_without_chance(results, table)
    level = level_of_look(ALPHA, LOOK)
    pairs = compare_pairs(scores, margin, seed=RESAMPLING_SEED, look=LOOK, certain=certain)
    failed = failures(study.metric, scores, blind, level, certain)
    n_tested = sum(not pair.certain for pair in pairs)
    return EnvironmentAnalysis(
        environment=environment,
        env_id=str(table["env_id"].iloc[0]),
        optimum=optimum,
        best_blind=blind,
        threshold=_first(table, "threshold"),
        margin=margin,
        exact=bool((table["exact"] == True).all()),  # noqa: E712  # None is no False here
        agents=tuple(agents),
        pairs=tuple(pairs),
        missing=missing,
        fewest=max(fewest_seeds(level / max(n_tested, 1)), FEWEST_SEEDS),
        failures=failed,
        unreliable=tuple(fail_more_often(failed, level)),
        speeds=speeds(results, environment, names, level),
    )


def _rank(value: float) -> float:
    return -np.inf if np.isnan(value) else value


def _analyse_agent(results: StudyResults, environment: str, agent: str) -> AgentAnalysis:
    study, table = results.study, results.summary
    table = table[(table["environment"] == environment) & (table["agent"] == agent)]

    def values(column: str) -> Floats:
        column_of = table.set_index("seed")[column].reindex(study.seeds)
        return column_of.to_numpy(dtype=np.float64, na_value=np.nan)

    def mean(column: str) -> Estimate:
        return estimate(values(column), "mean", seed=RESAMPLING_SEED)

    has_threshold = bool(table["threshold"].notna().any())
    metric = summarise(values(study.metric), seed=RESAMPLING_SEED)
    return AgentAnalysis(
        agent=agent,
        algo=next(spec.algo for spec in study.agents if spec.label == agent),
        n_runs=len(table),
        n_missing=study.n_seeds - len(table),
        metric=metric,
        score=summarise(values("score"), seed=RESAMPLING_SEED)
        if table["score"].notna().any()
        else None,
        final=mean("final"),
        area=mean("area"),
        last_episodes=mean("last_episodes"),
        regret=metric.mean if study.metric == "regret" else mean("regret"),
        steps_to_threshold=summarise_steps(values("steps_to_threshold")) if has_threshold else None,
        steps_to_stay=summarise_steps(values("steps_to_stay")) if has_threshold else None,
        episodes_to_threshold=summarise_steps(values("episodes_to_threshold"))
        if has_threshold
        else None,
        success_rate=mean("success_rate") if table["success_rate"].notna().any() else None,
        seconds=mean("seconds"),
        on_variant=any(
            trains_on_variant(run.spec)
            for run in results.planned
            if (run.agent, run.environment, run.seed) == (agent, environment, 0)
        ),
    )


def _analyse_overall(results: StudyResults) -> OverallAnalysis | None:
    study = results.study
    labels = [environment.label for environment in study.environments]
    if len(labels) < 2:
        return None
    columns = [values_over_seeds(results, label, "score") for label in labels]
    scores = {
        agent.label: np.column_stack([column[agent.label] for column in columns])
        for agent in study.agents
    }
    if any(np.isnan(matrix).all(axis=0).any() for matrix in scores.values()):
        return None
    summaries = {agent: summarise(matrix, seed=RESAMPLING_SEED) for agent, matrix in scores.items()}
    order = sorted(summaries, key=lambda agent: summaries[agent].iqm.point, reverse=True)
    thresholds = np.linspace(0, 1, 101)
    return OverallAnalysis(
        scores={agent: summaries[agent] for agent in order},
        improvement=_improvement({agent: scores[agent] for agent in order}),
        thresholds=thresholds,
        profiles={
            agent: performance_profile(scores[agent], thresholds, seed=RESAMPLING_SEED)
            for agent in order
        },
    )


def _improvement(scores: Mapping[str, Floats]) -> dict[tuple[str, str], Estimate]:
    """How probable it is that one agent scores higher than another, seen from both sides."""
    found = {}
    for one, two in combinations(scores, 2):
        chance = probability_of_improvement(scores[one], scores[two], seed=RESAMPLING_SEED)
        found[one, two] = chance
        found[two, one] = replace(
            chance, point=1 - chance.point, low=1 - chance.high, high=1 - chance.low
        )
    return found
