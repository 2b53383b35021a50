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
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from rl_yardstick.envs.model_of.check import refutation
from rl_yardstick.envs.model_of.draws import Script, scripted
from rl_yardstick.envs.model_of.search import Search
from rl_yardstick.envs.model_of.states import State
from rl_yardstick.envs.model_of.symbols import Limit, Stop
from rl_yardstick.mdp.transition_model import Bools, TransitionModel

MOST_ACTIONS = 5000
FEWEST_SECONDS = 20.0  # that the test of a model may take; else twice those of its search
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
    observations: Any  # what each state shows, in a list
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
    starts: Sequence[int] | None = None,
) -> FoundModel:
    """The exact model of a finite environment, found by running its `reset` and `step`.

    Args:
        env: the environment, to be reset afterwards; wrappers are part of it, but for time limits
            and those that only watch.
        seconds: of processor time, after which the search gives up.
        max_states: the number of states above which it gives up.
        ignore: names of attributes that change nothing.
        progress: called now and then with the number of states found, and of those done.
        starts: seeds of `reset`; episodes start from the states that these lead to, each as likely.
            None for all states that a reset can lead to.

    Raises:
        NotFinite: if there is no finite model, or the environment does not follow the one found.
    """
    space = env.action_space
    if not isinstance(space, gym.spaces.Discrete) or space.n > MOST_ACTIONS:
        raise NotFinite(f"the action space {space} is not `Discrete` with up to {MOST_ACTIONS:,}")
    actions = [space.start + np.int64(i) for i in range(int(space.n))]  # as Gymnasium draws them
    state = State(env, Script(), ignore)
    search = Search(state, actions, seconds, max_states, progress, starts or ())
    try:
        state.restore_original(without_transparent=True)
        state.play(actions)
        held = list(state.parts([vars(layer) for layer in state.layers]).values())
        held += _modules(state.layers)
        for layer in state.layers:
            layer.action_space.np_random  # noqa: B018 (makes its generator)
            held.append(layer.action_space)
        with scripted(state.script, held) as search.put:
            model, mask = search.run()
        state.restore_original(without_transparent=True)
        allowed = None if mask.all() else mask
        tested = _Seeded(state.layers[0], starts) if starts else state.layers[0]
        limit = max(2 * seconds, FEWEST_SECONDS)
        if problem := refutation(tested, model, search.state_now, actions, allowed, seconds=limit):
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
        notes.append(f"{n:,} states stand behind {seen:,} observations, so agents may return less")
    if illegal := search.illegal:
        others = f", and {len(illegal) - 1:,} others" * (len(illegal) > 1)
        told = f"{sum(illegal.values()):,} of the pairs of state and action are not allowed"
        notes.append(f"{told}: {next(iter(illegal))}{others}")
    observations = search.observations * search.times
    return FoundModel(model, allowed, observations, search.horizon, notes, search.spent())


class _Seeded(gym.Wrapper[Any, Any, Any, Any]):
    """Starts from these seeds in turn; what follows is random."""

    def __init__(self, env: gym.Env[Any, Any], seeds: Sequence[int]) -> None:
        super().__init__(env)
        self.seeds, self.rng = itertools.cycle(seeds), np.random.default_rng(0)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        result = self.env.reset(seed=next(self.seeds))
        self.env.unwrapped.np_random = self.rng
        return result


def _modules(layers: list[gym.Env[Any, Any]]) -> list[Any]:
    """The modules of the environment's classes, and all of their packages and folders."""
    kinds = [kind for layer in layers for kind in type(layer).__mro__ if issubclass(kind, gym.Env)]
    places = {
        name: {name.partition(".")[0], Path(getattr(module, "__file__", None) or name).parent}
        for name, module in list(sys.modules.items())
    }
    near = set().union(*(places[kind.__module__] for kind in kinds)) - {Path()}
    return [sys.modules[name] for name, place in places.items() if place & near]
