"""What a study has shown, in sentences: in a line, pair by pair, and how soon."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from experiments.analysis import (
    MARK,
    ON_THE_SCALE,
    AgentAnalysis,
    EnvironmentAnalysis,
    StudyAnalysis,
)
from experiments.study import COSTS, METRIC_WORDS, OF_TRAINING, StudySpec
from report.words import enumeration, interval, number, optimum_words, ordinal, seeds
from verdicts import PairComparison

# Sentences on pairs of agents: verdicts, and who fails more often.


def pairs_both_ways(environment: EnvironmentAnalysis) -> dict[tuple[str, str], PairComparison]:
    """By first and second agent every pair, as each of the two sees it."""
    seen = [one for pair in environment.pairs for one in (pair, pair.swapped())]
    return {(one.first, one.second): one for one in seen}


def oriented_pairs(environment: EnvironmentAnalysis) -> list[PairComparison]:
    """The pairs, each seen from the agent that is better, where one is."""
    return [pair.swapped() if pair.verdict == "worse" else pair for pair in environment.pairs]


def pair_sentences(study: StudySpec, environment: EnvironmentAnalysis) -> list[str]:
    """The verdicts, those with the same first agent and the same verdict in one sentence."""
    too_few = study.n_seeds < environment.fewest
    texts = [f"{_on_equivalent(environment, g)}." for g in _equivalent_groups(environment)]
    oriented = oriented_pairs(environment)
    for name in (agent.agent for agent in environment.agents):
        pairs = [pair for pair in oriented if pair.first == name]
        better = [_by_how_much(environment, pair) for pair in pairs if pair.verdict == "better"]
        open_ = [_how_open(environment, pair) for pair in pairs if pair.verdict == "undecided"]
        if better:
            texts.append(f"{name} is better than {enumeration(better)}.")
        if open_ and not too_few:
            texts.append(f"{name} is undecided against {enumeration(open_)}.")
    if too_few and texts and any(pair.verdict == "undecided" for pair in oriented):
        texts.append(f"All other pairs are undecided: {too_few_seeds(study, environment)}.")
    return texts


def seeds_of(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    """How many seeds the agents were to have."""
    return seeds(*(environment.seeds.values() or [study.n_seeds]))


def too_few_seeds(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    """That so few seeds cannot decide, and how many could."""
    return (
        f"{seeds_of(study, environment)} cannot tell {len(environment.agents)} agents apart, "
        f"whatever they score; it takes {environment.fewest} or more"
    )


def _on_equivalent(environment: EnvironmentAnalysis, group: Sequence[str]) -> str:
    """Who is equivalent, in what, and what so few runs leave open."""
    within = f" within {number(environment.margin)}" if environment.margin > 0 else ""
    pairs = [p for p in environment.pairs if p.first in group and p.second in group]
    if all(pair.certain for pair in pairs):
        return f"{enumeration(group)} are equivalent{within}"
    text = f"{enumeration(group)} are equivalent in the typical run{within}"
    text += _shown_with(environment, pairs)
    counts = {name: environment.failures[name] for name in group if name in environment.failures}
    if not counts:
        n = min(pair.difference.n for pair in pairs)
        rare = 1 - 0.05 ** (1 / n)
        return f"{text}; what fewer than {rare:.0%} of runs do, {seeds(n)} may not show"
    if len({(count.n_failed, count.n) for count in counts.values()}) == 1:
        count = next(iter(counts.values()))
        each = " each" if len(counts) > 1 else f" of {next(iter(counts))}"
        return (
            f"{text}; {count.n_failed} of {count.n} runs{each} failed, up to {count.most:.0%} could"
        )
    told = [
        f"{count.n_failed} of {count.n} runs of {name} failed (up to {count.most:.0%} could)"
        for name, count in counts.items()
    ]
    return f"{text}; {enumeration(told)}"


def _equivalent_groups(environment: EnvironmentAnalysis) -> list[list[str]]:
    """Agents of which every two are equivalent, in groups that hold all such pairs."""
    names = [agent.agent for agent in environment.agents]
    pairs = pairs_both_ways(environment)
    equal = [both for both, pair in pairs.items() if pair.verdict == "equivalent"]
    groups: list[list[str]] = []
    for pair in equal:
        if not any(set(pair) <= set(group) for group in groups):
            group = list(pair)
            for name in names:
                if all((name, member) in equal for member in group):
                    group.append(name)
            groups.append(sorted(group, key=names.index))
    return groups


def _by_how_much(environment: EnvironmentAnalysis, pair: PairComparison) -> str:
    """The worse agent, the difference, and who failed, but of an agent most of whose runs did."""
    counts = {name: environment.failures.get(name) for name in (pair.first, pair.second)}
    few = [name for name, count in counts.items() if count and 2 * count.n_failed <= count.n]
    failed = failed_runs(environment, few)
    text = f"by {interval(pair.difference)}{_shown_with(environment, [pair])}"
    return f"{pair.second} ({text}{f'; {failed}' if failed else ''})"


def _how_open(environment: EnvironmentAnalysis, pair: PairComparison) -> str:
    """The other agent, the difference so far, and how many seeds it would take to decide."""
    text = f"difference {interval(pair.difference)}{_shown_with(environment, [pair])}"
    if pair.seeds_needed is not None:
        text += f"; about {seeds(pair.seeds_needed)} are needed to decide"
    return f"{pair.second} ({text})"


def _shown_with(environment: EnvironmentAnalysis, pairs: Sequence[PairComparison]) -> str:
    """With how many seeds pairs were judged, where a study has grown until they were decided."""
    if environment.look.design is None:
        return ""
    return f", with {seeds(*(pair.n_seeds for pair in pairs))}"


def failed_runs(environment: EnvironmentAnalysis, names: Sequence[str]) -> str:
    """Of agents, those of which runs failed, and how many; empty where none did."""
    counts = {name: environment.failures.get(name) for name in names}
    return enumeration(
        [
            f"{count.n_failed} of {count.n} runs of {name} failed"
            for name, count in counts.items()
            if count is not None and count.n_failed
        ]
    )


def on_unreliable(environment: EnvironmentAnalysis) -> Iterable[str]:
    """Who fails more often, but for agents that are worse anyhow."""
    worse = {(p.second, p.first) for p in oriented_pairs(environment) if p.verdict == "better"}
    for names in environment.unreliable:
        if names not in worse:
            more, less = (environment.failures[name] for name in names)
            yield (
                f"{names[0]} fails more often than {names[1]} ({more.n_failed} of {more.n} runs "
                f"against {less.n_failed} of {less.n})."
            )


# Sentences on how soon agents stay above the threshold.


def speed_sentences(environment: EnvironmentAnalysis) -> Iterable[str]:
    """How many runs come to stay above the threshold, from when on, and who does so sooner."""
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
    """Who needs how many times the steps of the fastest, where that is shown."""
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


# What a study has shown on an environment: in a line, pair by pair, and what else there is.

MOST_FIGURES = 3  # agents whose figures stand in a line


@dataclass(frozen=True)
class Conclusion:
    """What the runs on an environment say."""

    lead: str  # who is best, and how that stands to the optimum
    pairs: tuple[str, ...]  # every verdict, with figures; several in a sentence
    failed: str  # whose runs failed, to stand beside verdicts that are shown as signs; may be empty
    # Failures, how soon agents arrive, training on variants, what is missing, what failed agents
    # do instead, and how often the runs have been looked at.
    notes: tuple[str, ...]

    @property
    def everything(self) -> tuple[str, ...]:
        """All sentences; those on pairs say who failed."""
        return (self.lead, *self.pairs, *self.notes)


def conclusion(study: StudySpec, environment: EnvironmentAnalysis) -> Conclusion:
    """What a study has shown on one environment."""
    failed = failed_runs(environment, [agent.agent for agent in environment.agents])
    has_equal = any(pair.verdict == "equivalent" for pair in environment.pairs)
    equal = ": what is equivalent is so in the typical run" if has_equal else ""
    return Conclusion(
        lead=" ".join(_lead(study, environment)),
        pairs=tuple(pair_sentences(study, environment)),
        failed=f"{failed}{equal}." if failed else "",
        notes=(
            *_on_other_tasks(environment),
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
    """Who is best, as far as the verdicts say."""
    names = [agent.agent for agent in environment.agents]
    decided = [pair for pair in oriented_pairs(environment) if pair.verdict != "undecided"]
    better = {(pair.first, pair.second) for pair in decided if pair.verdict == "better"}
    same = {frozenset((pair.first, pair.second)) for pair in decided} - set(map(frozenset, better))
    ahead = [name for name in names if not any((other, name) in better for other in names)]
    first = [agent for agent in environment.agents if agent.agent in ahead]
    but = _but_failed(environment, ahead)
    if len(names) == 1:
        yield f"{names[0]}: {_figure(study, environment, first[0])}{but}."
    elif not decided:
        yield _nothing_decided(study, environment)
    elif not ahead:
        yield "No agent is best: for each of them there is another that is better."
    elif len(ahead) == 1:
        others = [name for name in names if name not in ahead and (ahead[0], name) not in better]
        doubt = f"; against {enumeration(others)} it is undecided" if others else ""
        yield f"{ahead[0]} is best: {_figure(study, environment, first[0])}{doubt}{but}."
    elif all(frozenset((a, b)) in same for a in ahead for b in ahead if a != b):
        where = " in the typical run" if but else ""
        figure = _figure(study, environment, first[0])
        yield f"{enumeration(ahead)} are best, and equivalent{where}: {figure}{but}."
    else:
        if len(ahead) > MOST_FIGURES:
            whoever = f"one of {enumeration(ahead)}"
        else:
            *others, last = [f"{agent.agent} ({interval(agent.metric.mean)})" for agent in first]
            whoever = f"{', '.join(others)} or {last}"
        yield f"Best is {whoever}: that is undecided{_optimum(study, environment)}{but}."


def _nothing_decided(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    top = environment.agents[0]
    why = f"{seeds_of(study, environment)} decide nothing"
    if study.n_seeds < environment.fewest:
        why = too_few_seeds(study, environment)
    names = _equal_to(top, environment)
    verb = "has" if len(names) == 1 else "have"
    so_far = f"{verb} the {_extreme(study)} mean so far: {_figure(study, environment, top)}"
    return f"Undecided: {why}. {enumeration(names)} {so_far}{_but_failed(environment, names)}."


def _but_failed(environment: EnvironmentAnalysis, names: Sequence[str]) -> str:
    failed = failed_runs(environment, names)
    return f"; {failed}" if failed else ""


def _figure(study: StudySpec, environment: EnvironmentAnalysis, agent: AgentAnalysis) -> str:
    value = agent.metric.mean
    text = f"{METRIC_WORDS[study.metric]} {interval(value)}"
    if study.metric not in ON_THE_SCALE or environment.optimum is None:
        return text
    if math.isclose(value.point, environment.optimum, rel_tol=1e-6, abs_tol=1e-6):
        return f"{text}, the optimum"
    if study.metric == "final" and agent.score is not None:
        text += f", score {number(agent.score.mean.point)}"
    return f"{text}{_optimum(study, environment)}"


def _optimum(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    known = study.metric in ON_THE_SCALE and environment.optimum is not None
    words = optimum_words(environment.optimum, environment.optimum_at_least)
    return f"; the optimum is {words}" if known else ""


def _extreme(study: StudySpec) -> str:
    return "lowest" if study.metric in COSTS else "highest"


def _equal_to(top: AgentAnalysis, environment: EnvironmentAnalysis) -> list[str]:
    """The agents whose mean is that of the first."""
    value = top.metric.mean.point
    return [a.agent for a in environment.agents if math.isclose(a.metric.mean.point, value)]


def _where_the_median_differs(study: StudySpec, environment: EnvironmentAnalysis) -> Iterable[str]:
    """Who comes first by the median, where that is not who does by the mean."""
    sign = -1 if study.metric in COSTS else 1
    medians = {agent: sign * agent.metric.median.point for agent in environment.agents}
    by_mean = environment.agents[0]
    by_median = max(medians, key=medians.__getitem__)
    one, two = by_mean.metric, by_median.metric
    if medians[by_median] > medians[by_mean] and not math.isclose(
        one.median.point, two.median.point
    ):
        yield (
            f"By the mean {by_mean.agent} comes first ({number(one.mean.point)} against "
            f"{number(two.mean.point)}), by the median {by_median.agent} "
            f"({number(two.median.point)} against {number(one.median.point)})."
        )


def none_has_learnt(study: StudySpec, environment: EnvironmentAnalysis) -> bool:
    """Whether the typical run of every agent is no better than acting at random."""
    baseline, optimum = environment.baseline, environment.optimum
    if study.metric not in ON_THE_SCALE or baseline is None or optimum is None:
        return False
    reach = baseline + environment.margin
    medians = [agent.metric.median.point for agent in environment.agents]
    return optimum > baseline and all(median <= reach for median in medians)


def _on_other_tasks(environment: EnvironmentAnalysis) -> Iterable[str]:
    """That agents do not play the same environment, since one's settings change it."""
    if environment.optima:
        each = [f"{number(optimum)} for {name}" for name, optimum in environment.optima.items()]
        yield (
            f"The agents do NOT PLAY THE SAME ENVIRONMENT: the optimum is {enumeration(each)}. "
            "Their returns cannot be compared."
        )


def _on_the_impossible(environment: EnvironmentAnalysis) -> Iterable[str]:
    """Agents whose returns are above what no policy exceeds."""
    most = environment.optimum
    if environment.optimum_at_least is None or most is None:
        return
    # Surely: by six standard errors, three times what the interval of the mean says.
    least = {a.agent: a.final.point - 3 * (a.final.point - a.final.low) for a in environment.agents}
    names = [name for name, value in least.items() if value > most + abs(most) * 1e-6]
    if names:
        verb = "has" if len(names) == 1 else "have"
        yield (
            f"{enumeration(names)} {verb} MORE THAN ANY POLICY CAN REACH, {number(most)}: the "
            "environment is not the one that the bracket is of, or the bracket is wrong."
        )


def _on_variants(study: StudySpec, environment: EnvironmentAnalysis) -> Iterable[str]:
    """That returns of training cannot be compared, where the verdicts are about them."""
    names = [agent.agent for agent in environment.agents if agent.on_variant]
    if names and study.metric in OF_TRAINING:
        verb = "was" if len(names) == 1 else "were"
        yield (
            f"{enumeration(names)} {verb} trained on a variant of the environment, with returns of "
            "its own."
        )


def on_changes(environments: Sequence[EnvironmentAnalysis]) -> list[str]:
    """Which agents were trained on a changed environment, and what was changed: one sentence.

    Of several environments it says which; those with the same changes stand together.
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
    """How often the runs have been looked at, where that is more than once, and at what level."""
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
