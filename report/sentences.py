"""What a study has shown, in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.study_spec import COSTS, METRIC_WORDS, OF_TRAINING, StudySpec
from report.wording import enumeration, interval, number
from verdicts import PairComparison


def sentences(analysis: StudyAnalysis) -> list[str]:
    """What the study has shown, the most important first within each environment."""
    result = []
    for environment in analysis.environments:
        result += environment_sentences(analysis.study, environment)
    there = {environment.environment for environment in analysis.environments}
    absent = [e.label for e in analysis.study.environments if e.label not in there]
    return [*result, *(f"On {label}, no run has finished." for label in absent)]


def environment_sentences(study: StudySpec, environment: EnvironmentAnalysis) -> list[str]:
    """What it has shown on one environment."""
    return [
        _on_the_best(study, environment),
        *_on_the_pairs(study, environment),
        *_on_the_speed(environment),
        *_on_variants(study, environment),
        *_on_failures(study.n_seeds, environment),
    ]


def _seeds(n: int) -> str:
    return f"{n:,} seed{'s' if n > 1 else ''}"


def _on_the_best(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    top = environment.agents[0]
    value = top.metric.mean.point
    if math.isnan(value):
        words = METRIC_WORDS[study.metric]
        return f"On {environment.environment}, no run has a figure for the {words}."
    best = [a for a in environment.agents if math.isclose(a.metric.mean.point, value)]
    names = enumeration([agent.agent for agent in best])
    verb = "has" if len(best) == 1 else "have"
    extreme = "lowest" if study.metric in COSTS else "highest"
    text = (
        f"On {environment.environment}, over {_seeds(study.n_seeds)}, {names} {verb} the {extreme} "
        f"{METRIC_WORDS[study.metric]}: {interval(top.metric.mean)}"
    )
    if environment.optimum is None or study.metric not in ("final", "best"):
        return f"{text}."
    if math.isclose(value, environment.optimum, rel_tol=1e-6, abs_tol=1e-6):
        return f"{text}, the optimum."
    share = top.score.mean.point if top.score is not None else float("nan")
    score = f", a score of {number(share)}" if study.metric == "final" else ""
    return f"{text}{score}; the optimum is {number(environment.optimum)}."


def _on_the_pairs(study: StudySpec, environment: EnvironmentAnalysis) -> list[str]:
    """The verdicts, those with the same first agent and the same verdict in one sentence."""
    place = f"On {environment.environment}"
    within = f" within {number(environment.margin)}" if environment.margin > 0 else ""
    texts = [
        f"{place}, {enumeration(group)} are equivalent{within}."
        for group in _equivalent_groups(environment)
    ]
    for agent in environment.agents:
        pairs = [pair for pair in environment.pairs if pair.first == agent.agent]
        better = [p for p in pairs if p.verdict == "better"]
        open_ = [p for p in pairs if p.verdict == "undecided"]
        if better:
            texts.append(f"{place}, {agent.agent} is better than {_by_how_much(better)}.")
        texts += [_on_undecided(study, place, pair) for pair in open_]
        texts += [
            f"{place}, {pair.first} is worse than {_by_how_much([pair.swapped()])}."
            for pair in pairs
            if pair.verdict == "worse"
        ]
    return texts


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


def _by_how_much(pairs: Sequence[PairComparison]) -> str:
    return enumeration([f"{pair.second} (by {interval(pair.difference)})" for pair in pairs])


def _on_undecided(study: StudySpec, place: str, pair: PairComparison) -> str:
    text = (
        f"{place}, {pair.first} and {pair.second} are not distinguishable with "
        f"{_seeds(study.n_seeds)} (difference {interval(pair.difference)})"
    )
    if pair.seeds_needed is not None:
        text += f"; {pair.seeds_needed:,} seeds would probably tell"
    return f"{text}."


def _on_the_speed(environment: EnvironmentAnalysis) -> list[str]:
    """How many times the steps of the fastest the others take to the threshold."""
    reached = [
        (agent.steps_to_threshold.median.point, agent)
        for agent in environment.agents
        if agent.steps_to_threshold is not None
    ]
    arrived = sorted((steps, a.agent) for steps, a in reached if math.isfinite(steps))
    if len(reached) < 2 or not arrived:
        return []
    goal = _goal(environment)
    fastest_steps, fastest = arrived[0]
    text = (
        f"On {environment.environment}, {fastest} reaches {goal} after {fastest_steps:,.0f} steps"
    )
    slower = [
        f"{agent} needs {number(steps / fastest_steps)} times the steps"
        for steps, agent in arrived[1:]
        if steps > 1.05 * fastest_steps
    ]
    never = [agent.agent for steps, agent in reached if math.isinf(steps)]
    if never:
        slower.append(f"{enumeration(never)} did not in half of the runs or more")
    return [f"{'; '.join([text, *slower])} (medians over seeds)."]


def _goal(environment: EnvironmentAnalysis) -> str:
    threshold, optimum, blind = environment.threshold, environment.optimum, environment.best_blind
    if threshold is not None and optimum is not None and blind is not None:
        share = (threshold - blind) / (optimum - blind) if optimum > blind else float("nan")
        if math.isclose(share, 0.95):
            return "a score of 0.95"
    return f"a return of {number(threshold)}"


def _on_variants(study: StudySpec, environment: EnvironmentAnalysis) -> list[str]:
    """That returns of training cannot be compared, where the verdicts are about them."""
    names = [agent.agent for agent in environment.agents if agent.on_variant]
    if not names or study.metric not in OF_TRAINING:
        return []
    verb = "was" if len(names) == 1 else "were"
    place = f"On {environment.environment}, {enumeration(names)}"
    return [f"{place} {verb} trained on a variant of the environment, with returns of its own."]


def _on_failures(n_seeds: int, environment: EnvironmentAnalysis) -> Iterable[str]:
    for agent, n_missing in environment.missing.items():
        if n_missing == n_seeds:
            yield f"On {environment.environment}, no run of {agent} has finished."
        elif n_missing:
            verb = "is" if n_missing == 1 else "are"
            yield (
                f"On {environment.environment}, {n_missing} of {n_seeds} runs of {agent} "
                f"{verb} missing."
            )
