"""From the runs of a study to judgements: estimates with intervals, verdicts on pairs, ranks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from experiments.evidence import Evidence, evidence_on
from experiments.looks import Standing
from experiments.overall_analysis import OverallAnalysis, analyse_overall
from experiments.reliability import failures, speeds
from experiments.seed_values import RESAMPLING_SEED
from experiments.study_results import StudyResults
from experiments.study_spec import COSTS, StudySpec
from mdp.array_types import Floats
from pipeline.environments import training_changes, trains_on_variant
from pipeline.signs_of_life import Tell, tell_nobody
from pipeline.train_spec import TrainSpec
from verdicts import (
    FEWEST_SEEDS,
    Estimate,
    FailureCount,
    PairComparison,
    SpeedComparison,
    Summary,
    ThresholdSummary,
    describe_pairs,
    estimate,
    fail_more_often,
    grow,
    judge_pairs,
    summarise,
    summarise_steps,
)

# Of agents that were trained on a changed environment.
MARK = "†"


@dataclass(frozen=True)
class AgentAnalysis:
    """How one agent did on one environment.

    Attributes:
        agent: its label.
        algo: its name in the table of agents.
        n_runs: runs that finished.
        n_missing: runs that did not.
        metric: estimates of what the verdicts are about, over seeds.
        score: the same of the final policy between the best random or constant policy (0) and the
            optimum (1); None where those are not known.
        final: mean return of the final policy.
        area: mean return over the learning curve.
        last_episodes: mean return of the last training episodes.
        regret: on bandits, the sum over all pulls; else without a figure.
        steps_to_threshold: when the learning curve first reached the threshold; None without one.
        steps_to_stay: when it reached the threshold for good; likewise.
        episodes_to_stay: likewise.
        success_rate: of the final policy; None where the environment does not say.
        seconds: processor time that training took; nan where older versions did not measure it.
        on_variant: whether it was trained on a variant of the environment, whose returns are not to
            be held against those of evaluations or the optimum.
        changes: what training changed in the environment, as the runs recorded it, in words.
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
    episodes_to_stay: ThresholdSummary | None
    success_rate: Estimate | None
    seconds: Estimate
    on_variant: bool = False
    changes: tuple[str, ...] = ()

    @property
    def marked(self) -> str:
        """The label, with a mark where the training was on a changed environment."""
        return f"{self.agent} {MARK}" if self.changes else self.agent

    steps_to_stay: ThresholdSummary | None = None


@dataclass(frozen=True)
class EnvironmentAnalysis:
    """How the agents compare on one environment.

    Attributes:
        environment: its label.
        env_id: its Gymnasium id.
        optimum: the highest expected return that any policy has, or of a bracket what none
            exceeds; or None.
        baseline: that of the best random or constant policy, or None.
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
        seeds: by agent, how many seeds it was to have.
        look: which look at these runs it is.
        optimum_at_least: the lower end of the optimum's bracket; None where there is none.
        optima: by agent, where agents play environments whose optima differ; else empty.
        advice: sentences on runs that failed, see `experiments.failed_runs`.
    """

    environment: str
    env_id: str
    optimum: float | None
    baseline: float | None
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
    seeds: Mapping[str, int] = field(default_factory=dict)
    look: Standing = field(default_factory=Standing)
    optimum_at_least: float | None = None
    optima: Mapping[str, float] = field(default_factory=dict)
    advice: tuple[str, ...] = ()


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


def analyse(
    results: StudyResults, tell: Tell = tell_nobody, looks: Mapping[str, Standing] | None = None
) -> StudyAnalysis:
    """Judge the runs of a study.

    Args:
        results: the runs.
        tell: told how far it is.
        looks: by environment, which look at its runs this is; the first, where it is not said.
    """
    environments = []
    for environment in results.study.environments:
        tell(environment.label)
        evidence = evidence_on(results, environment.label)
        if evidence is not None:
            look = (looks or {}).get(environment.label, Standing())
            environments.append(_analyse_environment(results, evidence, look))
    tell("all environments")
    return StudyAnalysis(results, tuple(environments), analyse_overall(results))


def _analyse_environment(
    results: StudyResults, evidence: Evidence, look: Standing
) -> EnvironmentAnalysis:
    study, table, environment = results.study, results.summary, evidence.environment
    table = table[table["environment"] == environment]
    sign = -1.0 if study.metric in COSTS else 1.0
    agents = [_analyse_agent(results, environment, *each) for each in evidence.seeds.items()]
    missing = {agent.agent: agent.n_missing for agent in agents}
    agents = [agent for agent in agents if agent.n_runs]
    agents.sort(key=lambda agent: _rank(sign * agent.metric.mean.point), reverse=True)
    names = [agent.agent for agent in agents]
    scores = {name: evidence.scores[name] for name in names}
    failed = failures(study.metric, scores, evidence.baseline, look.level, evidence.certain)
    fewest = evidence.fewest(look.level)
    return EnvironmentAnalysis(
        environment=environment,
        env_id=str(table["env_id"].iloc[0]),
        optimum=evidence.optimum,
        baseline=evidence.baseline,
        threshold=evidence.threshold,
        margin=evidence.margin,
        exact=bool((table["exact"] == True).all()),  # noqa: E712  # None is no False here
        agents=tuple(agents),
        pairs=tuple(_pairs(evidence, names, look)),
        missing=missing,
        fewest=fewest,
        failures=failed,
        unreliable=tuple(fail_more_often(_enough(failed, fewest), look.level)),
        speeds=speeds(results, environment, names, look.level),
        seeds=evidence.seeds,
        look=look,
        optimum_at_least=evidence.optimum_at_least,
        optima=_differing_optima(table),
    )


def _differing_optima(table: pd.DataFrame) -> dict[str, float]:
    """By agent, the optimum on the first seed, of which maps and arms may depend."""
    known = table[table["seed"] == table["seed"].min()].dropna(subset=["optimum"])
    optima = {str(row["agent"]): float(row["optimum"]) for _, row in known.iterrows()}
    alike = len(optima) < 2 or np.allclose([*optima.values()], next(iter(optima.values())))
    return {} if alike else optima


def _pairs(evidence: Evidence, names: Sequence[str], look: Standing) -> list[PairComparison]:
    """Every two agents, as judged at this look, or at that of a design which decided them."""
    scores = {name: evidence.scores[name] for name in names}
    margin, certain = evidence.margin, evidence.certain
    if look.design is None:
        judged = {
            pair: (judgement, len(scores[pair[0]]))
            for pair, judgement in judge_pairs(scores, margin, look.level, certain).items()
        }
    else:
        given = {name: evidence.given[name] for name in names}
        growth = grow(given, look.design.sizes, margin, look.design.level, certain)
        judged = {
            pair: (judgement, look.design.sizes[growth.looks[pair] - 1])
            for pair, judgement in growth.judged.items()
        }
    levels = (look.level, look.next_level)
    return describe_pairs(judged, scores, margin, levels, seed=RESAMPLING_SEED)


def _enough(counts: Mapping[str, FailureCount], fewest: int) -> dict[str, FailureCount]:
    """Those of agents with so many runs; with fewer, nothing is claimed of anybody."""
    return {name: count for name, count in counts.items() if count.n >= fewest}


def _rank(value: float) -> float:
    return -np.inf if np.isnan(value) else value


def _analyse_agent(
    results: StudyResults, environment: str, agent: str, n_seeds: int
) -> AgentAnalysis:
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
        n_missing=n_seeds - len(table),
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
        episodes_to_stay=summarise_steps(values("episodes_to_stay")) if has_threshold else None,
        success_rate=mean("success_rate") if table["success_rate"].notna().any() else None,
        seconds=mean("cpu_seconds"),
        on_variant=any(
            trains_on_variant(run.spec)
            for run in results.planned
            if (run.agent, run.environment, run.seed) == (agent, environment, study.first_seed)
        ),
        changes=_recorded_changes(results, agent, environment),
    )


def _recorded_changes(results: StudyResults, agent: str, environment: str) -> tuple[str, ...]:
    """By the first of its runs: its seeds share their settings."""
    of_agent = (r for r in results.finished if (r.agent, r.environment) == (agent, environment))
    run = next(of_agent, None)
    return () if run is None else training_changes(TrainSpec.of_data(run.run.read_info()["spec"]))
