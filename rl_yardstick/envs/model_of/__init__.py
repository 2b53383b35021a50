"""The exact model of a finite Gymnasium environment, from its `reset` and `step` alone.

    found = model_of(gym.make("Taxi-v4", fickle_passenger=True))
    found.model  # a `TransitionModel`

`draws` lets every generator follow a script, `symbols` are numbers that need no value, `states`
decides which attributes are the state, `search` finds the states and outcomes, and `check` tests
the model against the untouched environment.
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

from rl_yardstick.envs.model_of.check import refutation
from rl_yardstick.envs.model_of.draws import Script, scripted
from rl_yardstick.envs.model_of.search import Search
from rl_yardstick.envs.model_of.states import State, parts_of
from rl_yardstick.envs.model_of.symbols import Limit, Stop
from rl_yardstick.mdp.transition_model import Bools, TransitionModel

MOST_ACTIONS = 5000
OUTSIDE = "something outside its attributes decides (a class, a global, the time of day)"


class NotFinite(Exception):  # noqa: N818 (says what is wrong with the environment)
    """The environment has no finite model, or none that can be found; one line says why."""


class Unfinished(NotFinite):
    """The search ended at its limits."""


@dataclass(frozen=True)
class FoundModel:
    """The exact model of an environment, without the time limit of `gymnasium.make`.

    Where the environment's own time matters for more than the end of the episode, every state
    stands in the model once for each time.
    """

    model: TransitionModel
    mask: Bools | None  # actions that raise no error, bool of shape (S, A); None if all
    observations: list[Any]  # what each state shows
    actions: list[Any]  # of the environment, in the order of the model
    horizon: int | None  # the environment's own limit on steps
    notes: list[str]  # what a reader of the figures should know
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

    Args:
        env: the environment, to be reset afterwards; wrappers are part of it, but for time limits
            and those that only watch.
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
        held = list(parts_of([vars(layer) for layer in state.layers]).values())
        held += [sys.modules[name] for name in modules]
        for layer in state.layers:
            layer.action_space.np_random  # noqa: B018 (makes its generator)
            held.append(layer.action_space)
        with scripted(state.script, held):
            model, mask = search.run()
        state.restore_original(without_transparent=True)
        allowed = None if mask.all() else mask
        if problem := refutation(state.layers[0], model, search.state_now, actions, allowed):
            raise NotFinite(f"{OUTSIDE}: {problem}")
    except Stop as stop:
        kind = Unfinished if isinstance(stop, Limit) else NotFinite
        raise kind(str(stop)) from None
    finally:
        state.restore_original(without_transparent=False)
    notes = []
    if search.horizon is not None:
        names = ", ".join(f"`{name}`" for _, name in state.clocks)
        notes.append(f"{names} counts the steps: episodes end after {search.horizon}")
    n, seen = len(search.observations), len(set(map(state.by_value, search.observations)))
    if seen < n:
        notes.append(f"{n:,} states stand behind {seen:,} observations")
    for error, pairs in search.illegal.items():
        notes.append(f"{pairs:,} pairs of state and action are not allowed: {error}")
    observations, spent = search.observations * search.times, perf_counter() - search.started
    return FoundModel(model, allowed, observations, actions, search.horizon, notes, spent)


def _actions_of(space: gym.Space[Any]) -> list[Any]:
    """All actions of a finite space."""
    if isinstance(space, spaces.Discrete) and space.n <= MOST_ACTIONS:
        return [int(space.start + i) for i in range(int(space.n))]
    if isinstance(space, spaces.MultiDiscrete) and np.prod(space.nvec) <= MOST_ACTIONS:
        values = itertools.product(*(range(n) for n in space.nvec.ravel()))
        return [np.array(value).reshape(space.nvec.shape) + space.start for value in values]
    raise NotFinite(f"the action space {space} is not finite, or has over {MOST_ACTIONS:,} actions")
