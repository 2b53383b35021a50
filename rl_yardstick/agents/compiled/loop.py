"""The compiled training loop, and the dispatch to the functions that it calls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba.core import types
from numba.extending import overload
from numpy.typing import NDArray

from rl_yardstick.agents.common.schedules import schedule_value
from rl_yardstick.machine_code.compiling import (
    INLINED_OPTIONS,
    IS_INTERPRETED,
    PART_OPTIONS,
    RULE_PREFIX,
    PartCompiler,
    inlined,
    kernel,
)
from rl_yardstick.mdp.transition_model import Floats

# Dispatch by type: the compiler decides which function a loop calls.
#
# A loop calls ``act(agent, ...)`` or ``step(world, ...)``. For an environment, the function is the
# attribute of that name of the world's class. For an agent, it is the attribute of the algorithm's
# class, which the settings record names. So each pair of environment and algorithm has its own
# loop without look-ups, and a new environment or algorithm is a class in its own file.

Function = TypeVar("Function", bound=Callable[..., object])

_ALGORITHMS: dict[str, type] = {}
_DEFINITIONS: Counter[str] = Counter()
_NAMES: set[str] = set()


def by_type_or_this(stub: Function) -> Function:
    """As `by_type`; the function itself serves the classes that have none of that name."""
    return by_type(stub, stub)


def by_type(stub: Function, default: Function | None = None) -> Function:
    """Make a compiled function that calls the function of that name of its first argument.

    It exists in compiled code only.
    """
    if IS_INTERPRETED:
        raise RuntimeError("agents need Numba's compiler: unset NUMBA_DISABLE_JIT")
    name = stub.__name__
    _NAMES.add(name)

    def choose(thing: Any, *others: Any) -> Any:
        return getattr(getattr(_class_of(thing), name, None), "py_func", default)

    options: Any = {**INLINED_OPTIONS, **PART_OPTIONS, "pipeline_class": PartCompiler}
    overload(stub, strict=False, jit_options=options)(choose)
    return stub


def _class_of(argument: Any) -> type | None:
    """The world's class, or the class of the algorithm that the settings record names."""
    # A reference has the class of its target.
    argument = getattr(argument, "content", argument)
    if not isinstance(argument, types.BaseNamedTuple):
        return None
    kind: Any = argument
    if "settings" in kind.fields:
        record = kind.types[kind.fields.index("settings")]
        return next((_ALGORITHMS[name] for name in record.fields if name in _ALGORITHMS), None)
    chosen: type = kind.instance_class
    return chosen


def settings_dtype(algorithm: type, fields: Mapping[str, Any]) -> np.dtype[np.void]:
    """The type of the record that holds an algorithm's settings.

    Raises:
        TypeError: if a function of the algorithm that the loop calls is not compiled.
    """
    for function in _NAMES & vars(algorithm).keys():
        if not hasattr(vars(algorithm)[function], "py_func"):
            raise TypeError(
                f"{algorithm.__name__}.{function} is called by compiled code: put @inlined of "
                "rl_yardstick.machine_code.compiling on the function"
            )
    name = f"{RULE_PREFIX}{algorithm.__module__} {algorithm.__qualname__}"
    _DEFINITIONS[name] += 1
    if _DEFINITIONS[name] > 1:
        # Redefined, as in a notebook: code compiled for the old class must not run.
        name = f"{name} {_DEFINITIONS[name]}"
    _ALGORITHMS[name] = algorithm
    return np.dtype([(name, np.uint8), *fields.items()], align=True)


# Bookkeeping of every compiled environment around its own step: sums, time limit, episodes.


@inlined
def add_to_return(env: Any, reward: float, compensated: bool) -> None:
    """Add like Python's `sum`, which compensates for rounding since 3.12."""
    total = env.episode_return
    new_total = total + reward
    if compensated:
        if abs(total) >= abs(reward):
            env.compensation += (total - new_total) + reward
        else:
            env.compensation += (reward - new_total) + total
    env.episode_return = new_total


@inlined
def begin_episode(env: Any) -> None:
    """Reset the counters of the episode."""
    env.elapsed = 0
    env.episode_return = 0.0
    env.compensation = 0.0


@inlined
def end_step(env: Any, time_limit: int, compensated: bool) -> None:
    """Add the reward, and set whether the episode is over; limit 0 means no limit."""
    add_to_return(env, env.monitor_reward, compensated)
    env.elapsed += 1
    # A step that terminates at the time limit counts as terminated, as in DummyVecEnv.
    env.done = env.terminated or (time_limit > 0 and env.elapsed >= time_limit)
    env.new_obs = env.next_obs


# The compiled training loop: many steps of acting and learning in one call.
#
# It does the same as the interpreted loop of `OnlineAlgorithm`, in the same order, with the same
# functions and random numbers, so both give bit-for-bit equal results.


@by_type
def act(agent: Any, env: Any, progress: Any) -> None:
    """Choose ``env.action`` for ``env.obs``."""


@by_type_or_this
def move_on(seen: Any, env: Any) -> None:
    """Make the new observation the one that the next action is chosen for."""
    env.obs = env.new_obs


@by_type_or_this
def learn_from_step(agent: Any, envs: Any, progress: Any) -> None:
    """Learn from the step of all environments, and move on to the next observations."""
    for i in range(len(envs)):
        move_on(agent.seen, envs[i])


@by_type
def step(world: Any, env: Any, handle: Any) -> None:
    """Take one step of an environment; the handle is that of its generator."""


@by_type
def reset(world: Any, env: Any, handle: Any) -> None:
    """Begin another episode."""


@by_type
def note_step(log: Any, env: Any, i: int, step: int) -> None:
    """Record the step of environment ``i``."""


class EpisodeLog(NamedTuple):
    """Data of a block for Monitor and the statistics."""

    episodes: NDArray[Any]  # of type `EPISODE`, filled with those that end, shape (capacity,)
    # Rewards that Monitor sees in the running episode, from its first step in the block on; shape
    # (steps, n_envs).
    rewards: Floats

    @inlined
    def note_step(self, env: Any, i: int, step: int) -> None:
        """Store the reward, which overwrites one of the previous episode."""
        self.rewards[min(step, env.elapsed - 1), i] = env.monitor_reward


@inlined
def note_episode(episodes: Any, env: Any, progress: Any, i: int, step: int) -> None:
    """Append the episode that has just ended in environment ``i``."""
    entry = episodes[progress.logged_episodes]
    entry.env = i
    entry.step = step
    entry.episode_return = env.episode_return + env.compensation
    entry.length = env.elapsed
    entry.success = env.success
    progress.logged_episodes += 1


@inlined
def advance(progress: Any, n_done: int) -> None:
    """Update the remaining share of training, and the values of the schedules."""
    if progress.episode_budget > 0:
        progress.budget_episodes += n_done
        share_done = max(float(progress.budget_episodes), 1e-9) / progress.episode_budget
        progress.total_timesteps = progress.num_timesteps / share_done
    progress.remaining = 1.0 - float(progress.num_timesteps) / progress.total_timesteps
    progress.exploration = schedule_value(progress.exploration_schedule, progress.remaining)
    progress.learning_rate = schedule_value(progress.learning_rate_schedule, progress.remaining)


@inlined
def learn_and_count(agent: Any, envs: Any, progress: Any) -> None:
    """Do what the interpreted loop does between two steps."""
    n_done = 0
    for i in range(len(envs)):
        n_done += envs[i].done
    advance(progress, n_done)
    learn_from_step(agent, envs, progress)
    progress.episodes += n_done


@kernel
def learn_from_last_step(agent: Any, envs: Any, progress: Any) -> None:
    """Learn from the last step of `run_block`."""
    learn_and_count(agent, envs, progress)


@kernel
def run_block(
    world: Any,
    agent: Any,
    envs: Any,
    handles: Any,
    progress: Any,
    log: Any,
    n_steps: int,
    max_episodes: int,
    compensated: bool,
) -> int:
    """Act for ``n_steps``, and learn after each step except the last.

    `learn_from_last_step` learns from the last step, because callbacks must run before that
    update.
    """
    progress.logged_episodes = 0
    for t in range(n_steps):
        for i in range(len(envs)):
            act(agent, envs[i], progress)
        for i in range(len(envs)):
            env = envs[i]
            step(world, env, handles[i])
            end_step(env, world.time_limit, compensated)
            note_step(log, env, i, t)
            if env.done:
                note_episode(log.episodes, env, progress, i, t)
                begin_episode(env)
                reset(world, env, handles[i])
        progress.num_timesteps += len(envs)
        if t == n_steps - 1 or progress.logged_episodes >= max_episodes:
            return t + 1
        learn_and_count(agent, envs, progress)
    return n_steps
