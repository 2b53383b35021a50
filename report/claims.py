"""Sentences that claim something of more runs than there are: on pairs, on failures, on speed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from experiments.analysis import AgentAnalysis, EnvironmentAnalysis
from experiments.study_spec import StudySpec
from report.wording import enumeration, interval, number, ordinal, seeds
from verdicts import PairComparison


def pair_sentences(study: StudySpec, environment: EnvironmentAnalysis) -> list[str]:
    """The verdicts, those with the same first agent and the same verdict in one sentence."""
    place = f"On {environment.environment}"
    texts = [f"{place}, {_on_equivalent(environment, g)}." for g in _equivalent_groups(environment)]
    too_few = study.n_seeds < environment.fewest
    for agent in environment.agents:
        pairs = [pair for pair in environment.pairs if pair.first == agent.agent]
        better = [p for p in pairs if p.verdict == "better"]
        if better:
            names = _by_how_much(environment, better)
            texts.append(f"{place}, {agent.agent} is better than {names}.")
        if not too_few:
            texts += [_on_undecided(study, place, p) for p in pairs if p.verdict == "undecided"]
        texts += [
            f"{place}, {pair.first} is worse than {_by_how_much(environment, [pair.swapped()])}."
            for pair in pairs
            if pair.verdict == "worse"
        ]
    texts += [f"{place}, {_on_unreliable(environment, pair)}." for pair in _unreliable(environment)]
    if too_few and any(pair.verdict == "undecided" for pair in environment.pairs):
        texts.append(_on_too_few(study, environment))
    return [*texts, *_on_looks(environment)]


def seeds_of(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    """How many seeds the agents were to have."""
    return seeds(*(environment.seeds.values() or [study.n_seeds]))


def _on_looks(environment: EnvironmentAnalysis) -> Iterable[str]:
    """How often the runs have been looked at, where that is more than once, and at what level."""
    look, place = environment.look, f"On {environment.environment}"
    level = f"{100 * look.level:.2g} %"
    if look.design is not None:
        n = len(look.design.sizes)
        looks = "1 look that was" if n == 1 else f"{n} looks that were"
        yield (
            f"{place}, agents got more seeds until they were decided, at up to {looks} settled "
            f"beforehand: claims at {level} each."
        )
    elif look.number > 1:
        yield f"{place}, this is the {ordinal(look.number)} look at this study: claims at {level}."


def _on_too_few(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    n = len(environment.agents)
    said = any(pair.verdict != "undecided" for pair in environment.pairs)
    which = "all other pairs of agents" if said else "the agents"
    return (
        f"On {environment.environment}, {which} are undecided: {seeds_of(study, environment)} "
        f"cannot tell {n} agents apart, whatever they score; it takes {environment.fewest} or more."
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
    pairs = [(p.first, p.second) for p in environment.pairs if p.verdict == "equivalent"]
    groups: list[list[str]] = []
    for first, second in pairs:
        if any(first in group and second in group for group in groups):
            continue
        group = [first, second]
        for name in names:
            if name not in group and all(
                (name, member) in pairs or (member, name) in pairs for member in group
            ):
                group.append(name)
        groups.append(sorted(group, key=names.index))
    return groups


def _by_how_much(environment: EnvironmentAnalysis, pairs: Sequence[PairComparison]) -> str:
    return enumeration(
        [
            f"{pair.second} (by {interval(pair.difference)}{_shown_with(environment, [pair])}"
            f"{_failed_more(environment, pair)})"
            for pair in pairs
        ]
    )


def _shown_with(environment: EnvironmentAnalysis, pairs: Sequence[PairComparison]) -> str:
    """With how many seeds pairs were decided, where a study has grown until they were."""
    if environment.look.design is None:
        return ""
    return f", with {seeds(*(pair.n_seeds for pair in pairs))}"


def _failed_more(environment: EnvironmentAnalysis, pair: PairComparison) -> str:
    """The failures of two agents, where some runs of an agent failed and most did not."""
    counts = [environment.failures.get(name) for name in (pair.first, pair.second)]
    told = [
        f"{count.n_failed} of {count.n} runs of {name} failed"
        for name, count in zip((pair.first, pair.second), counts, strict=True)
        if count is not None and 0 < 2 * count.n_failed <= count.n
    ]
    return "; " + enumeration(told) if told else ""


def _unreliable(environment: EnvironmentAnalysis) -> list[tuple[str, str]]:
    """Who fails more often, but for agents that are worse anyhow."""
    worse = {(p.second, p.first) for p in environment.pairs if p.verdict == "better"}
    worse |= {(p.first, p.second) for p in environment.pairs if p.verdict == "worse"}
    return [pair for pair in environment.unreliable if pair not in worse]


def _on_unreliable(environment: EnvironmentAnalysis, pair: tuple[str, str]) -> str:
    more, less = (environment.failures[name] for name in pair)
    return (
        f"{pair[0]} fails more often than {pair[1]} ({more.n_failed} of {more.n} runs against "
        f"{less.n_failed} of {less.n})"
    )


def _on_undecided(study: StudySpec, place: str, pair: PairComparison) -> str:
    text = (
        f"{place}, {pair.first} against {pair.second} is undecided with "
        f"{seeds(pair.n_seeds or study.n_seeds)} (difference {interval(pair.difference)})"
    )
    if pair.seeds_needed is not None:
        text += f"; {pair.seeds_needed:,} seeds would probably tell"
    return f"{text}."


def speed_sentences(environment: EnvironmentAnalysis) -> Iterable[str]:
    """How many runs come to stay above the threshold, from when on, and who does so sooner."""
    told = [
        agent
        for agent in environment.agents
        if agent.steps_to_stay is not None and agent.steps_to_stay.share_reached.n
    ]
    arrived = [agent for agent in told if _n_stayed(agent)]
    if len(told) < 2 or not arrived:
        return
    arrived.sort(key=_median_steps)
    goal = f"{_goal(environment)} and keeps it to the end"
    first, *others = [_on_arrival(agent) for agent in arrived]
    never = [agent.agent for agent in told if not _n_stayed(agent)]
    parts = [f"On {environment.environment}, {arrived[0].agent} reaches {goal} in {first}"]
    parts += [f"{agent.agent} in {text}" for agent, text in zip(arrived[1:], others, strict=True)]
    if never:
        parts.append(f"{enumeration(never)} in none")
    yield f"{'; '.join(parts)}."
    yield from _on_ratios(environment, arrived[0].agent)


def _on_ratios(environment: EnvironmentAnalysis, fastest: str) -> Iterable[str]:
    """Who needs how many times the steps of the fastest, where that is shown."""
    slower = []
    for pair in environment.speeds:
        if pair.sooner != fastest:
            continue
        forward = pair.first == fastest
        low, high = pair.ratio.low, pair.ratio.high
        low, high = (low, high) if forward else (_inverse(high), _inverse(low))
        name = pair.second if forward else pair.first
        most = f"at least {number(low)}" if math.isinf(high) else f"{number(low)} to {number(high)}"
        slower.append(f"{name} needs {most} times as many")
    if slower:
        place = f"On {environment.environment}"
        yield f"{place}, {fastest} arrives in fewer steps: {enumeration(slower)}."


def _inverse(ratio: float) -> float:
    return math.inf if ratio == 0 else 1 / ratio


def _n_stayed(agent: AgentAnalysis) -> int:
    assert agent.steps_to_stay is not None
    share = agent.steps_to_stay.share_reached
    return round(share.point * share.n)


def _median_steps(agent: AgentAnalysis) -> float:
    assert agent.steps_to_stay is not None
    return agent.steps_to_stay.median.point


def _on_arrival(agent: AgentAnalysis) -> str:
    assert agent.steps_to_stay is not None
    n, steps = agent.steps_to_stay.share_reached.n, _median_steps(agent)
    text = f"{_n_stayed(agent)} of {n} runs"
    return text if math.isinf(steps) else f"{text}, the median one from step {steps:,.0f} on"


def _goal(environment: EnvironmentAnalysis) -> str:
    threshold, optimum, blind = environment.threshold, environment.optimum, environment.best_blind
    if threshold is not None and optimum is not None and blind is not None:
        share = (threshold - blind) / (optimum - blind) if optimum > blind else float("nan")
        if math.isclose(share, 0.95):
            return "a score of 0.95"
    return f"a return of {number(threshold)}"
