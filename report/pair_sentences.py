"""Sentences on pairs of agents: verdicts, and who fails more often."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from experiments.analysis import EnvironmentAnalysis
from experiments.study import StudySpec
from report.wording import enumeration, interval, number, seeds
from verdicts import PairComparison


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
        better = [pair for pair in pairs if pair.verdict == "better"]
        open_ = [pair for pair in pairs if pair.verdict == "undecided"]
        if better:
            texts.append(f"{name} is better than {_by_how_much(environment, better)}.")
        if open_ and not too_few:
            texts.append(f"{name} is undecided against {_how_open(environment, open_)}.")
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
    """With how many seeds pairs were judged, where a study has grown until they were decided."""
    if environment.look.design is None:
        return ""
    return f", with {seeds(*(pair.n_seeds for pair in pairs))}"


def _failed_more(environment: EnvironmentAnalysis, pair: PairComparison) -> str:
    """The failures of two agents, but of an agent most of whose runs failed."""
    counts = {name: environment.failures.get(name) for name in (pair.first, pair.second)}
    few = [name for name, count in counts.items() if count and 2 * count.n_failed <= count.n]
    told = failed_runs(environment, few)
    return f"; {told}" if told else ""


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


def _how_open(environment: EnvironmentAnalysis, pairs: Sequence[PairComparison]) -> str:
    """By how much the agents differ, and how many seeds it would take."""
    return enumeration(
        [f"{pair.second} ({_difference_so_far(environment, pair)})" for pair in pairs]
    )


def _difference_so_far(environment: EnvironmentAnalysis, pair: PairComparison) -> str:
    text = f"difference {interval(pair.difference)}{_shown_with(environment, [pair])}"
    if pair.seeds_needed is None:
        return text
    return f"{text}; about {seeds(pair.seeds_needed)} are needed to decide"
