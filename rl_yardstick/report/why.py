"""An explanation in words: where an agent loses return, in at most twelve lines."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rl_yardstick.pipeline.components import import_modules
from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from rl_yardstick.diagnosis.explanation import Explanation, StateLoss
    from rl_yardstick.experiments.plan import PlannedRun
    from rl_yardstick.experiments.results import Tried

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
    regained = [
        f"{place}: {reached:.5g}, {(reached - explained.value) / gap:.1%} of the gap regained"
        for place, reached in explained.repairs
    ]
    if regained:
        told.append(f"with the best action in {'; and in '.join(regained)}")
    return told


@dataclass(frozen=True)
class Why:
    """The explanation of one run."""

    lines: list[str]
    proposal: str | None  # a change that may help, as ``explain.py --test`` takes it


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
    from rl_yardstick.experiments.study import AS_IT_IS, SHIPPED

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
