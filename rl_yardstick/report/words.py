"""The words of a study: numbers, sentences on seeds, conclusions, and where return is lost."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rl_yardstick.experiments.analysis import MARK, ON_THE_SCALE, EnvironmentAnalysis, StudyAnalysis
from rl_yardstick.experiments.plan import PlannedRun, Seeds, TuningSeeds
from rl_yardstick.experiments.results import StudyResults, Tried
from rl_yardstick.experiments.study import AS_IT_IS, COSTS, OF_TRAINING, SHIPPED, StudySpec
from rl_yardstick.pipeline.components import import_modules
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.verdicts import Estimate, Pair, unseen_share

if TYPE_CHECKING:
    from rl_yardstick.diagnosis.explanation import Explanation, StateLoss


SIGNIFICANT = 4  # digits


def number(value: float | None, decimals: int | None = None) -> str:
    """A figure with four significant digits, or with so many decimals; a dash for none."""
    if value is None or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "never" if value > 0 else "-∞"
    if decimals is not None:
        return f"{value:z,.{decimals}f}"
    if value == 0 or abs(value) >= 10 ** (SIGNIFICANT - 1):
        return f"{value:,.0f}"
    digits = SIGNIFICANT - 1 - math.floor(math.log10(abs(value)))
    text = f"{value:.{min(max(digits, 0), SIGNIFICANT)}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def score_number(value: float | None) -> str:
    """A score, rounded down: 1 is the optimum and nothing less."""
    if value is None or math.isnan(value):
        return "-"
    digits = 10.0**SIGNIFICANT
    return number(math.floor(value * digits + 1e-6) / digits)


Format = Callable[[float | None], str]


def interval(estimate: Estimate, as_text: Format = number) -> str:
    """A mean with its interval in brackets, or with the range of few runs in parentheses.

    The mean alone where all runs are equal.
    """
    point, low, high = map(as_text, (estimate.point, estimate.low, estimate.high))
    if math.isnan(estimate.low) or estimate.low == estimate.high:
        return point
    return f"{point} ({low} to {high})" if estimate.is_range else f"{point} [{low}, {high}]"


def interval_alone(estimate: Estimate, as_text: Format = number) -> str:
    """The interval or range of a mean, empty where all runs are equal."""
    if math.isnan(estimate.low) or estimate.low == estimate.high:
        return ""
    return f"{as_text(estimate.low)} to {as_text(estimate.high)}"


def optimum_words(environment: EnvironmentAnalysis) -> str:
    """The optimum, or both ends of its bracket, with three decimals where they look equal."""
    at_least, optimum = environment.optimum_at_least, environment.optimum
    if at_least is None or optimum is None:
        return number(optimum)
    ends = [number(at_least), number(optimum)]
    if ends[0] == ends[1]:
        ends = [f"{at_least:,.3f}", f"{optimum:,.3f}"]
    mark = "" if environment.optimum_is_proven else "; the upper end is not proven"
    return f"{ends[0]} to {ends[1]} (bracketed{mark})"


def scale_words(environment: EnvironmentAnalysis) -> str:
    """Under partial observability: what the optimum is based on, and that of the full state."""
    if environment.full_optimum is None:
        return ""
    has_memory = environment.measured_by == "memory"
    goes_by = "all that it has observed" if has_memory else "what it observes now"
    return (
        f"observations hide the state: the optimum, the same for all agents, is that of an agent "
        f"that acts on {goes_by}; one that saw the state could have "
        f"{number(environment.full_optimum)}"
    )


def enumeration(words: Sequence[str]) -> str:
    """Words joined by commas, or by semicolons if one has a comma, and the last by "and"."""
    between = "; " if any("," in word for word in words) else ", "
    return " and ".join([between.join(words[:-1]), words[-1]] if len(words) > 2 else words)


def seeds(*counts: int) -> str:
    """A number of seeds, or a range of numbers."""
    least, most = min(counts), max(counts)
    return f"{'' if least == most else f'{least:,} to '}{most:,} seed{'s' if most != 1 else ''}"


MOST_NAMES = 6  # in the sentence on seeds


def seed_sentence(seeds: range, tuning: TuningSeeds) -> str:
    """Say which of the seeds of a study the settings of its agents were tuned on."""
    if tuning.of_logs:
        return "The logs do not say on which seeds settings were tuned."
    these = "these" if len(seeds) > 1 else "it"
    parts = [
        *_tuned(seeds, tuning.shipped, "the shipped settings of", these),
        *_tuned(seeds, tuning.files, "the settings in", these),
    ]
    if tuning.elsewhere:
        names = _names(tuning.elsewhere)
        parts.append(f"the settings of {names} were tuned with other arguments of the environment")
    if tuning.unknown:
        names = _names(tuning.unknown)
        parts.append(f"the study's own settings of {names} may have been tuned on {these}")
    told = "; ".join(parts) or f"nothing was tuned on {these}"
    return f"{'Seeds' if len(seeds) > 1 else 'Seed'} {spans(seeds)}: {told}."


def _tuned(seeds: range, found: Mapping[str, Seeds], whose: str, these: str) -> list[str]:
    """One clause for each set of seeds: whose settings were tuned on them."""
    groups: dict[Seeds, list[str]] = {}
    for name, shared in found.items():
        groups.setdefault(shared, []).append(name)
    told = []
    for shared, names in groups.items():
        which = these if len(shared) == len(seeds) else f"{spans(shared)} of these"
        told += [f"{whose} {_names(names)} were tuned on {which}"] if shared else []
    return told


def _names(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMES
    return enumeration([*names[:MOST_NAMES], f"{more:,} more"] if more > 0 else names)


def spans(numbers: Iterable[int]) -> str:
    """Integers as text, with consecutive ones as a span: "0 to 4, 7"."""
    ordered = sorted(numbers)
    ends = [one for one, two in pairwise(ordered) if two != one + 1] + ordered[-1:]
    starts = ordered[:1] + [two for one, two in pairwise(ordered) if two != one + 1]
    pairs = zip(starts, ends, strict=True)
    return ", ".join(f"{low} to {high}" if low != high else str(low) for low, high in pairs)


# --- conclusions: who is best, pair by pair, who failed, and how soon -----------------------------


def pairs_both_ways(pairs: Iterable[Pair]) -> dict[tuple[str, str], Pair]:
    """Every pair in both orders, by first and second agent."""
    seen = [one for pair in pairs for one in (pair, pair.swapped())]
    return {(one.first, one.second): one for one in seen}


def pair_sentences(environment: EnvironmentAnalysis) -> Iterator[str]:
    """The words on all pairs, one sentence for each first agent and word."""
    oriented = [pair.swapped() if pair.word == "worse" else pair for pair in environment.pairs]
    ways = {"better": "{} is {} than {}.", "tied": "{} is {} with {}."}
    for name in (agent.agent for agent in environment.agents):
        told: dict[str, list[Pair]] = {}
        for pair in oriented:
            if pair.first == name:
                told.setdefault(pair.text, []).append(pair)
        for text, pairs in sorted(told.items()):
            others = enumeration([_other(environment, pair) for pair in pairs])
            yield ways.get(pairs[0].word, "{} is {} against {}.").format(name, text, others)


def _other(environment: EnvironmentAnalysis, pair: Pair) -> str:
    """The other agent, and the difference; of an undecided pair also how many seeds it would take.

    A study that grows says how many seeds decided the pair.
    """
    low, high = map(number, pair.interval)
    unit = " of the score" if environment.is_score else ""
    told = [f"by {low} to {high}{unit}"]
    if pair.word == "tied":
        told = [f"within {number(environment.margin)}{unit}"]
    elif pair.word == "undecided":
        told = [f"difference {low} to {high}{unit}"]
        if math.isinf(pair.interval[0]) or math.isinf(pair.interval[1]):
            told = ["too few runs"]
        if pair.seeds_needed is not None:
            told.append(f"about {seeds(pair.seeds_needed)} would decide")
    if environment.looks:
        told.append(f"with {seeds(pair.n)}")
    return f"{pair.second} ({'; '.join(told)})"


def unseen_sentence(analysis: StudyAnalysis) -> str:
    """What this many runs cannot show; once on every page."""
    counts = [agent.runs.n for one in analysis.environments for agent in one.agents]
    n = min(counts, default=0)
    if not n:
        return ""
    runs = "1 run" if n == 1 else f"{n:,} runs"
    share = f"{100 * unseen_share(n):.2g} % of further runs"
    return f"A failure that no run showed is not counted: with {runs} up to {share} could fail."


def speed_sentences(environment: EnvironmentAnalysis) -> Iterator[str]:
    """How many runs reach the threshold and stay there, and from which step."""
    told = [
        (agent.agent, agent.steps_to_stay.share_reached, agent.steps_to_stay.median.point)
        for agent in environment.agents
        if agent.steps_to_stay is not None and agent.steps_to_stay.share_reached.n
    ]
    arrived = sorted((one for one in told if one[1].point > 0), key=lambda one: one[2])
    if len(told) < 2 or not arrived:
        return
    threshold, optimum, baseline = environment.threshold, environment.optimum, environment.baseline
    goal = f"a return of {number(threshold)}"
    if threshold is not None and optimum is not None and baseline is not None:
        share = (threshold - baseline) / (optimum - baseline) if optimum > baseline else 0.0
        goal = "a score of 0.95" if math.isclose(share, 0.95) else goal
    parts: list[str] = []
    for name, share_of, steps in arrived:
        stays = "" if parts else f"stays above {goal} "
        parts.append(f"{name} {stays}in {round(share_of.point * share_of.n)} of {share_of.n} runs")
        if not math.isinf(steps):
            parts[-1] += f", in the median run from step {steps:,.0f}"
    never = [name for name, share_of, _ in told if share_of.point == 0]
    if never:
        parts.append(f"{enumeration(never)} in none")
    yield f"{'; '.join(parts)}."


class Conclusion(NamedTuple):
    """The sentences on an environment."""

    lead: str  # who is best, and the optimum
    pairs: tuple[str, ...]  # every word, with figures; several in a sentence
    # Failures, how soon agents arrive, training on variants, missing runs, the number of looks.
    notes: tuple[str, ...]

    @property
    def everything(self) -> tuple[str, ...]:
        """All sentences."""
        return (self.lead, *self.pairs, *self.notes)


def conclusion(study: StudySpec, environment: EnvironmentAnalysis) -> Conclusion:
    """What a study has shown on one environment."""
    notes = [
        *_on_the_task(environment),
        *speed_sentences(environment),
        *_on_what_cannot_be_compared(study, environment),
        *on_changes([environment]),
        *_on_runs(study, environment),
    ]
    pairs = tuple(pair_sentences(environment))
    return Conclusion(_lead(study, environment), pairs, tuple(notes))


def answer(analysis: StudyAnalysis) -> list[str]:
    """Who is best, how certain that is, what failed, and what it cost: short sentences."""
    places, sentences = analysis.environments, [*_standing(analysis)]
    unlearnt = [one.environment for one in places if none_has_learnt(analysis.study, one)]
    if unlearnt and len(places) > 1:
        sentences.append(f"No agent has learnt on {_names(unlearnt)}.")
    failed, n = Counter[str](), Counter[str]()
    for one in places:
        failed.update({agent.agent: agent.runs.failed or 0 for agent in one.agents})
        n.update({agent.agent: agent.runs.n for agent in one.agents})
    told = [f"{name} {k} of {n[name]:,}" for name, k in failed.most_common() if k]
    if any(one.failure_threshold is not None for one in places):
        sentences.append(f"Failed runs: {_names(told) or 'none'}.")
    if n_missing := sum(sum(one.missing.values()) for one in places):
        sentences.append(f"Missing runs: {n_missing:,}.")
    costs = sorted((cost, who) for who, cost in processor_seconds(analysis.results).items())
    if costs:
        ends = [
            f"{duration(cost)} ({agent}{f' on {place}' if len(places) > 1 else ''})"
            for cost, (agent, place) in costs[:: max(len(costs) - 1, 1)]
        ]
        sentences.append(f"Processor time of the median run: {' to '.join(ends)}.")
    return sentences


def _standing(analysis: StudyAnalysis) -> Iterator[str]:
    """Who has the highest means, and the words on the pairs of that agent."""
    study, places, overall = analysis.study, analysis.environments, analysis.overall
    known = [one for one in places if not math.isnan(one.agents[0].runs.mean)]
    learnt = [one for one in known if not none_has_learnt(study, one)]
    names = list(dict.fromkeys(agent.agent for one in places for agent in one.agents))
    if places and (not known or (len(places) == 1 and (not learnt or len(names) == 1))):
        yield _lead(study, places[0])
    if len(names) == 1 and overall is not None:
        mean = score_number(overall.scores[names[0]].mean.point)
        yield f"{names[0]} has a mean score of {mean} over all environments."
    if not learnt or len(names) == 1:
        return
    firsts = Counter(name for one in learnt for name in with_best_mean(one))
    order = names if overall is None else list(overall.scores)
    best = [name for name in order if firsts[name] == max(firsts.values())]
    has, each = ("has", "") if len(best) == 1 else ("have", " each")
    over = seeds(*(agent.runs.n for one in learnt for agent in one.agents))
    what, first = study.metric_words.removeprefix("mean "), learnt[0].agents[0]
    where = f": {number(first.metric.mean.point)}"
    if all(one.is_score for one in learnt):
        what, where = "score", f": {score_number(first.runs.mean)}"
    if len(places) > 1:
        where = f" in {firsts[best[0]]} of {len(places)} environments{each}"
    end = "lowest" if study.metric in COSTS else "highest"
    yield f"With {over}, {_names(best)} {has} the {end} mean {what}{where}."
    said: dict[str, list[Pair]] = {}
    everything = [p for one in learnt for p in pairs_both_ways(one.pairs).values()]
    for pair in everything:
        if pair.first == best[0]:
            said.setdefault(pair.text, []).append(pair)
    for text, pairs in sorted(said.items()):
        if text == "undecided":
            named = {(pair.environment, pair.second) for pair in pairs}
            open_ = [p for p in everything if p.text == text and (p.environment, p.second) in named]
            more = [pair.seeds_needed - pair.n for pair in open_ if pair.seeds_needed is not None]
            would = f" ({seeds(max([1, *more])).replace(' ', ' more ')} would)"
            would = would if len(more) == len(open_) else ""
            yield f"Not settled: {_others(pairs, len(places))}{would}."
        else:
            word, _, few = text.partition(" ")
            relation = f"{word} {'with' if word == 'tied' else 'than'}"
            start = f"{best[0]} is {relation} {_others(pairs, len(places))}"
            yield f"{'So far, with few runs' if few else 'Certain'}: {start}."
    if overall is not None and overall.best is not None:
        yield f"By the mean score over all environments, best: {overall.best}."


def _others(pairs: Sequence[Pair], n_places: int) -> str:
    """The second agents, with the number of their environments if there are several."""
    numbers: dict[int, list[str]] = {}
    for name, n in Counter(pair.second for pair in pairs).most_common():
        numbers.setdefault(n, []).append(name)
    told = [f"{_names(names)}{f' in {n}' if n_places > 1 else ''}" for n, names in numbers.items()]
    return "; ".join(told)


def with_best_mean(environment: EnvironmentAnalysis, *labels: Sequence[str]) -> list[str]:
    """Which of the agents with these labels, or of all, have the best mean."""
    known = set().union(*labels or [[agent.agent for agent in environment.agents]])
    means = {a.agent: a.metric.mean.point for a in environment.agents if a.agent in known}
    best = next(iter(means.values()), math.nan)
    return [label for label, mean in means.items() if math.isclose(mean, best)]


def processor_seconds(results: StudyResults) -> dict[tuple[str, str], float]:
    """Median CPU seconds of a run by agent and environment, if all their runs were measured."""
    times = results.summary.astype({"cpu_seconds": float})
    grouped = times.groupby(["agent", "environment"], sort=False)["cpu_seconds"]
    medians = grouped.agg(lambda runs: runs.median(skipna=False)).dropna()
    rows = medians.reset_index().itertuples(index=False)
    return {(agent, environment): time for agent, environment, time in rows}


def duration(time: float) -> str:
    """Seconds with two significant digits."""
    if time <= 0:
        return "0 s"
    digits = 1 - math.floor(math.log10(time))
    return f"{round(time, digits):,.{max(digits, 0)}f} s"


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


def _lead(study: StudySpec, environment: EnvironmentAnalysis) -> str:
    agents, words = environment.agents, study.metric_words
    if math.isnan(agents[0].runs.mean):
        hint = "" if math.isnan(agents[0].regret.point) else "; bandits have --metric regret"
        return f"No run has a figure for the {words}{hint}."
    optimum = ""
    if study.metric in ON_THE_SCALE and environment.optimum is not None:
        optimum = f"; the optimum is {optimum_words(environment)}"
    if none_has_learnt(study, environment):
        figure = f"the best mean {words} is {number(agents[0].metric.mean.point)}"
        return (
            "None of the agents has learnt: no median is above the best random or constant "
            f"policy's {number(environment.baseline)}; {figure}{optimum}."
        )
    if len(agents) > 1:
        return f"Best: {environment.best}{optimum}."
    (one,) = agents
    score = f", score {score_number(one.runs.mean)}" if environment.is_score else ""
    return f"{one.agent}: {words} {number(one.metric.mean.point)}{score}{optimum}."


def none_has_learnt(study: StudySpec, environment: EnvironmentAnalysis) -> bool:
    """Whether no median exceeds the best random or constant policy by more than the margin."""
    baseline, optimum = environment.baseline, environment.optimum
    if study.metric not in ON_THE_SCALE or baseline is None or optimum is None:
        return False
    margin = environment.margin * (optimum - baseline if environment.is_score else 1.0)
    reach = baseline + margin
    medians = [agent.metric.median.point for agent in environment.agents]
    return optimum > baseline and all(median <= reach for median in medians)


def _on_the_task(environment: EnvironmentAnalysis) -> Iterator[str]:
    """Failed runs; settings that change the environment, and so the optimum; what is hidden."""
    failed = [
        f"{agent.runs.failed} of {agent.runs.n} runs of {agent.agent} failed"
        for agent in environment.agents
        if agent.runs.failed
    ]
    if failed:
        yield f"{enumeration(failed)}."
    if environment.optima:
        each = [f"{number(optimum)} for {name}" for name, optimum in environment.optima.items()]
        yield (
            f"The agents do NOT PLAY THE SAME ENVIRONMENT: the optimum is {enumeration(each)}. "
            "Their returns cannot be compared."
        )
    if words := scale_words(environment):
        yield f"{words[0].upper()}{words[1:]}."


def _on_what_cannot_be_compared(
    study: StudySpec, environment: EnvironmentAnalysis
) -> Iterator[str]:
    """Returns above the upper bound on the optimum; training returns of another environment."""
    names = environment.impossible
    if names:
        verb = "has" if len(names) == 1 else "have"
        yield (
            f"{enumeration(names)} {verb} MORE THAN ANY POLICY CAN REACH, "
            f"{number(environment.optimum)}: the bracket belongs to another environment, or is "
            f"wrong{'.' if environment.optimum_is_proven else '; its upper end is not proven.'}"
        )
    names = tuple(agent.agent for agent in environment.agents if agent.changes)
    if names and study.metric in OF_TRAINING:
        verb = "was" if len(names) == 1 else "were"
        yield (
            f"{enumeration(names)} {verb} trained on a changed environment: training returns are "
            "those of that one."
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


def _on_runs(study: StudySpec, environment: EnvironmentAnalysis) -> Iterator[str]:
    """Which runs are missing, and how often a growing study is looked at."""
    for agent, n_missing in environment.missing.items():
        n_seeds = environment.seeds.get(agent, study.n_seeds)
        if n_missing == n_seeds:
            yield f"No run of {agent} has finished."
        elif n_missing:
            verb = "is" if n_missing == 1 else "are"
            yield f"{n_missing} of {n_seeds} runs of {agent} {verb} missing."
    if n := len(environment.looks):
        looks = "1 look" if n == 1 else f"up to {n} looks"
        sizes = enumeration([f"{size:,}" for size in environment.looks])
        yield f"Agents got more seeds until they were decided: {looks}, at {sizes} seeds."


# A part below this share of the gap has no line.
LEAST_SHARE = 0.02
# The least share of the gap that a change closes to count as a remedy.
REMEDY = 0.05
MOST_STATES = 3


def why_lines(explained: Explanation) -> list[str]:
    """How episodes end, the gap and its parts, the gap in the agent's own objective, its states."""
    if explained.is_optimal:
        return [f"optimal: it returns {explained.value:.6g}, and no policy returns more"]
    gap, optimum = explained.gap, explained.optimum
    told = [
        explained.ending,
        f"gap {gap:.4g}: it returns {explained.value:.6g}, the optimum is {optimum:.6g}",
    ]
    told += [
        f"  {part.loss:>9.4g} {part.name}: {part.meaning}"
        for part in explained.parts
        if part.name == "not observable" or abs(part.loss) >= LEAST_SHARE * gap
    ]
    if explained.own_gap is not None:
        own = f"in its own objective, at discount {explained.discount:g}"
        told.append(f"the gap at the start {own}: {explained.own_gap:.4g}")
    if explained.is_concentrated:
        worst = explained.states[:MOST_STATES]
        told += [_state(state, gap) for state in worst if state.loss >= LEAST_SHARE * gap]
    elif explained.road:
        told.append(explained.road)
    # States of one name: the one that loses most.
    acts = {
        one.name: f" ({one.best}, not {one.action})" * (one.best != one.action)
        for one in reversed(explained.states)
    }
    regained = [
        f"{place}{acts.get(place, '')}: {reached:.5g}, "
        f"{(reached - explained.value) / gap:.1%} of the gap regained"
        for place, reached in explained.repairs
    ]
    if regained:
        told.append(f"with the best action at each step in {'; and in '.join(regained)}")
    return told


@dataclass(frozen=True)
class Why:
    """The explanation of one run."""

    lines: list[str]
    proposal: str | None  # a change that may help, as ``explain --test`` takes it


def whys_of(runs: Sequence[PlannedRun]) -> list[Why | None]:
    """Explain each run; None where its gap cannot be split.

    Call this in a child process: it loads PyTorch.
    """
    from rl_yardstick.diagnosis.explanation import explanation
    from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
    from rl_yardstick.pipeline.models import load_agent, model_of_run

    told: list[Why | None] = []
    for run in runs:
        told.append(None)
        with suppress(UserError, OSError):
            import_modules(run.spec.gym_packages)
            if (evaluator := exact_evaluator(run.spec)) is not None:
                found = explanation(run.spec, load_agent(model_of_run(run.run)), evaluator)
                told[-1] = Why(why_lines(found), next(map(as_words, found.proposals), None))
    return told


def _state(state: StateLoss, gap: float) -> str:
    """The loss in one state, and the agent's estimates of its actions' values."""
    share = f"{state.loss / gap:.0%} of the gap"
    text = f"  {state.name}: {share}, {state.visits:.3g} visits an episode; "
    text += f"it does {state.action}, where {state.best} is best"
    if state.action == state.best:
        text = f"  {state.name}: {share}, {state.visits:.3g} visits an episode; {state.action} is "
        text += "best on average, but not with few steps left"
    elif state.believed is not None and state.true is not None:
        told = [f"believes {value:.4g}" for value in state.believed]
        told = [f"{one}, truly {true:.4g}" for one, true in zip(told, state.true, strict=True)]
        if state.updates is not None:
            told = [f"{one}, {n:,} updates" for one, n in zip(told, state.updates, strict=True)]
        text += f" ({state.action}: {told[0]}; {state.best}: {told[1]})"
    return text


def as_words(change: str) -> str:
    """A change as it is typed in a shell."""
    return " ".join(map(shlex.quote, change.split()))


def tried_lines(tried: Sequence[Tried], optimum: float) -> list[str]:
    """The returns of each change by seed, and which change helps most; a hint and no verdict."""
    width = max(len(one.change) for one in tried)
    told = []
    for one in tried:
        returns = " ".join(f"{value:.5g}" for value in one.finished)
        mean = f"mean {one.mean:.5g}, {returns}" if returns else "no run finished"
        told.append(f"  {one.change:<{width}}  {mean}")
    before = next(one for one in tried if one.change.endswith(AS_IT_IS))
    gap, n_seeds = optimum - before.mean, len(before.returns)
    if not 1e-9 * max(1.0, abs(optimum)) < gap < np.inf:
        nothing = "as it is, every run is optimal" if gap < np.inf else "nothing to compare with"
        return [*told, nothing]
    helpful: dict[str, tuple[float, int]] = {}
    for one in tried:
        least = np.minimum(before.returns + REMEDY * gap, optimum - REMEDY * gap)
        closed, n_better = (one.mean - before.mean) / gap, int((one.returns >= least).sum())
        if closed >= REMEDY and 2 * n_better >= n_seeds:
            helpful[one.change] = closed, n_better
    changes = {change: found for change, found in helpful.items() if change != SHIPPED}
    if not changes:
        told.append(f"no change closes {REMEDY:.0%} of the gap and helps half of the seeds")
    if helpful:
        change = max(changes or helpful, key=helpful.__getitem__)
        closed, n_better = helpful[change]
        share = f"closes {closed:.0%} of the gap on average"
        told.append(f"{change} helps most: it {share}, in {n_better} of {n_seeds} seeds")
    return [*told, "four seeds are a hint, compare.py gives a verdict"]
