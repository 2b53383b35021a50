"""The exact model of a finite Gymnasium environment, from its `reset` and `step` alone.

    found = model_of(gym.make("Taxi-v4", fickle_passenger=True))
    found.model  # a `TransitionModel`

`draws` lets every generator follow a script, `symbols` are random numbers that need no value,
`states` decides which attributes are the state, `search` finds the states and outcomes, and `check`
tests the model against the untouched environment.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rl_yardstick.envs.model_of.check import Check
from rl_yardstick.envs.model_of.draws import Script, scripted
from rl_yardstick.envs.model_of.search import Search
from rl_yardstick.envs.model_of.states import State, parts_of
from rl_yardstick.envs.model_of.symbols import Stop
from rl_yardstick.mdp.transition_model import Bools, TransitionModel

MOST_ACTIONS = 5000


class NotFinite(Exception):  # noqa: N818 (says what is wrong with the environment)
    """The environment has no finite model, or none that can be found; one line says why."""


@dataclass(frozen=True)
class FoundModel:
    """The exact model of an environment, without the time limit of `gymnasium.make`.

    Attributes:
        model: the dynamics. Where the environment's own time matters for more than the end of the
            episode, every state stands there once for each time.
        mask: actions that raise no error, bool of shape (S, A); None if all are allowed.
        observations: what each state shows.
        actions: the environment's actions, in the order of the model.
        horizon: the environment's own limit on steps, None without one.
        notes: what a reader of the figures should know, a sentence each.
        seconds: the time that it took.
    """

    model: TransitionModel
    mask: Bools | None
    observations: list[Any]
    actions: list[Any]
    horizon: int | None
    notes: list[str]
    seconds: float


def model_of(
    env: gym.Env[Any, Any],
    *,
    seconds: float = 10.0,
    max_states: int = 100_000,
    ignore: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
) -> FoundModel:
    """The exact model of a finite environment, found by running its `reset` and `step`.

    The environment is to be reset afterwards.

    Args:
        env: the environment; wrappers are part of it, but for time limits and those that only
            watch.
        seconds: the time after which the search gives up.
        max_states: the number of states above which it gives up.
        ignore: names of attributes that change nothing.
        progress: called now and then with the number of states found, and of those done.

    Raises:
        NotFinite: if there is no finite model, or the environment does not follow the one found.
    """
    actions = _actions_of(env.action_space)
    state = State(env, Script(), ignore)
    search = Search(state, actions, seconds, max_states, progress)
    modules = {kind.__module__ for layer in state.layers for kind in type(layer).__mro__}
    try:
        state.restore_original(without_transparent=True)
        state.play(actions)
        held = parts_of([vars(layer) for layer in state.layers]).values()
        with scripted(state.script, [*held, *(sys.modules[name] for name in modules)]):
            model, mask = search.run()
        state.restore_original(without_transparent=True)
        problem = Check(state.layers[0], model, search.state_now, actions, mask).refutation()
    except Stop as stop:
        raise NotFinite(str(stop)) from None
    finally:
        state.restore_original(without_transparent=False)
    if problem:
        raise NotFinite(f"something outside its attributes decides what it does: {problem}")
    return FoundModel(
        model,
        None if mask.all() else mask,
        search.observations * search.times,
        actions,
        search.horizon,
        _notes(search),
        perf_counter() - search.started,
    )


def _notes(search: Search) -> list[str]:
    """What a reader of the figures should know."""
    notes = []
    names = ", ".join(f"`{name}`" for _, name in search.state.clocks)
    if search.horizon is not None:
        notes.append(f"{names} counts the steps: episodes end after {search.horizon}")
    n, shown = len(search.observations), search.observations
    if (seen := len({search.state.by_value(observation) for observation in shown})) < n:
        notes.append(f"{n:,} states stand behind {seen:,} observations")
    for error, times in search.illegal.items():
        notes.append(f"{times:,} pairs of state and action are not allowed: {error}")
    return notes


def _actions_of(space: gym.Space[Any]) -> list[Any]:
    """All actions of a finite space."""
    if isinstance(space, spaces.Discrete) and space.n <= MOST_ACTIONS:
        return [int(space.start + i) for i in range(int(space.n))]
    if isinstance(space, spaces.MultiDiscrete) and np.prod(space.nvec) <= MOST_ACTIONS:
        values = itertools.product(*(range(n) for n in space.nvec.ravel()))
        return [np.array(value).reshape(space.nvec.shape) + space.start for value in values]
    if isinstance(space, spaces.MultiBinary) and 2 ** np.prod(space.shape) <= MOST_ACTIONS:
        bits = itertools.product((0, 1), repeat=int(np.prod(space.shape)))
        return [np.array(value, np.int8).reshape(space.shape) for value in bits]
    raise NotFinite(f"the action space {space} is not finite, or has over {MOST_ACTIONS:,} actions")
