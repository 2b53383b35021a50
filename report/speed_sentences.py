"""Sentences on how soon agents stay above the threshold."""

from __future__ import annotations

import math
from collections.abc import Iterable

from experiments.analysis import AgentAnalysis, EnvironmentAnalysis
from report.wording import enumeration, number


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
    parts = [f"{arrived[0].agent} reaches {goal} in {first}"]
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
        yield f"{fastest} arrives in fewer steps: {enumeration(slower)}."


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
    threshold, optimum, baseline = environment.threshold, environment.optimum, environment.baseline
    if threshold is not None and optimum is not None and baseline is not None:
        share = (
            (threshold - baseline) / (optimum - baseline) if optimum > baseline else float("nan")
        )
        if math.isclose(share, 0.95):
            return "a score of 0.95"
    return f"a return of {number(threshold)}"
