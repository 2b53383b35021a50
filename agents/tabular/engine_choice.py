"""Whether a training runs compiled or interpreted."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stable_baselines3.common.callbacks import BaseCallback

from agents.common.callback_horizons import unknown_callbacks
from agents.common.schedules import schedule_row
from agents.tabular import rollout
from agents.tabular.engine import CompiledEngine
from agents.tabular.simulator import World
from agents.tabular.worlds import NotCompilable, compile_world

if TYPE_CHECKING:
    from agents.tabular.base import TabularAlgorithm

# Where the agents are defined whose rules the engine knows; a subclass may change anything.
ALGORITHMS = "agents.tabular.algorithms"


def choose_engine(
    agent: TabularAlgorithm, callback: BaseCallback, log_interval: int | None
) -> CompiledEngine | None:
    """The compiled engine where the agent wants it and it can be had; None for interpreting.

    The choice and its reason are left in ``agent.engine_in_use``.

    Raises:
        ValueError: if the agent insists on compiled and it cannot be had.
    """
    if agent.engine == "interpreted":
        agent.engine_in_use = "interpreted: asked for"
        return None
    try:
        world = _world_for(agent, callback)
    except NotCompilable as reason:
        if agent.engine == "compiled":
            raise ValueError(f"engine: compiled is not possible: {reason}") from None
        agent.engine_in_use = f"interpreted: {reason}"
        return None
    agent.engine_in_use = "compiled"
    return CompiledEngine(agent, world, callback, log_interval)


def must_compile(agent: TabularAlgorithm) -> bool:
    """Whether training will compile the loop first, since no earlier run has left it behind."""
    cache = Path(rollout.__file__).parent / "__pycache__"
    return agent.engine != "interpreted" and not any(cache.glob("rollout.run_block-*.nbi"))


def _world_for(agent: TabularAlgorithm, callback: BaseCallback) -> World:
    if type(agent).__module__ != ALGORITHMS:
        raise NotCompilable(f"{type(agent).__name__} may act and learn in its own way")
    unknown = unknown_callbacks(callback)
    if unknown:
        raise NotCompilable(f"{', '.join(unknown)} must be asked after each step")
    for schedule in (agent.exploration_schedule, agent.lr_schedule):
        if schedule_row(schedule) is None:
            raise NotCompilable("a schedule is a Python function")
    assert agent.env is not None
    return compile_world(agent.env)
