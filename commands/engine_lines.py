"""What is said of engines before a training begins: which one it is, and what each takes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from stable_baselines3.common.callbacks import CallbackList

from agents.common.callback_horizons import members, unknown_callbacks
from agents.networks.engine_costs import compiling_seconds, machine_pace

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from agents.networks.engine_setting import EnginePlan
    from pipeline.engine_outlook import EngineOutlook

LIBRARY = "library (Stable-Baselines3's own loop)"
HOW_NOT_TO_BE_ASKED = (
    "made a BlockCallback, it would be asked only when it acts (docs/training.md#from-python)"
)
MINUTE, HOUR = 60.0, 3600.0


def about(seconds: float) -> str:
    """A time that is known to a factor of two."""
    if seconds < 1:
        return "less than 1 s"
    if seconds < 2 * MINUTE:
        return f"about {seconds:.0f} s"
    if seconds < 2 * HOUR:
        return f"about {seconds / MINUTE:.0f} min"
    return f"about {seconds / HOUR:.0f} h"


def training_line(
    outlook: EngineOutlook | None, model: BaseAlgorithm, callback: BaseCallback
) -> str:
    """The line of one training; empty where there is nothing to say of its engine."""
    asked = _of_the_users(callback)
    if outlook is None:
        if not asked or getattr(model, "engine", "compiled") != "auto":
            return ""
        return (
            f"interpreted, about a hundred times slower or more: {', '.join(asked)} must be asked "
            f"after each step; {HOW_NOT_TO_BE_ASKED}"
        )
    pace = machine_pace()
    advice = ""
    if asked and outlook.auto.is_compiled:
        advice = f"; {HOW_NOT_TO_BE_ASKED}"
        if outlook.work is not None:
            advice += f", and training take {about(outlook.work.compiled_seconds * pace)}"
    line = _words(outlook.plan, outlook, pace, "of processor time")
    if outlook.plan.is_compiled:
        return f"{line}{_in_brackets(outlook, pace)}{advice}"
    if outlook.auto.is_compiled:
        line += f"; --engine auto: {_auto_words(outlook, pace)}"
    return f"{line}{advice}"


def _of_the_users(callback: BaseCallback) -> list[str]:
    """Names of the callbacks that must be asked after each step and are not this project's."""
    told = [each for each in members(callback) if not isinstance(each, CallbackList)]
    theirs = [each for each in told if not type(each).__module__.startswith("pipeline.")]
    return [name for each in theirs for name in unknown_callbacks(each)]


def _words(plan: EnginePlan, outlook: EngineOutlook, pace: float, unit: str) -> str:
    """An engine, what it takes, and why it is not another."""
    name = str(plan).partition(":")[0] if plan.is_compiled else LIBRARY
    reason = plan.in_python or plan.reason
    return f"{name}{_takes(plan, outlook, pace, unit)}{': ' if reason else ''}{reason}"


def _auto_words(outlook: EngineOutlook, pace: float) -> str:
    why = f" but for the environment ({outlook.auto.in_python})" if outlook.auto.in_python else ""
    taken = _takes(outlook.auto, outlook, pace, "")
    return f"the same networks and updates compiled{why}{taken}"


def _takes(plan: EnginePlan, outlook: EngineOutlook, pace: float, unit: str) -> str:
    work = outlook.work
    if work is None:
        return ""
    text = f", {about(seconds_of(plan, outlook) * pace)} {unit}".rstrip()
    compiling = compiling_seconds(work) * pace if plan.is_compiled else 0.0
    return f"{text} and once {about(compiling)} of compiling" if compiling else text


def _in_brackets(outlook: EngineOutlook, pace: float) -> str:
    """What the library's loop would take."""
    if outlook.work is None:
        return ""
    return f" (Stable-Baselines3's own loop: {about(outlook.work.library_seconds * pace)})"


def seconds_of(plan: EnginePlan, outlook: EngineOutlook) -> float:
    """What a training takes where the constants were measured; 0 where nobody knows."""
    if outlook.work is None:
        return 0.0
    if not plan.is_compiled:
        return outlook.work.library_seconds
    return outlook.work.bridged_seconds if plan.in_python else outlook.work.compiled_seconds


def study_line(planned: Sequence[tuple[str, EngineOutlook, int]]) -> str:
    """The line of many trainings; empty where there are none with networks.

    Args:
        planned: labels of agents, the outlooks of their runs, and how many runs each stands for.
    """
    pace, parts = machine_pace() if planned else 1.0, []
    for is_compiled in (False, True):
        group = [each for each in planned if each[1].plan.is_compiled is is_compiled]
        if not group:
            continue
        names = ", ".join(dict.fromkeys(label for label, _, _ in group))
        n_runs = sum(count for _, _, count in group)
        runs = "1 run" if n_runs == 1 else f"{n_runs} runs"
        taken = _all([(outlook, outlook.plan, n) for _, outlook, n in group], pace)
        parts.append(
            f"{names}: {'compiled' if is_compiled else LIBRARY}{taken}"
            f"{' of processor time' if taken else ''} in {runs}"
        )
        if not is_compiled and any(outlook.auto.is_compiled for _, outlook, _ in group):
            taken = _all([(outlook, outlook.auto, n) for _, outlook, n in group], pace)
            parts.append(f"with --engine auto compiled{taken}")
    return "; ".join(parts)


def _all(trainings: Sequence[tuple[EngineOutlook, EnginePlan, int]], pace: float) -> str:
    """What they take together; empty where nobody knows it of one."""
    if any(outlook.work is None for outlook, _, _ in trainings):
        return ""
    seconds = sum(seconds_of(plan, outlook) * n for outlook, plan, n in trainings)
    return f", {about(seconds * pace)}"


def search_line(algo: str, search: EngineOutlook | None, retest: EngineOutlook | None) -> str:
    """The line of a search and its re-test, of one run each; empty where both are the same."""
    if search is None or retest is None:
        return ""
    pace = machine_pace()
    searched = _words(search.plan, search, pace, "of processor time a run")
    if search.plan.is_compiled == retest.plan.is_compiled:
        return f"search and re-test: {searched}"
    again = _words(retest.plan, retest, pace, "a run")
    return (
        f"search: {searched}; re-test: {again}, in which train runs {algo}; "
        "--engine auto re-tests compiled, for who trains so"
    )
