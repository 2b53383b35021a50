"""What a study has shown, in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable

from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.reliability import ON_THE_SCALE
from experiments.study_spec import COSTS, METRIC_WORDS, OF_TRAINING, StudySpec
from report.claims import pair_sentences, speed_sentences
from report.wording import enumeration, interval, number, seeds


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
        *pair_sentences(study, environment),
        *speed_sentences(environment),
        *_on_variants(study, environment),
        *_on_failures(study.n_seeds, environment),
    ]


def _on_the_best(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    top = environment.agents[0]
    value = top.metric.mean.point
    if math.isnan(value):
        words = METRIC_WORDS[study.metric]
        return f"On {environment.environment}, no run has a figure for the {words}."
    best = [a for a in environment.agents if math.isclose(a.metric.mean.point, value)]
    names = enumeration([agent.agent for agent in best])
    if none_has_learnt(study, environment):
        return (
            f"On {environment.environment}, none of the agents has learnt: over "
            f"{seeds(study.n_seeds)}, no typical run is better than the best blind policy's "
            f"{number(environment.best_blind)}; the highest {METRIC_WORDS[study.metric]} is "
            f"{interval(top.metric.mean)}, of {names}."
        )
    verb = "has" if len(best) == 1 else "have"
    extreme = "lowest" if study.metric in COSTS else "highest"
    text = (
        f"On {environment.environment}, over {seeds(study.n_seeds)}, {names} {verb} the {extreme} "
        f"{METRIC_WORDS[study.metric]}: {interval(top.metric.mean)}"
    )
    if environment.optimum is None or study.metric not in ON_THE_SCALE:
        return f"{text}."
    if math.isclose(value, environment.optimum, rel_tol=1e-6, abs_tol=1e-6):
        return f"{text}, the optimum."
    share = top.score.mean.point if top.score is not None else float("nan")
    score = f", a score of {number(share)}" if study.metric == "final" else ""
    return f"{text}{score}; the optimum is {number(environment.optimum)}."


def none_has_learnt(study: StudySpec, environment: EnvironmentAnalysis) -> bool:
    """Whether the typical run of every agent is as one that ignores what it observes."""
    blind, optimum = environment.best_blind, environment.optimum
    if study.metric not in ON_THE_SCALE or blind is None or optimum is None or optimum <= blind:
        return False
    reach = blind + environment.margin
    return all(agent.metric.median.point <= reach for agent in environment.agents)


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
