"""Analyses the runs of a study: estimates with intervals, verdicts on pairs, ranks.

Besides typical scores it reports failed runs, the time to the threshold, and what the agents of
failed runs do instead of their task.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
import pandas as pd

from agents import ALGORITHMS
from experiments.child_processes import do_aside
from experiments.looks import Standing
from experiments.plan import PlannedRun
from experiments.results import (
    RESAMPLING_SEED,
    StudyResults,
    stored_curves,
    values_over_seeds,
)
from experiments.study import COSTS, StudySpec
from mdp.transition_model import Floats
from pipeline.environments import training_changes, trains_on_variant
from pipeline.errors import UserError
from pipeline.evaluation.yardstick import FAILED, NEARLY_ALL, Yardstick
from pipeline.signs_of_life import Tell, tell_nobody
from pipeline.train_spec import TrainSpec
from verdicts import (
    FEWEST_SEEDS,
    Band,
    Ends,
    Estimate,
    FailureCount,
    MeanVerdict,
    PairComparison,
    SpeedComparison,
    Summary,
    ThresholdSummary,
    compare_speed,
    count_failures,
    describe_pairs,
    estimate,
    fail_more_often,
    failure_threshold,
    fewest_seeds,
    grow,
    judge_pairs,
    level_of_claim,
    level_of_environment,
    mean_interval,
    performance_profile,
    probability_of_improvement,
    summarise,
    summarise_steps,
)

# The metrics on the scale of the best random or constant policy.
ON_THE_SCALE = ("final", "best")

# Prefixes of the entry points of agents that do not learn.
FIXED_POLICIES = ("agents.planning:", "agents.reference:")


def agents_without_chance(results: StudyResults, table: pd.DataFrame) -> frozenset[str]:
    """The agents that do not learn, if policies are evaluated exactly: all their runs are equal."""
    if not (table["exact"] == True).all():  # noqa: E712  # None is neither True nor False
        return frozenset()
    return frozenset(
        agent.label
        for agent in results.study.agents
        if agent.algo in ALGORITHMS
        and ALGORITHMS[agent.algo].entry_point.startswith(FIXED_POLICIES)
    )


def failures(
    metric: str,
    scores: Mapping[str, Floats],
    baseline: float | None,
    level: float,
    certain: Collection[str],
) -> dict[str, FailureCount]:
    """Count the failed runs of each agent that depends on chance.

    A run fails if its score is less than half as far above the baseline as the best agent's median.
    The bounds of all agents hold simultaneously. Empty if the metric has no known baseline.
    """
    by_chance = {name: values for name, values in scores.items() if name not in certain}
    if metric not in ON_THE_SCALE or baseline is None or not by_chance:
        return {}
    known = [values[np.isfinite(values)] for values in scores.values()]
    typical = max((float(np.median(values)) for values in known if len(values)), default=np.nan)
    threshold = failure_threshold(baseline, typical)
    if np.isnan(threshold):
        return {}
    return {
        name: count_failures(values, threshold, level_of_claim(level, "failures") / len(by_chance))
        for name, values in by_chance.items()
    }


def speeds(
    results: StudyResults, environment: str, agents: Sequence[str], level: float
) -> tuple[SpeedComparison, ...]:
    """Compare how soon the agents reach the threshold and stay above it."""
    curves = results.curves
    chosen = (curves["environment"] == environment) & (curves["kind"] == "evaluation")
    spans = [
        np.diff(rows["step"].to_numpy(dtype=np.float64), prepend=0.0).max()
        for _, rows in curves[chosen & curves["agent"].isin(agents)].groupby(["agent", "seed"])
    ]
    spans += [
        np.diff(rows["step"], prepend=0.0).max(initial=0.0)
        for agent in agents
        for rows in stored_curves(results, environment, agent, "evaluation")
    ]
    spacing = max(spans, default=0.0)
    if not spacing > 0:
        return ()
    steps = values_over_seeds(results, environment, "steps_to_stay")
    return tuple(compare_speed({name: steps[name] for name in agents}, spacing, level))


# --- The evidence for verdicts on an environment.

UNIT = Ends(0.0, 1.0)  # of scores
MARGIN = 0.02  # of the gap between the best random or constant policy and the optimum


@dataclass(frozen=True)
class Evidence:
    """The evidence for verdicts on an environment."""

    environment: str  #: its label
    #: By agent, higher is better, shape (n_seeds,): NaN for a missing run.
    scores: Mapping[str, Floats]
    seeds: Mapping[str, int]  #: by agent, the planned number of seeds
    #: The highest expected return of any policy, or an upper bound of it; None if unknown.
    optimum: float | None
    optimum_at_least: float | None  #: a lower bound of the optimum; None if it is exact or unknown
    baseline: float | None  #: expected return of the best random or constant policy, or None
    threshold: float | None  #: the return that counts as solved, or None
    margin: float  #: the difference within which agents count as equivalent
    certain: frozenset[str]  #: the agents that do not depend on chance
    #: The range in which means are judged: from the baseline to the optimum, if the metric is on
    #: this scale and both are known; else a range that contains all runs.
    ends: Ends
    is_score: bool  #: whether these ends define the score
    paired: bool  #: whether runs of one seed share their randomness
    n_environments: int  #: number of environments of the study, which share its error rate
    against: str = ""  #: the only agent to compare the others with; empty for all pairs

    def share(self, level: float) -> float:
        """This environment's share of a look's error rate."""
        return level_of_environment(level, self.n_environments)

    @property
    def given(self) -> dict[str, Floats]:
        """The scores by agent, one for each of its seeds."""
        return {name: values[: self.seeds[name]] for name, values in self.scores.items()}

    def fewest(self, level: float) -> int:
        """The smallest number of seeds that can decide any pair at a look of this level."""
        there = sum(bool(np.isfinite(values).any()) for values in self.scores.values())
        return fewest_seeds(self.share(level), 2 if there > 2 else 1)


def evidence_on(results: StudyResults, environment: str) -> Evidence | None:
    """Collect the evidence on an environment; None if no run has finished."""
    study, table = results.study, results.summary
    table = table[table["environment"] == environment]
    if table.empty:
        return None
    sign = -1.0 if study.metric in COSTS else 1.0
    values = values_over_seeds(results, environment, study.metric)
    optimum, baseline = _first(table, "optimum"), _first(table, "baseline")
    at_least = _first(table, "optimum_at_least")
    reachable = optimum if at_least is None else at_least
    span = 0.0 if reachable is None or baseline is None else reachable - baseline
    scores = {name: sign * each for name, each in values.items()}
    ends, is_score = Ends.beyond(scores), False
    if study.metric in ON_THE_SCALE and optimum is not None and baseline is not None:
        is_score = Yardstick(optimum, baseline).has_scale
        ends = Ends(baseline, optimum) if is_score else ends
    return Evidence(
        environment=environment,
        scores=scores,
        seeds=_seeds(results, environment),
        optimum=optimum,
        optimum_at_least=at_least,
        baseline=baseline,
        threshold=_first(table, "threshold"),
        margin=MARGIN * span if study.margin is None else study.margin,
        certain=agents_without_chance(results, table),
        ends=ends,
        is_score=is_score,
        paired=study.shared_randomness,
        n_environments=len(study.environments),
        against=study.against,
    )


def _seeds(results: StudyResults, environment: str) -> dict[str, int]:
    counts = dict.fromkeys((agent.label for agent in results.study.agents), 0)
    for run in results.planned:
        if run.environment == environment:
            counts[run.agent] += run.n_runs
    return counts


def _first(table: pd.DataFrame, column: str) -> float | None:
    known = table[column].dropna()
    return None if known.empty else float(known.iloc[0])


def bounded_mean(values: Floats, ends: Ends, *, exact: bool = False) -> Estimate:
    """The mean of scores or returns, with an interval valid for every distribution in a range.

    There is no interval if a run lies outside the range, because then the range is wrong.
    """
    known = values[np.isfinite(values)]
    n_missing = len(values) - len(known)
    if not len(known):
        return Estimate(np.nan, np.nan, np.nan, 0, n_missing)
    mean = float(known.mean())
    if exact:
        return Estimate(mean, mean, mean, len(known), n_missing)
    slack = 1e-9 * (ends.high - ends.low)
    is_within = ends.low - slack <= known.min() and known.max() <= ends.high + slack
    if not is_within or len(known) == 1:
        return Estimate(mean, np.nan, np.nan, len(known), n_missing)
    low, high = mean_interval(ends.shares(known), 0.05)
    low, high = (ends.low + share * (ends.high - ends.low) for share in (low, high))
    return Estimate(mean, min(low, mean), max(high, mean), len(known), n_missing)


# --- All environments together.


@dataclass(frozen=True)
class OverallAnalysis:
    """The comparison of agents over all environments, by their scores."""

    scores: Mapping[str, Summary]  #: estimates by agent, the best first
    #: By the labels of two agents, the probability that the first scores higher.
    improvement: Mapping[tuple[str, str], Estimate]
    #: All pairs, better ranked agent first, by the means of their scores over environments.
    pairs: tuple[PairComparison, ...]
    thresholds: Floats  #: the scores of the profiles, shape (n,)
    profiles: Mapping[str, Band]  #: by agent, the share of runs above each of these scores


def analyse_overall(results: StudyResults, look: Standing | None = None) -> OverallAnalysis | None:
    """Compare the agents over all environments; None for a single one, or without scores.

    Each seed has its mean score over all environments, so that environments have equal weights.
    """
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
    look = look or Standing()
    means = {agent: np.clip(matrix, 0, 1).mean(axis=1) for agent, matrix in scores.items()}
    order = sorted(means, key=lambda agent: float(np.nanmean(means[agent])), reverse=True)
    means = {agent: means[agent] for agent in order}
    levels = [level_of_environment(each, len(labels)) for each in (look.level, look.next_level)]
    ends, paired = UNIT, study.shared_randomness
    judged = judge_pairs(means, MARGIN, levels[0], ends=ends, paired=paired)
    n_seeds = {pair: (each, study.n_seeds) for pair, each in judged.items()}
    pairs = describe_pairs(
        n_seeds,
        means,
        MARGIN,
        (levels[0], levels[1]),
        ends,
        seed=RESAMPLING_SEED,
        paired=paired,
        ranks=len(means) > 2,
    )
    summaries = {
        agent: replace(
            summarise(scores[agent], seed=RESAMPLING_SEED), mean=bounded_mean(means[agent], ends)
        )
        for agent in order
    }
    thresholds = np.linspace(0, 1, 101)
    return OverallAnalysis(
        scores=summaries,
        pairs=tuple(pairs),
        improvement=_improvement({agent: scores[agent] for agent in order}),
        thresholds=thresholds,
        profiles={
            agent: performance_profile(scores[agent], thresholds, seed=RESAMPLING_SEED)
            for agent in order
        },
    )


def _improvement(scores: Mapping[str, Floats]) -> dict[tuple[str, str], Estimate]:
    """The probability that one agent scores higher than another, for both orders of each pair."""
    found = {}
    for one, two in combinations(scores, 2):
        chance = probability_of_improvement(scores[one], scores[two], seed=RESAMPLING_SEED)
        found[one, two] = chance
        found[two, one] = replace(
            chance, point=1 - chance.point, low=1 - chance.high, high=1 - chance.low
        )
    return found


def not_behind(names: Sequence[str], pairs: Sequence[PairComparison]) -> list[str]:
    """The agents to which no other agent is shown to be superior, without a condition.

    Every other agent is shown to be behind some agent.
    """
    behind = {
        p.second if p.verdict == "better" else p.first
        for p in pairs
        if p.verdict in ("better", "worse") and not p.is_conditional
    }
    return [name for name in names if name not in behind]


def shown_best(names: Sequence[str], pairs: Sequence[PairComparison]) -> list[str]:
    """The agent that is shown to be ahead of all others, or several equivalent ones."""
    ahead = not_behind(names, pairs)
    among = [pair for pair in pairs if {pair.first, pair.second} <= set(ahead)]
    are_equal = all(pair.said == MeanVerdict("equivalent") for pair in among)
    return ahead if are_equal and len(names) > 1 else []


# --- Each environment.

# The mark of agents that were trained on a changed environment.
MARK = "†"


@dataclass(frozen=True)
class AgentAnalysis:
    """The results of one agent on one environment."""

    agent: str  #: its label
    algo: str  #: its name in the table of agents
    judged: Estimate  #: its mean, scaled so that the ``ends`` of the environment are 0 and 1
    spread: float  #: standard deviation over runs of these scores; without a scale, of the metric
    n_runs: int  #: finished runs
    n_missing: int  #: unfinished runs
    metric: Summary  #: estimates of the metric of the verdicts, over seeds
    #: Estimates of the final policy's score: 0 is the best random or constant policy, 1 the
    #: optimum; None if these are not known.
    score: Summary | None
    final: Estimate  #: mean return of the final policy
    area: Estimate  #: mean return over the learning curve
    last_episodes: Estimate  #: mean return of the last training episodes
    regret: Estimate  #: on bandits, the sum over all pulls; else NaN
    #: Steps until the learning curve first reached the threshold; None without a threshold.
    steps_to_threshold: ThresholdSummary | None
    episodes_to_stay: ThresholdSummary | None  #: episodes until it reached the threshold for good
    success_rate: Estimate | None  #: of the final policy; None if not reported
    #: Processor time of training; nan for runs of older versions, which did not measure it.
    seconds: Estimate
    #: Whether it was trained on a variant of the environment, whose returns cannot be compared
    #: with those of evaluations or the optimum.
    on_variant: bool = False
    #: Training's changes of the environment in words, as the runs recorded them.
    changes: tuple[str, ...] = ()
    #: Steps until the learning curve reached the threshold for good; None without a threshold.
    steps_to_stay: ThresholdSummary | None = None
    #: Exact return of the policy that acts in training, None if unknown, and its description.
    stochastic: Estimate | None = None
    acts_by: str = ""
    #: Exact discounted return of the final policy, the agent's discount, and the optimum under it.
    discounted: Estimate | None = None
    discount: float | None = None
    discounted_optimum: float | None = None

    @property
    def marked(self) -> str:
        """The label, with a mark if the agent was trained on a changed environment."""
        return f"{self.agent} {MARK}" if self.changes else self.agent


@dataclass(frozen=True)
class EnvironmentAnalysis:
    """The comparison of agents on one environment."""

    environment: str  #: its label
    env_id: str  #: its Gymnasium id
    #: The highest expected return of any policy, or an upper bound of it; None if unknown.
    optimum: float | None
    baseline: float | None  #: expected return of the best random or constant policy, or None
    threshold: float | None  #: the return that counts as solved, or None
    margin: float  #: the difference within which agents count as equivalent
    exact: bool  #: whether all final returns are exact expectations, not means of episodes
    agents: tuple[AgentAnalysis, ...]  #: the agents, the best first
    pairs: tuple[PairComparison, ...]  #: all pairs, better ranked agent first
    #: Missing runs by agent, including agents without a finished run.
    missing: Mapping[str, int] = field(default_factory=dict)
    fewest: int = FEWEST_SEEDS  #: the smallest number of seeds that can decide a pair
    #: Failed runs by agent; empty if failure is not defined here.
    failures: Mapping[str, FailureCount] = field(default_factory=dict)
    #: The pairs in which the first agent is shown to fail more often.
    unreliable: tuple[tuple[str, str], ...] = ()
    #: All pairs, compared by how soon they stay above the threshold.
    speeds: tuple[SpeedComparison, ...] = ()
    #: By agent, its planned number of seeds.
    seeds: Mapping[str, int] = field(default_factory=dict)
    look: Standing = field(default_factory=Standing)  #: the look at these runs
    #: A lower bound of the optimum; None if ``optimum`` is exact or unknown.
    optimum_at_least: float | None = None
    optimum_is_proven: bool = True  #: whether the upper bound is proven
    #: In a partially observable environment, the optimum of agents that see the state; else None.
    full_optimum: float | None = None
    #: There, the input of the policies whose optimum is the scale: ``observation`` or ``memory``.
    measured_by: str | None = None
    #: The optima by agent, if agents play environments with different optima; else empty.
    optima: Mapping[str, float] = field(default_factory=dict)
    advice: tuple[str, ...] = ()  #: sentences on failed runs, see `with_advice`
    ends: Ends = UNIT  #: the range in which means are judged
    is_score: bool = True  #: whether these ends define the score
    is_same: bool = False  #: whether all runs of all agents have the same figure
    #: The agents whose mean final return exceeds the upper bound by more than six standard errors.
    impossible: tuple[str, ...] = ()

    @property
    def best(self) -> list[str]:
        """The agents shown to be best on average, without a condition: one, or several equal."""
        return shown_best([agent.agent for agent in self.agents], self.pairs)


@dataclass(frozen=True)
class StudyAnalysis:
    """The analysis of a study."""

    results: StudyResults  #: the runs
    environments: tuple[EnvironmentAnalysis, ...]  #: by environment
    #: Over all environments; None for a single one, or if a score is not known.
    overall: OverallAnalysis | None

    @property
    def study(self) -> StudySpec:
        """The study's specification."""
        return self.results.study


def analyse(
    results: StudyResults, tell: Tell = tell_nobody, looks: Mapping[str, Standing] | None = None
) -> StudyAnalysis:
    """Analyse the runs of a study.

    Args:
        results: the runs.
        tell: receives the progress.
        looks: by environment, the current look at its runs; by default the first look.
    """
    environments = []
    for environment in results.study.environments:
        tell(environment.label)
        evidence = evidence_on(results, environment.label)
        if evidence is not None:
            look = (looks or {}).get(environment.label, Standing())
            environments.append(_analyse_environment(results, evidence, look))
    tell("all environments")
    overall = analyse_overall(results, _latest((looks or {}).values()))
    return StudyAnalysis(results, tuple(environments), overall)


def _latest(looks: Iterable[Standing]) -> Standing | None:
    """The look with the lowest error rate."""
    return min(looks, key=lambda look: look.level, default=None)


def _analyse_environment(
    results: StudyResults, evidence: Evidence, look: Standing
) -> EnvironmentAnalysis:
    study, table, environment = results.study, results.summary, evidence.environment
    table = table[table["environment"] == environment]
    level = evidence.share(look.level)
    agents = [_analyse_agent(results, evidence, *each) for each in evidence.seeds.items()]
    missing = {agent.agent: agent.n_missing for agent in agents}
    agents = [agent for agent in agents if agent.n_runs]
    last = -np.inf  # agents without a figure
    agents.sort(key=lambda a: last if np.isnan(a.judged.point) else a.judged.point, reverse=True)
    names = [agent.agent for agent in agents]
    scores = {name: evidence.scores[name] for name in names}
    failed = failures(study.metric, scores, evidence.baseline, level, evidence.certain)
    fewest = evidence.fewest(look.level)
    # No claim is made about agents with fewer runs.
    enough = {name: count for name, count in failed.items() if count.n >= fewest}
    return EnvironmentAnalysis(
        environment=environment,
        env_id=str(table["env_id"].iloc[0]),
        optimum=evidence.optimum,
        baseline=evidence.baseline,
        threshold=evidence.threshold,
        margin=evidence.margin,
        exact=bool((table["exact"] == True).all()),  # noqa: E712  # None is neither True nor False
        agents=tuple(agents),
        pairs=tuple(_pairs(evidence, names, look)),
        missing=missing,
        fewest=fewest,
        failures=failed,
        unreliable=tuple(fail_more_often(enough, level_of_claim(level, "fails more"))),
        speeds=speeds(results, environment, names, level_of_claim(level, "sooner")),
        seeds=evidence.seeds,
        look=look,
        optimum_at_least=evidence.optimum_at_least,
        optimum_is_proven=not (table["optimum_is_proven"] == False).any(),  # noqa: E712  # likewise
        full_optimum=_first(table, "full_optimum") if "full_optimum" in table else None,
        measured_by=_measured_by(table),
        optima=_differing_optima(table),
        ends=evidence.ends,
        is_score=evidence.is_score,
        is_same=_are_alike(scores),
        impossible=_impossible(evidence, table),
    )


def _measured_by(table: pd.DataFrame) -> str | None:
    if "measured_by" not in table:
        return None
    found = table["measured_by"].dropna()
    return str(found.iloc[0]) if len(found) else None


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


def _are_alike(scores: Mapping[str, Floats]) -> bool:
    """Whether two or more agents have runs, and all runs have the same figure."""
    values = [each[np.isfinite(each)] for each in scores.values()]
    if len(values) < 2 or min(map(len, values)) == 0:
        return False
    together = np.concatenate(values)
    return bool(np.ptp(together) <= 1e-9 * abs(together[0]))


def _differing_optima(table: pd.DataFrame) -> dict[str, float]:
    """By agent, the optimum on the first seed, as maps and arms may depend on the seed."""
    known = table[table["seed"] == table["seed"].min()].dropna(subset=["optimum"])
    optima = {str(row["agent"]): float(row["optimum"]) for _, row in known.iterrows()}
    alike = len(optima) < 2 or np.allclose([*optima.values()], next(iter(optima.values())))
    return {} if alike else optima


def _pairs(evidence: Evidence, names: Sequence[str], look: Standing) -> list[PairComparison]:
    """All pairs, judged at this look, or at the look of a design that decided them."""
    scores = {name: evidence.scores[name] for name in names}
    margin, certain = evidence.margin, evidence.certain
    ends, paired, against = evidence.ends, evidence.paired, evidence.against
    if look.design is None:
        level = evidence.share(look.level)
        judged = {
            pair: (judgement, len(scores[pair[0]]))
            for pair, judgement in judge_pairs(
                scores, margin, level, certain, ends=ends, paired=paired, against=against
            ).items()
        }
    else:
        given = {name: evidence.given[name] for name in names}
        level = evidence.share(look.design.level)
        sizes = look.design.sizes
        growth = grow(
            given, sizes, margin, level, certain, ends=ends, paired=paired, against=against
        )
        judged = {
            pair: (judgement, sizes[growth.looks[pair] - 1])
            for pair, judgement in growth.judged.items()
        }
    levels = (evidence.share(look.level), evidence.share(look.next_level))
    return describe_pairs(
        judged,
        scores,
        margin,
        levels,
        ends,
        seed=RESAMPLING_SEED,
        paired=paired,
        ranks=look.design is None and len(scores) > 2 and not against,
        against=against,
        certain=certain,
    )


def _analyse_agent(
    results: StudyResults, evidence: Evidence, agent: str, n_seeds: int
) -> AgentAnalysis:
    study, table, environment = results.study, results.summary, evidence.environment
    table = table[(table["environment"] == environment) & (table["agent"] == agent)]

    def values(column: str) -> Floats:
        column_of = table.set_index("seed")[column].reindex(study.seeds)
        return column_of.to_numpy(dtype=np.float64, na_value=np.nan)

    def mean(column: str) -> Estimate:
        return estimate(values(column), "mean", seed=RESAMPLING_SEED)

    has_threshold = bool(table["threshold"].notna().any())
    exact, sign = agent in evidence.certain, -1.0 if study.metric in COSTS else 1.0
    metric = summarise(values(study.metric), seed=RESAMPLING_SEED)
    mean_of_scores = bounded_mean(evidence.scores[agent], evidence.ends, exact=exact)
    judged = evidence.ends.shares(evidence.scores[agent])
    of_runs = judged if evidence.is_score else values(study.metric)
    of_runs = of_runs[np.isfinite(of_runs)]
    ends = [sign * mean_of_scores.low, sign * mean_of_scores.high]
    metric = replace(metric, mean=replace(metric.mean, low=min(ends), high=max(ends)))
    score = None
    optimum, baseline = evidence.optimum, evidence.baseline
    if optimum is not None and baseline is not None and Yardstick(optimum, baseline).has_scale:
        clipped = bounded_mean(np.clip(values("score"), 0, 1), UNIT, exact=exact)
        score = replace(summarise(values("score"), seed=RESAMPLING_SEED), mean=clipped)
    return AgentAnalysis(
        agent=agent,
        algo=next(spec.algo for spec in study.agents if spec.label == agent),
        judged=bounded_mean(judged, UNIT, exact=exact),
        spread=float(of_runs.std(ddof=1)) if len(of_runs) > 1 else 0.0,
        n_runs=len(table),
        n_missing=n_seeds - len(table),
        metric=metric,
        score=score,
        final=metric.mean if study.metric == "final" else mean("final"),
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
        stochastic=mean("stochastic_return") if table["stochastic_return"].notna().any() else None,
        acts_by=_only(table["acts_by"]),
        discounted=mean("discounted_return") if table["discounted_return"].notna().any() else None,
        discount=_first(table, "discount"),
        discounted_optimum=_first(table, "discounted_optimum"),
    )


def _only(texts: pd.Series) -> str:
    """The text that is the same in all runs; empty if it differs."""
    found = texts.dropna().unique()
    return str(found[0]) if len(found) == 1 else ""


def _recorded_changes(results: StudyResults, agent: str, environment: str) -> tuple[str, ...]:
    """The recorded changes of the agent's first run, because all seeds share the settings."""
    run = next((r for r in results.finished if r.labels == (agent, environment)), None)
    if run is None:
        return ()
    info = results.stored[run.labels].infos()[0] if results.is_stored(run) else run.run.read_info()
    return training_changes(TrainSpec.of_data(info["spec"]))


def runs_to_keep(results: StudyResults) -> list[PlannedRun]:
    """The stored runs whose agents are kept: the best, median and worst, and those for the page.

    The page plays the first run, splits the gap of the median final return, and asks the first
    failed run for advice.
    """
    study, table = results.study, results.summary
    runs = {(*run.labels, run.seed): run for run in results.finished if results.is_stored(run)}
    kept = {(*labels, study.first_seed) for labels in results.stored}
    for environment in study.environments:
        kept |= {
            (*run.labels, run.seed)
            for several, _ in _failed_runs(results, environment.label)
            for run in several[:1]
        }
    for labels, rows in table.groupby(["agent", "environment"], sort=False):
        for column in (study.metric, "final"):
            order = rows[["seed", column]].dropna().sort_values(column, kind="stable")["seed"]
            places = {0, (len(order) - 1) // 2, len(order) - 1} if len(order) else ()
            kept |= {(*map(str, labels), int(order.iloc[place])) for place in places}  # type: ignore[misc]
    return [run for key, run in runs.items() if key in kept]


# --- Advice on failed runs, once for each agent.

# The largest number of agents per environment with advice, because each agent is loaded.
MOST_TOLD = 4


def with_advice(analysis: StudyAnalysis) -> StudyAnalysis:
    """The analysis with sentences on failed runs, if there is advice."""
    failed = [_failed_runs(analysis.results, one.environment) for one in analysis.environments]
    asked = [runs[0] for several in failed for runs, _ in several[:MOST_TOLD]]
    answers = iter(do_aside(advice_on, asked) if asked else ())
    environments = []
    for one, several in zip(analysis.environments, failed, strict=True):
        advice = []
        for runs, n_runs in several[:MOST_TOLD]:
            first, answer = runs[0], next(answers)
            if answer is not None:
                of = f"{len(runs)} of {n_runs} runs" if n_runs > 1 else "its run"
                seed = f"; seed {first.seed}" if len(runs) > 1 else ""
                instead, try_first = answer
                then = f"; try first: {try_first}" if try_first else ""
                told = f"{first.agent} did not learn the task in {of}{seed}"
                advice.append(f"{told}: {instead}{then}.")
        if more := several[MOST_TOLD:]:
            names = ", ".join(f"{runs[0].agent} ({len(runs)} of {n})" for runs, n in more)
            advice.append(f"Runs of {len(more)} more agents did not learn the task: {names}.")
        environments.append(replace(one, advice=tuple(advice)))
    return replace(analysis, environments=tuple(environments))


def _failed_runs(results: StudyResults, environment: str) -> list[tuple[list[PlannedRun], int]]:
    """For each agent with failed runs: these runs by seed, and its number of runs."""
    table = results.summary[results.summary["environment"] == environment]
    runs = {
        (run.agent, run.seed): run for run in results.finished if run.environment == environment
    }
    found = []
    for agent, rows in table.groupby("agent", sort=False):
        has_failed = rows["score"].astype(float) < FAILED
        # A policy that does not always succeed may never end an episode; the advice checks this.
        has_failed |= rows["success_rate"].astype(float) < 1 - NEARLY_ALL
        seeds = rows[has_failed & rows["exact"].astype(bool)]["seed"]
        if len(seeds):
            found.append(([runs[str(agent), int(seed)] for seed in sorted(seeds)], len(rows)))
    return found


def advice_on(runs: Sequence[PlannedRun]) -> list[tuple[str, str | None] | None]:
    """The advice on the agent of each run; None for a run without advice."""
    return [_advice_on(run) for run in runs]


def _advice_on(planned: PlannedRun) -> tuple[str, str | None] | None:
    from pipeline.evaluation.advice import advice
    from pipeline.evaluation.exact import evaluator_of
    from pipeline.models.load import load_model

    run, spec = planned.run, planned.spec
    with suppress(UserError, OSError):
        evaluator = evaluator_of(spec)
        if evaluator is None:
            return None
        agent = load_model(spec.algo, run.model_path, modules=spec.user_modules, device="cpu")
        if evaluator.obstacle(agent):
            return None
        n_steps = int(run.read_info()["n_timesteps"])
        found = advice(spec, agent, evaluator, evaluator(agent), n_steps)
        return None if found is None else (found.instead, found.try_first)
    return None
