"""The conclusions of a study as sentences: who is best, pair by pair, and how soon."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from experiments.analysis import (
    MARGIN,
    MARK,
    ON_THE_SCALE,
    AgentAnalysis,
    EnvironmentAnalysis,
    OverallAnalysis,
    StudyAnalysis,
    not_behind,
    shown_best,
)
from experiments.study import COSTS, METRIC_WORDS, OF_TRAINING, StudySpec
from report.words import (
    enumeration,
    interval,
    number,
    optimum_words,
    ordinal,
    scale_words,
    score_with_interval,
    seeds,
)
from verdicts import PairComparison

# Sentences on pairs of agents: verdicts, and who fails more often.


def pairs_both_ways(environment: EnvironmentAnalysis) -> dict[tuple[str, str], PairComparison]:
    """Every pair in both orders, by first and second agent."""
    seen = [one for pair in environment.pairs for one in (pair, pair.swapped())]
    return {(one.first, one.second): one for one in seen}


def oriented_pairs(environment: EnvironmentAnalysis) -> list[PairComparison]:
    """The pairs, each with the better agent first if one is better."""
    return [pair.swapped() if pair.verdict == "worse" else pair for pair in environment.pairs]


def pair_sentences(study: StudySpec, environment: EnvironmentAnalysis) -> list[str]:
    """The verdicts on means, one sentence for each first agent and verdict.

    Then the verdicts on medians (typical runs) that differ from those on means.
    """
    too_few = study.n_seeds < environment.fewest
    equal = [
        group for group in _equivalent_groups(environment) if group != _equal_best(environment)
    ]
    texts = [f"{_on_equivalent(environment, group)}." for group in equal]
    oriented = oriented_pairs(environment)
    for name in (agent.agent for agent in environment.agents):
        pairs = [pair for pair in oriented if pair.first == name]
        ahead = [pair for pair in pairs if pair.verdict == "better"]
        better = [_lead_of(environment, p) for p in ahead if not p.is_conditional]
        seen = [_lead_of(environment, p) for p in ahead if p.is_conditional]
        open_ = [_how_open(environment, pair) for pair in pairs if pair.verdict == "undecided"]
        if better:
            texts.append(f"{name} is better on average than {enumeration(better)}.")
        if seen:
            conditional = [p for p in ahead if p.is_conditional]
            condition = _condition(environment, conditional)
            texts.append(f"{name} is ahead on average of {enumeration(seen)}, {condition}.")
        if open_ and not too_few and not environment.is_same:
            texts.append(f"{name} is undecided on average against {enumeration(open_)}.")
    if too_few and texts and any(pair.verdict == "undecided" for pair in oriented):
        n = seeds_of(study, environment)
        texts.append(
            f"All other pairs are undecided: {n} are too few, whatever they score; it takes "
            f"{environment.fewest} or more."
        )
    return [*texts, *_on_typical_runs(environment)]


def _equal_best(environment: EnvironmentAnalysis) -> list[str]:
    """The two or more agents that share the first place as equivalent; empty if there are none."""
    ahead = not_behind([agent.agent for agent in environment.agents], environment.pairs)
    pairs = [p for p in environment.pairs if {p.first, p.second} <= set(ahead)]
    are_equal = all(pair.verdict == "equivalent" for pair in pairs)
    return ahead if pairs and are_equal else []


def seeds_of(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    """The planned numbers of seeds of the agents, in words."""
    return seeds(*(environment.seeds.values() or [study.n_seeds]))


def _on_equivalent(environment: EnvironmentAnalysis, group: Sequence[str]) -> str:
    """Which agents are equivalent, within what margin, and what unseen runs may change."""
    within = _within(environment)
    pairs = [p for p in environment.pairs if p.first in group and p.second in group]
    if all(pair.certain for pair in pairs):
        return f"{enumeration(group)} are equivalent{within}"
    shown_with = _shown_with(environment, pairs)
    if not any(pair.is_conditional for pair in pairs):
        return f"{enumeration(group)} are equivalent on average{within}{shown_with}"
    runs = f"the runs of {enumeration(group)} that were seen are equal on average{within}"
    text = f"{runs[0].upper()}{runs[1:]}{shown_with}; {_unseen(environment, pairs)}"
    failed = failed_runs(environment, group)
    return f"{text}; {failed}" if failed else text


def _within(environment: EnvironmentAnalysis) -> str:
    """The margin of equivalence in words, in scores or else in the unit of the figures."""
    margin, ends = environment.margin, environment.ends
    if environment.is_score:
        margin /= ends.high - ends.low
    return f" within {number(margin)}" if margin > 0 else ""


def _unseen(environment: EnvironmentAnalysis, pairs: Sequence[PairComparison]) -> str:
    """The upper 95 % confidence bound on the share of further runs unlike all runs so far."""
    names = {name for pair in pairs for name in (pair.first, pair.second)}
    n_runs = [agent.n_runs for agent in environment.agents if agent.agent in names]
    n = min([*n_runs, *(pair.n_seeds for pair in pairs)])
    return f"after {n:,} runs, up to {1 - 0.05 ** (1 / n):.0%} of further ones may be different"


def _equivalent_groups(environment: EnvironmentAnalysis) -> list[list[str]]:
    """Groups of agents in which every two are equivalent; each equivalent pair is in a group.

    Conditional and unconditional verdicts form separate groups.
    """
    names = [agent.agent for agent in environment.agents]
    pairs = pairs_both_ways(environment)
    groups: list[list[str]] = []
    for is_conditional in (False, True):
        equal = [
            both
            for both, pair in pairs.items()
            if pair.verdict == "equivalent" and pair.is_conditional == is_conditional
        ]
        found: list[list[str]] = []
        for pair in equal:
            if not any(set(pair) <= set(group) for group in found):
                group = list(pair)
                for name in names:
                    if all((name, member) in equal for member in group):
                        group.append(name)
                found.append(sorted(group, key=names.index))
        groups += found
    return groups


def amounts(environment: EnvironmentAnalysis, *shares: float) -> list[float]:
    """Shares of the scale, converted to scores or else to the unit of the figures."""
    span = 1.0 if environment.is_score else environment.ends.high - environment.ends.low
    return [share * span for share in shares]


def _lead_of(environment: EnvironmentAnalysis, pair: PairComparison) -> str:
    """The agent behind, by how much, and failed runs, unless most runs of their agent failed."""
    counts = {name: environment.failures.get(name) for name in (pair.first, pair.second)}
    few = [name for name, count in counts.items() if count and 2 * count.n_failed <= count.n]
    failed = failed_runs(environment, few)
    mean = pair.mean
    ends = (mean.seen_low, mean.seen_high) if pair.is_conditional else (mean.low, mean.high)
    low, high = amounts(environment, *ends)
    unit = " of the score" if environment.is_score else ""
    by = f"by {number(low)} to {number(high)}{unit}{_shown_with(environment, [pair])}"
    return f"{pair.second} ({by}{f'; {failed}' if failed else ''})"


def _condition(environment: EnvironmentAnalysis, pairs: Sequence[PairComparison]) -> str:
    """The condition on further runs under which the leads hold."""
    most = min(pair.mean.most_outside for pair in pairs)
    return (
        f"as long as fewer than {100 * most:.2g} % of further runs lie outside of those that were "
        f"seen; {_unseen(environment, pairs)}"
    )


def _on_typical_runs(environment: EnvironmentAnalysis) -> Iterable[str]:
    """The verdicts on medians that differ from those on means."""
    medians = {agent.agent: agent.metric.median.point for agent in environment.agents}
    for pair in environment.pairs:
        if pair.typical in ("undecided", pair.verdict) or pair.certain:
            continue
        seen = pair.swapped() if pair.typical == "worse" else pair
        one, two = number(medians[seen.first]), number(medians[seen.second])
        figures, within = f"{one} and {two}", "" if one == two else " within the margin"
        said = {"better": f"{seen.first} is better than {seen.second}"}.get(
            seen.typical, f"{seen.first} and {seen.second} are equal{within}"
        )
        failed = failed_runs(environment, [seen.first, seen.second])
        yield f"In the typical run, {said} (medians {figures}{f'; {failed}' if failed else ''})."


def _how_open(environment: EnvironmentAnalysis, pair: PairComparison) -> str:
    """The other agent, the difference so far, and how many seeds it would take to decide."""
    low, high = amounts(environment, pair.mean.seen_low, pair.mean.seen_high)
    text = f"difference so far {number(low)} to {number(high)}{_shown_with(environment, [pair])}"
    if pair.seeds_needed is not None:
        text += f"; about {seeds(pair.seeds_needed)} are needed to decide"
    return f"{pair.second} ({text})"


def _shown_with(environment: EnvironmentAnalysis, pairs: Sequence[PairComparison]) -> str:
    """The number of seeds behind the pairs, in a study that adds seeds until they are decided."""
    if environment.look.design is None:
        return ""
    return f", with {seeds(*(pair.n_seeds for pair in pairs))}"


def failed_runs(environment: EnvironmentAnalysis, names: Sequence[str]) -> str:
    """How many runs of each agent failed; empty if none did."""
    counts = {name: environment.failures.get(name) for name in names}
    return enumeration(
        [
            f"{count.n_failed} of {count.n} runs of {name} failed"
            for name, count in counts.items()
            if count is not None and count.n_failed
        ]
    )


def on_unreliable(environment: EnvironmentAnalysis) -> Iterable[str]:
    """Which agent fails more often than another, unless its mean is shown to be worse, too."""
    worse = {
        (p.second, p.first)
        for p in oriented_pairs(environment)
        if p.verdict == "better" and not p.is_conditional
    }
    for names in environment.unreliable:
        if names not in worse:
            more, less = (environment.failures[name] for name in names)
            yield (
                f"{names[0]} fails more often than {names[1]} ({more.n_failed} of {more.n} runs "
                f"against {less.n_failed} of {less.n})."
            )


# Sentences on how soon agents stay above the threshold.


def speed_sentences(environment: EnvironmentAnalysis) -> Iterable[str]:
    """How many runs reach the threshold and stay there, from which step, and who is sooner."""
    told = [
        (agent.agent, agent.steps_to_stay.share_reached, agent.steps_to_stay.median.point)
        for agent in environment.agents
        if agent.steps_to_stay is not None and agent.steps_to_stay.share_reached.n
    ]
    arrived = sorted((one for one in told if one[1].point > 0), key=lambda one: one[2])
    if len(told) < 2 or not arrived:
        return
    parts: list[str] = []
    for name, share, steps in arrived:
        goal = "" if parts else f"reaches {_goal(environment)} and keeps it to the end "
        parts.append(f"{name} {goal}in {round(share.point * share.n)} of {share.n} runs")
        if not math.isinf(steps):
            parts[-1] += f", the median one from step {steps:,.0f} on"
    never = [name for name, share, _ in told if share.point == 0]
    if never:
        parts.append(f"{enumeration(never)} in none")
    yield f"{'; '.join(parts)}."
    yield from _on_ratios(environment, arrived[0][0])


def _on_ratios(environment: EnvironmentAnalysis, fastest: str) -> Iterable[str]:
    """By what factor agents need more steps than the fastest, if that is shown."""
    slower = []
    for pair in environment.speeds:
        if pair.sooner != fastest:
            continue
        forward = pair.first == fastest
        low, high = pair.ratio.low, pair.ratio.high
        if not forward:
            low, high = (math.inf if ratio == 0 else 1 / ratio for ratio in (high, low))
        name = pair.second if forward else pair.first
        most = f"at least {number(low)}" if math.isinf(high) else f"{number(low)} to {number(high)}"
        slower.append(f"{name} needs {most} times as many")
    if slower:
        yield f"{fastest} arrives in fewer steps: {enumeration(slower)}."


def _goal(environment: EnvironmentAnalysis) -> str:
    threshold, optimum, baseline = environment.threshold, environment.optimum, environment.baseline
    if threshold is not None and optimum is not None and baseline is not None:
        share = (threshold - baseline) / (optimum - baseline) if optimum > baseline else 0.0
        if math.isclose(share, 0.95):
            return "a score of 0.95"
    return f"a return of {number(threshold)}"


# The conclusion on an environment: the lead (a line on who is best), the pairs, and notes.

MOST_FIGURES = 3  # the largest number of agents with figures in the lead


@dataclass(frozen=True)
class Conclusion:
    """The sentences on an environment."""

    lead: str  # who is best, and how far below the optimum
    pairs: tuple[str, ...]  # every verdict, with figures; several in a sentence
    failed: str  # whose runs failed, to show beside the matrix of verdicts; may be empty
    # Failures, how soon agents arrive, training on variants, missing runs, what failed agents
    # do instead, and the number of looks.
    notes: tuple[str, ...]

    @property
    def everything(self) -> tuple[str, ...]:
        """All sentences; those on pairs say who failed."""
        return (self.lead, *self.pairs, *self.notes)


def conclusion(study: StudySpec, environment: EnvironmentAnalysis) -> Conclusion:
    """What a study has shown on one environment."""
    failed = failed_runs(environment, [agent.agent for agent in environment.agents])
    return Conclusion(
        lead=" ".join(_lead(study, environment)),
        pairs=tuple(pair_sentences(study, environment)),
        failed=f"{failed}." if failed else "",
        notes=(
            *_on_other_tasks(environment),
            *_on_the_hidden(environment),
            *on_unreliable(environment),
            *speed_sentences(environment),
            *_on_the_impossible(environment),
            *_on_variants(study, environment),
            *on_changes([environment]),
            *_on_missing(study, environment),
            *environment.advice,
            *_on_looks(environment),
        ),
    )


def overall_sentences(analysis: StudyAnalysis) -> list[str]:
    """Who is best over all environments, as far as the verdicts say; nothing for a single one."""
    overall = analysis.overall
    if overall is None or len(overall.scores) < 2:
        return []
    return [_best_over_all(analysis, overall), *unproven_sentences(analysis.environments)]


def _best_over_all(analysis: StudyAnalysis, overall: OverallAnalysis) -> str:
    names = list(overall.scores)
    n = len(analysis.environments)
    where = "Over both environments" if n == 2 else f"Over all {n} environments"
    told = {
        name: f"{name} (score {score_with_interval(overall.scores[name].mean)})" for name in names
    }
    best = shown_best(names, overall.pairs)
    if len(best) == 1:
        return f"{where}, {told[best[0]]} is best on average."
    if best:
        equal = enumeration([told[name] for name in best])
        return f"{where}, {equal} are best on average, and equal within {number(MARGIN)}."
    pairs = [pair.swapped() if pair.verdict == "worse" else pair for pair in overall.pairs]
    ahead = not_behind(names, overall.pairs)
    last = [told[name] for name in ahead[:MOST_FIGURES]]
    more = f" or one of {len(ahead) - MOST_FIGURES} more" if len(ahead) > MOST_FIGURES else ""
    text = f"{where}, it is undecided who is best on average: {enumeration(last)}{more}."
    led = [p for p in pairs if p.first == names[0] and p.verdict == "better" and p.second in ahead]
    if led and len(led) == len(ahead) - 1:
        by = [
            f"{p.second} (by {number(p.mean.seen_low)} to {number(p.mean.seen_high)})" for p in led
        ]
        share = 100 * min(p.mean.most_outside for p in led)
        text += (
            f" {names[0]} is ahead of {enumeration(by)}, as long as fewer than {share:.2g} % of "
            "further seeds have a mean outside of those that were seen."
        )
    return text


def unproven_sentences(environments: Sequence[EnvironmentAnalysis]) -> list[str]:
    """On which environments a score may be too high, because no proof bounds the optimum."""
    names = [one.environment for one in environments if not one.optimum_is_proven]
    if not names:
        return []
    told = f"On {enumeration(names)} the upper end of the optimum's bracket is not proven"
    return [f"{told}: a score there may be too high."]


def places_without_a_run(analysis: StudyAnalysis) -> list[str]:
    """A sentence for each environment on which nothing has finished."""
    there = {environment.environment for environment in analysis.environments}
    absent = [e.label for e in analysis.study.environments if e.label not in there]
    return [f"On {label}, no run has finished." for label in absent]


def _lead(study: StudySpec, environment: EnvironmentAnalysis) -> Iterable[str]:
    top, words = environment.agents[0], METRIC_WORDS[study.metric]
    if math.isnan(top.metric.mean.point):
        yield f"No run has a figure for the {words}."
    elif none_has_learnt(study, environment):
        yield (
            "None of the agents has learnt: no typical run is better than the best random or "
            f"constant policy's {number(environment.baseline)}; the {_extreme(study)} mean {words} "
            f"is {interval(top.metric.mean)}, of {enumeration(_equal_to(top, environment))}."
        )
    else:
        yield from _standing(study, environment)
        yield from _where_the_median_differs(study, environment)


def _standing(study: StudySpec, environment: EnvironmentAnalysis) -> Iterable[str]:
    """Who is best on average, as far as the verdicts say."""
    agents = environment.agents
    names = [agent.agent for agent in agents]
    ahead = not_behind(names, environment.pairs)
    first = [agent for agent in agents if agent.agent in ahead]
    but = _but_failed(environment, ahead)
    if len(names) == 1:
        yield f"{names[0]}: {_figure(study, environment, agents[0])}{but}."
    elif environment.is_same:
        yield _all_alike(study, environment)
    elif study.n_seeds < environment.fewest and _is_open(environment):
        yield _so_far(study, environment)
    elif len(environment.best) == 1:
        yield f"{ahead[0]} is best on average: {_figure(study, environment, first[0])}{but}."
    elif _equal_best(environment):
        figures = _figures(study, environment, first)
        seen = "" if environment.best else "As far as was seen, "
        unseen = "" if environment.best else f"; {_unseen(environment, environment.pairs)}"
        text = f"{seen}{enumeration(ahead)} are best on average, and equal{_within(environment)}"
        yield f"{text}: {figures}{_optimum(study, environment)}{unseen}{but}."
    else:
        if len(ahead) > MOST_FIGURES:
            text = (
                f"the {_extreme(study)} mean so far has {_figures(study, environment, first[:1])}"
            )
            whoever = f"one of {enumeration(ahead)}; {text}"
        else:
            whoever = f"{_figures(study, environment, first, ' or ')}"
        optimum = _optimum(study, environment)
        yield f"Undecided on average: best is {whoever}{optimum}{but}."
        if len(names) > 2:  # of two the sentence on the pair says it
            yield from _leads_so_far(environment, ahead)


def _is_open(environment: EnvironmentAnalysis) -> bool:
    return all(pair.verdict == "undecided" for pair in environment.pairs)


def _leads_so_far(environment: EnvironmentAnalysis, ahead: Sequence[str]) -> Iterable[str]:
    """Which agent leads all others that are not shown to be behind, under a condition."""
    pairs = [p for p in oriented_pairs(environment) if {p.first, p.second} <= set(ahead)]
    for name in ahead:
        led = [p for p in pairs if p.first == name and p.verdict == "better"]
        if len(led) == len(ahead) - 1 and led:
            told = enumeration([_lead_of(environment, pair) for pair in led])
            yield f"{name} is ahead of {told}, {_condition(environment, led)}."


def _all_alike(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    """The sentence for runs that all have the same figure: a fact, no verdict."""
    names = [agent.agent for agent in environment.agents]
    n = min(agent.n_runs for agent in environment.agents)
    who = "Both agents" if len(names) == 2 else f"All {len(names)} agents"
    figure = number(environment.agents[0].metric.mean.point)
    optimum = environment.optimum if study.metric in ON_THE_SCALE else None
    if optimum is not None and math.isclose(
        environment.agents[0].metric.mean.point, optimum, rel_tol=1e-6, abs_tol=1e-6
    ):
        text = f"{who} reach the optimum, {figure}, in all {n:,} runs"
    else:
        text = f"{who} have the same {METRIC_WORDS[study.metric]}, {figure}, in all {n:,} runs"
        text += _optimum(study, environment)
    return f"{text}; {_unseen(environment, environment.pairs)}."


def _so_far(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    """The means so far, where runs are too few for any claim."""
    figures = _figures(study, environment, environment.agents[:MOST_FIGURES])
    needed = [p.seeds_needed for p in environment.pairs if p.seeds_needed is not None]
    n = seeds_of(study, environment)
    decide = f"{n} decide{'s' if n == seeds(1) else ''}"
    text = f"So far: {figures}{_optimum(study, environment)}; {decide}"
    if not needed:
        return f"{text} nothing, {environment.fewest} or more can."
    return f"{text} nothing, about {max(min(needed), environment.fewest)} like these would."


def _figures(
    study: StudySpec,
    environment: EnvironmentAnalysis,
    agents: Sequence[AgentAnalysis],
    last: str = " and ",
) -> str:
    """Each agent with its mean."""
    told = [f"{agent.agent} ({_mean(study, environment, agent)})" for agent in agents]
    return last.join([", ".join(told[:-1]), told[-1]] if len(told) > 1 else told)


def _mean(study: StudySpec, environment: EnvironmentAnalysis, agent: AgentAnalysis) -> str:
    if environment.is_score:
        return f"score {score_with_interval(agent.judged)}"
    return interval(agent.metric.mean)


def _but_failed(environment: EnvironmentAnalysis, names: Sequence[str]) -> str:
    failed = failed_runs(environment, names)
    return f"; {failed}" if failed else ""


def _figure(study: StudySpec, environment: EnvironmentAnalysis, agent: AgentAnalysis) -> str:
    value = agent.metric.mean
    text = f"{METRIC_WORDS[study.metric]} {number(value.point)}"
    if study.metric not in ON_THE_SCALE or environment.optimum is None:
        return f"{METRIC_WORDS[study.metric]} {interval(value)}"
    if math.isclose(value.point, environment.optimum, rel_tol=1e-6, abs_tol=1e-6):
        return f"{text}, the optimum"
    if environment.is_score:
        text += f", {_mean(study, environment, agent)}"
    else:
        text += f", {number(environment.optimum - value.point)} below the optimum"
    return f"{text}{_optimum(study, environment)}"


def _optimum(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    known = study.metric in ON_THE_SCALE and environment.optimum is not None
    ends = environment.optimum, environment.optimum_at_least
    words = optimum_words(*ends, environment.optimum_is_proven)
    return f"; the optimum is {words}" if known else ""


def _extreme(study: StudySpec) -> str:
    return "lowest" if study.metric in COSTS else "highest"


def _equal_to(top: AgentAnalysis, environment: EnvironmentAnalysis) -> list[str]:
    """The agents whose mean equals that of ``top``."""
    value = top.metric.mean.point
    return [a.agent for a in environment.agents if math.isclose(a.metric.mean.point, value)]


def _where_the_median_differs(study: StudySpec, environment: EnvironmentAnalysis) -> Iterable[str]:
    """Which agent is first by the median, if another is first by the mean."""
    sign = -1 if study.metric in COSTS else 1
    medians = {agent: sign * agent.metric.median.point for agent in environment.agents}
    by_mean = environment.agents[0]
    by_median = max(medians, key=medians.__getitem__)
    one, two = by_mean.metric, by_median.metric
    is_first = sign * one.mean.point > sign * two.mean.point
    if (
        is_first
        and medians[by_median] > medians[by_mean]
        and not math.isclose(one.median.point, two.median.point)
    ):
        yield (
            f"By the mean {by_mean.agent} comes first ({number(one.mean.point)} against "
            f"{number(two.mean.point)}), by the median {by_median.agent} "
            f"({number(two.median.point)} against {number(one.median.point)})."
        )


def none_has_learnt(study: StudySpec, environment: EnvironmentAnalysis) -> bool:
    """Whether no median exceeds the best random or constant policy by more than the margin."""
    baseline, optimum = environment.baseline, environment.optimum
    if study.metric not in ON_THE_SCALE or baseline is None or optimum is None:
        return False
    reach = baseline + environment.margin
    medians = [agent.metric.median.point for agent in environment.agents]
    return optimum > baseline and all(median <= reach for median in medians)


def _on_other_tasks(environment: EnvironmentAnalysis) -> Iterable[str]:
    """A warning if the settings of an agent change the environment, and so the optimum."""
    if environment.optima:
        each = [f"{number(optimum)} for {name}" for name, optimum in environment.optima.items()]
        yield (
            f"The agents do NOT PLAY THE SAME ENVIRONMENT: the optimum is {enumeration(each)}. "
            "Their returns cannot be compared."
        )


def _on_the_hidden(environment: EnvironmentAnalysis) -> Iterable[str]:
    """Under partial observability: what the optimum is based on, and that of the full state."""
    words = scale_words(environment.full_optimum, environment.measured_by)
    if words:
        yield f"{words[0].upper()}{words[1:]}."


def _on_the_impossible(environment: EnvironmentAnalysis) -> Iterable[str]:
    """Agents whose returns exceed the upper bound on the optimum."""
    names, most = environment.impossible, environment.optimum
    if names:
        verb = "has" if len(names) == 1 else "have"
        yield (
            f"{enumeration(names)} {verb} MORE THAN ANY POLICY CAN REACH, {number(most)}: the "
            "bracket belongs to another environment, or is wrong"
            f"{'.' if environment.optimum_is_proven else '; its upper end is not proven.'}"
        )


def _on_variants(study: StudySpec, environment: EnvironmentAnalysis) -> Iterable[str]:
    """Agents trained on a variant of the environment, if the verdicts are on training returns."""
    names = [agent.agent for agent in environment.agents if agent.on_variant]
    if names and study.metric in OF_TRAINING:
        verb = "was" if len(names) == 1 else "were"
        yield (
            f"{enumeration(names)} {verb} trained on a variant of the environment, with returns of "
            "its own."
        )


def on_changes(environments: Sequence[EnvironmentAnalysis]) -> list[str]:
    """Which agents were trained on a changed environment, and what was changed: one sentence.

    It names the environments if there are several, and groups agents with the same changes.
    """
    found: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for environment in environments:
        place = f" on {environment.environment}" if len(environments) > 1 else ""
        for agent in environment.agents:
            if agent.changes:
                found.setdefault((place, agent.changes), []).append(agent.agent)
    told = [f"{enumeration(a)}{place} ({', '.join(what)})" for (place, what), a in found.items()]
    return [f"{MARK}: trained on a changed environment: {'; '.join(told)}."] if told else []


def _on_looks(environment: EnvironmentAnalysis) -> Iterable[str]:
    """Which look at the runs this is, if not the first, and the level of its claims."""
    look = environment.look
    level = f"{100 * look.level:.2g} %"
    if look.design is not None:
        n = len(look.design.sizes)
        looks = "1 look that was" if n == 1 else f"{n} looks that were"
        yield (
            f"Agents got more seeds until they were decided, at up to {looks} fixed beforehand: "
            f"claims at {level} each."
        )
    elif look.number > 1 and not look.is_counted:
        yield (
            f"This would be the {ordinal(look.number)} look at this study, with claims at {level}; "
            "runs that are too few to claim anything are not counted as one."
        )
    elif look.number > 1:
        yield f"This is the {ordinal(look.number)} look at this study: claims at {level}."


def _on_missing(study: StudySpec, environment: EnvironmentAnalysis) -> Iterable[str]:
    for agent, n_missing in environment.missing.items():
        n_seeds = environment.seeds.get(agent, study.n_seeds)
        if n_missing == n_seeds:
            yield f"No run of {agent} has finished."
        elif n_missing:
            verb = "is" if n_missing == 1 else "are"
            yield f"{n_missing} of {n_seeds} runs of {agent} {verb} missing."
