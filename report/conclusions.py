"""What a study has shown on an environment: in a line, pair by pair, and what else there is."""

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
from report.pair_sentences import (
    failed_runs,
    on_unreliable,
    oriented_pairs,
    pair_sentences,
    seeds_of,
    too_few_seeds,
)
from report.speed_sentences import speed_sentences
from report.wording import enumeration, interval, number, optimum_words, ordinal
from verdicts import Estimate

MOST_FIGURES = 3  # agents whose figures stand in a line


@dataclass(frozen=True)
class Conclusion:
    """What the runs on an environment say.

    Attributes:
        lead: who is best, and how that stands to the optimum.
        pairs: every verdict, with figures; several in a sentence.
        failed: whose runs failed, to stand beside verdicts that are shown as signs; may be empty.
        notes: failures, how soon agents arrive, training on variants, what is missing, what failed
            agents do instead, and how often the runs have been looked at.
    """

    lead: str
    pairs: tuple[str, ...]
    failed: str
    notes: tuple[str, ...]

    @property
    def everything(self) -> tuple[str, ...]:
        """All sentences; those on pairs say who failed."""
        return (self.lead, *self.pairs, *self.notes)


def conclusion(study: StudySpec, environment: EnvironmentAnalysis) -> Conclusion:
    """What a study has shown on one environment."""
    return Conclusion(
        lead=" ".join(_lead(study, environment)),
        pairs=tuple(pair_sentences(study, environment)),
        failed=_on_failed(environment),
        notes=(
            *_on_other_tasks(environment),
            *on_unreliable(environment),
            *speed_sentences(environment),
            *_on_the_impossible(study, environment),
            *_on_variants(study, environment),
            *on_changes([environment]),
            *_on_missing(study, environment),
            *environment.advice,
            *_on_looks(environment),
        ),
    )


def _on_failed(environment: EnvironmentAnalysis) -> str:
    failed = failed_runs(environment, [agent.agent for agent in environment.agents])
    if failed and any(pair.verdict == "equivalent" for pair in environment.pairs):
        return f"{failed}: what is equivalent is so in the typical run."
    return f"{failed}." if failed else ""


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
        figures = f"{_alternatives(first)}: that is undecided{_optimum(study, environment)}"
        yield f"Best is {figures}{but}."


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


def _alternatives(agents: list[AgentAnalysis]) -> str:
    if len(agents) > MOST_FIGURES:
        return f"one of {enumeration([agent.agent for agent in agents])}"
    *others, last = [f"{agent.agent} ({interval(agent.metric.mean)})" for agent in agents]
    return f"{', '.join(others)} or {last}"


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
    if (
        study.metric not in ON_THE_SCALE
        or baseline is None
        or optimum is None
        or optimum <= baseline
    ):
        return False
    reach = baseline + environment.margin
    return all(agent.metric.median.point <= reach for agent in environment.agents)


def _on_other_tasks(environment: EnvironmentAnalysis) -> Iterable[str]:
    """That agents do not play the same environment, since one's settings change it."""
    if environment.optima:
        each = [f"{number(optimum)} for {name}" for name, optimum in environment.optima.items()]
        yield (
            f"The agents do NOT PLAY THE SAME ENVIRONMENT: the optimum is {enumeration(each)}. "
            "Their returns cannot be compared."
        )


def _on_the_impossible(study: StudySpec, environment: EnvironmentAnalysis) -> Iterable[str]:
    """Agents whose returns are above what no policy exceeds."""
    most = environment.optimum
    if environment.optimum_at_least is None or most is None:
        return
    names = [a.agent for a in environment.agents if _surely(a.final) > most + abs(most) * 1e-6]
    if names:
        verb = "has" if len(names) == 1 else "have"
        yield (
            f"{enumeration(names)} {verb} MORE THAN ANY POLICY CAN REACH, {number(most)}: the "
            "environment is not the one that the bracket is of, or the bracket is wrong."
        )


def _surely(value: Estimate) -> float:
    """What a mean is above by six standard errors: by three times what its interval says."""
    return value.point - 3 * (value.point - value.low)


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
