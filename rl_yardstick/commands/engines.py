"""The engine of trainings in words: which one, how long it takes, and what another would take."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rl_yardstick.pipeline.spec import TrainSpec

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback

    from rl_yardstick.agents.networks.engine_setting import EnginePlan, Work

# The library's agents that have compiled networks too.
NETWORKS = frozenset({"dqn", "double_dqn", "deep_qlearning", "ppo", "a2c"})


@dataclass(frozen=True)
class EngineOutlook:
    """The engine of a training, and its alternative."""

    plan: EnginePlan  #: the engine of the training
    auto: EnginePlan  #: the choice of ``engine: auto``
    work: Work | None  #: None if the time of an environment step is unknown


def engine_outlook(
    agent: BaseAlgorithm, spec: TrainSpec, callbacks: list[BaseCallback]
) -> EngineOutlook | None:
    """The outlook of an agent; None if it has no compiled networks."""
    if spec.algo not in NETWORKS or agent.env is None:
        return None
    from rl_yardstick.agents.compiled.env_states import observed_world
    from rl_yardstick.agents.compiled.worlds import NotCompilable
    from rl_yardstick.agents.networks.engine_setting import CompiledNetworks

    if not isinstance(agent, CompiledNetworks):
        return None
    plan = agent.engine_plan(spec.total_timesteps, callbacks)
    auto = agent.engine_plan(spec.total_timesteps, callbacks, "auto")
    work = None
    with suppress(NotCompilable):
        observed_world(agent.env)
        work = agent.work(spec.total_timesteps, callbacks)
    return EngineOutlook(plan, auto, work)


def planned_outlook(spec: TrainSpec) -> EngineOutlook | None:
    """The outlook of a run in another process, which reports any errors itself."""
    if spec.algo not in NETWORKS:
        return None
    from rl_yardstick.agents.common.callbacks import EpisodeBudget
    from rl_yardstick.pipeline.training import make_agent

    with suppress(Exception), warnings.catch_warnings(action="ignore"):
        agent = make_agent(spec, None)
        assert agent.env is not None
        with closing(agent.env):
            callbacks = [] if spec.n_episodes is None else [EpisodeBudget(spec.n_episodes)]
            return engine_outlook(agent, spec, [*callbacks])
    return None


# --- engines in words -----------------------------------------------------------------------------


LIBRARY = "library (Stable-Baselines3's own loop)"

HOW_NOT_TO_BE_ASKED = (
    "made a BlockCallback, it would be asked only when it acts (docs/training.md#from-python)"
)


def about(seconds: float) -> str:
    """A time that is known up to a factor of two."""
    if seconds < 1:
        return "less than 1 s"
    if seconds < 120:
        return f"about {seconds:.0f} s"
    if seconds < 7200:
        return f"about {seconds / 60:.0f} min"
    return f"about {seconds / 3600:.0f} h"


def training_line(
    outlook: EngineOutlook | None, model: BaseAlgorithm, callback: BaseCallback
) -> str:
    """The line on the engine of one training; empty if there is nothing to say."""
    from stable_baselines3.common.callbacks import CallbackList

    from rl_yardstick.agents.common.callbacks import members, unknown_callbacks
    from rl_yardstick.agents.networks.engine_setting import machine_pace

    # The user's own callbacks that must be called after each step.
    told = [each for each in members(callback) if not isinstance(each, CallbackList)]
    theirs = [
        each for each in told if not type(each).__module__.startswith("rl_yardstick.pipeline.")
    ]
    asked = [name for each in theirs for name in unknown_callbacks(each)]
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
        if outlook.work is not None:
            taken = about(outlook.work.library_seconds * pace)
            line += f" (Stable-Baselines3's own loop: {taken})"
    elif outlook.auto.is_compiled:
        why = f" but for the environment ({outlook.auto.in_python})" * bool(outlook.auto.in_python)
        taken = _takes(outlook.auto, outlook, pace, "")
        line += f"; --engine auto: the same networks and updates compiled{why}{taken}"
    return f"{line}{advice}"


def _words(plan: EnginePlan, outlook: EngineOutlook, pace: float, unit: str) -> str:
    """An engine, its expected time, and the reason why it is not another."""
    name = str(plan).partition(":")[0] if plan.is_compiled else LIBRARY
    reason = plan.in_python or plan.reason
    return f"{name}{_takes(plan, outlook, pace, unit)}{': ' if reason else ''}{reason}"


def _takes(plan: EnginePlan, outlook: EngineOutlook, pace: float, unit: str) -> str:
    work = outlook.work
    if work is None:
        return ""
    from rl_yardstick.agents.networks.engine_setting import compiling_seconds

    text = f", {about(seconds_of(plan, outlook) * pace)} {unit}".rstrip()
    compiling = compiling_seconds(work) * pace if plan.is_compiled else 0.0
    return f"{text} and once {about(compiling)} of compiling" if compiling else text


def seconds_of(plan: EnginePlan, outlook: EngineOutlook) -> float:
    """Seconds of a training on the machine of the measured constants; 0 if unknown."""
    if outlook.work is None:
        return 0.0
    if not plan.is_compiled:
        return outlook.work.library_seconds
    return outlook.work.bridged_seconds if plan.in_python else outlook.work.compiled_seconds


def study_line(planned: Sequence[tuple[str, EngineOutlook, int]]) -> str:
    """The line on the engines of many trainings; empty if none has networks.

    ``planned`` has labels of agents, the outlooks of their runs, and the numbers of their runs.
    """
    from rl_yardstick.agents.networks.engine_setting import machine_pace

    pace, parts = machine_pace() if planned else 1.0, []
    for is_compiled in (False, True):
        group = [each for each in planned if each[1].plan.is_compiled is is_compiled]
        if not group:
            continue
        names = ", ".join(dict.fromkeys(label for label, _, _ in group))
        n_runs = sum(count for _, _, count in group)
        runs = "1 run" if n_runs == 1 else f"{n_runs} runs"
        taken = _together([(outlook, outlook.plan, n) for _, outlook, n in group], pace)
        parts.append(
            f"{names}: {'compiled' if is_compiled else LIBRARY}{taken}"
            f"{' of processor time' if taken else ''} in {runs}"
        )
        if not is_compiled and any(outlook.auto.is_compiled for _, outlook, _ in group):
            taken = _together([(outlook, outlook.auto, n) for _, outlook, n in group], pace)
            parts.append(f"with --engine auto compiled{taken}")
    return "; ".join(parts)


def _together(trainings: Sequence[tuple[EngineOutlook, EnginePlan, int]], pace: float) -> str:
    """The expected time of all trainings together; empty if that of one is unknown."""
    if any(outlook.work is None for outlook, _, _ in trainings):
        return ""
    seconds = sum(seconds_of(plan, outlook) * n for outlook, plan, n in trainings)
    return f", {about(seconds * pace)}"


def search_line(algo: str, search: EngineOutlook | None, retest: EngineOutlook | None) -> str:
    """The line on the engines of a search and its re-test, for one run; empty without outlooks."""
    if search is None or retest is None:
        return ""
    from rl_yardstick.agents.networks.engine_setting import machine_pace

    pace = machine_pace()
    searched = _words(search.plan, search, pace, "of processor time a run")
    if search.plan.is_compiled == retest.plan.is_compiled:
        return f"search and re-test: {searched}"
    again = _words(retest.plan, retest, pace, "a run")
    return (
        f"search: {searched}; re-test: {again}, in which train runs {algo}; "
        "--engine auto re-tests compiled, if you train with it"
    )
