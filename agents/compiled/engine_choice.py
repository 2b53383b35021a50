"""Whether a training runs compiled or interpreted."""

from __future__ import annotations

from typing import Any, Literal

from stable_baselines3.common.callbacks import BaseCallback

from agents.common.callback_horizons import unknown_callbacks
from agents.compiled.compile_envs import NotCompilable, compile_envs, draws_alike
from agents.compiled.engine import CompiledEngine
from agents.compiled.kept_worlds import World
from agents.compiled.learning_algorithm import LearningAlgorithm, compiled_schedule

EngineChoice = Literal["auto", "compiled", "interpreted"]

# What a class may say anew in Python: all of it ends up in the settings, schedules, tables and the
# memory that compiled functions are handed.
SETTINGS = (
    "__dict__",
    "__init__",
    "__weakref__",
    "_check_arguments",
    "_make_exploration_schedule",
    "_make_memory",
    "_make_policy",
    "_memory_in_use",
    "strategy",
    "tie_scale",
    "averages_samples",
)


def choose_engine(
    agent: Any, callback: BaseCallback, log_interval: int | None
) -> CompiledEngine | None:
    """The compiled engine where the agent wants it and it can be had; None for interpreting.

    An environment that draws in its own way is equal to its compiled copy in distribution alone:
    such a copy has to be asked for, so that results do not hang on what else kept an agent from
    compiling. The choice and its reason are left in ``agent.engine_in_use``.

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
    if not draws_alike(agent.env):
        if agent.engine == "auto":
            agent.engine_in_use = (
                "interpreted: the environment draws in its own way, so that compiled training "
                "is equal in distribution only (engine: compiled takes that)"
            )
            return None
        agent.engine_in_use = "compiled, not bit for bit: the environment draws in its own way"
    return CompiledEngine(agent, world, callback, log_interval)


def _world_for(agent: LearningAlgorithm, callback: BaseCallback) -> World:
    check_class(type(agent))
    for name in vars(agent):
        if callable(vars(agent)[name]) and callable(getattr(type(agent), name, None)):
            raise NotCompilable(f"this agent has a {name} of its own in Python")
    unknown = unknown_callbacks(callback)
    if unknown:
        raise NotCompilable(f"{', '.join(unknown)} must be asked after each step")
    agent.check_compilable()
    for schedule in agent.schedules().values():
        compiled_schedule(schedule)
    assert agent.env is not None
    return compile_envs(agent.env)


def check_class(algorithm: type) -> None:
    """Make sure that compiled functions do all that the algorithm does at a step.

    Raises:
        NotCompilable: naming what a class of its own does in Python instead.
    """
    order = algorithm.__mro__
    for place, cls in enumerate(order[: order.index(LearningAlgorithm)]):
        if cls.__module__.startswith("agents."):
            continue
        above = [vars(base) for base in order[place + 1 :] if base is not object]
        for name, value in vars(cls).items():
            in_python = hasattr(value, "__get__") and not hasattr(value, "py_func")
            replaces = any(name in names for names in above) or name in _settings(algorithm)
            if in_python and replaces and name not in SETTINGS:
                raise NotCompilable(f"{algorithm.__name__} has a {name} of its own in Python")


def _settings(algorithm: Any) -> tuple[str, ...]:
    """Names of what compiled functions are told of an agent."""
    return tuple(algorithm.settings_type.names)
