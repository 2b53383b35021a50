"""What the state of an environment is: which of its attributes, and their values.

All attributes of the environment and its wrappers belong to the state, except for

- constants: attributes that a short play leaves as they are;
- ghosts: attributes that are written, added to or appended to, and never read;
- clocks: whole numbers that count the steps of an episode.

These are guesses. `Refuted` names the attribute at the moment in which its guess turns out wrong;
it then belongs to the state, and the search starts anew.
"""

from __future__ import annotations

import enum
import io
import pickle
import types
from collections import deque
from collections.abc import Hashable, Iterable
from typing import Any

import gymnasium as gym
import numpy as np

from rl_yardstick.envs.model_of.draws import GENERATORS, Script
from rl_yardstick.envs.model_of.symbols import Stop, Symbol

Env = gym.Env[Any, Any]
Place = tuple[int, str]  # of an attribute: the number of the layer, the outermost first; the name
Saved = dict[Place, Any]

TRANSPARENT = {"HumanRendering", "Monitor", "OrderEnforcing", "PassiveEnvChecker", "TimeLimit"}
TRANSPARENT |= {"RecordEpisodeStatistics", "RecordVideo", "RenderCollection"}
NO_STATE = {"_cached_spec", "_np_random_seed", "action_space", "env", "metadata"}
NO_STATE |= {"observation_space", "render_mode", "spec"}
ATOMS = frozenset({int, float, str, bool, bytes, complex, type(None)})
BY_IDENTITY: tuple[type, ...] = (types.FunctionType, types.BuiltinFunctionType, types.ModuleType)
BY_IDENTITY += (type, np.dtype, np.ufunc, gym.Space, enum.Enum, gym.Env)
LEAVES: tuple[Any, ...] = (*BY_IDENTITY, *GENERATORS, *ATOMS)


class Refuted(BaseException):
    """The attribute at the place given belongs to the state after all."""


class Ghost(Symbol):
    """An attribute that is written and never read; numbers and items may be added to it."""

    def now(self) -> Any:
        raise Refuted(self.known)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **keywords: Any) -> Any:
        return self if ufunc in (np.add, np.subtract, np.multiply) else self.now()

    def append(self, item: Any) -> None:
        """Nobody reads what is appended."""

    def _used(self, *given: Any) -> Any:
        raise Refuted(self.known)

    __getattr__ = __len__ = __getitem__ = __setitem__ = __iter__ = __contains__ = _used


class Clock(Symbol):
    """The number of steps taken, plus ``shift``: comparing it tells which times act alike."""

    def now(self) -> Any:
        self.script.until = self.script.time
        return self.scale * self.script.time + self.shift

    def below(self, cut: float, closed: bool) -> bool:
        last = np.floor(cut) if closed else np.ceil(cut) - 1  # the last time below
        if is_below := bool(self.script.time <= last):
            self.script.until = int(min(last, self.script.until))
        return is_below


class State:
    """The attributes of an environment and its wrappers, without those that change nothing."""

    def __init__(self, env: Env, script: Script, ignored: Iterable[str]) -> None:
        self.layers: list[Env] = []
        while isinstance(env, gym.Wrapper):
            # Within other wrappers, which may see it, the end of time is a part of the environment.
            is_seen = bool(self.layers) and isinstance(env, gym.wrappers.TimeLimit)
            if is_seen or type(env).__name__ not in TRANSPARENT:
                self.layers.append(env)
            env = env.env
        self.layers.append(env)
        self.original = [(layer, type(layer), dict(vars(layer))) for layer in self.layers]
        self.script, self.no_state = script, NO_STATE | set(ignored)
        self.used: set[Place] = set()  # guesses that were wrong
        self.clocks: dict[Place, int] = {}  # with their values at the start of an episode
        self.hidden: set[Place] = set()  # ghosts and clocks
        self.watched: dict[Place, Any] = {}  # and what was written to them last
        self.constants: dict[Place, tuple[Any, Hashable]] = {}
        self.kept: dict[int, Any] = {}  # the layers, and what constants are made of, by id

    def restore_original(self, without_transparent: bool) -> None:
        """Give the layers the classes and attributes that they had."""
        for layer, kind, held in self.original:
            layer.__class__ = kind
            vars(layer).clear()
            vars(layer).update(held)
        for outer, inner in zip(self.layers, self.layers[1:], strict=False):
            if without_transparent:
                vars(outer)["env"] = inner

    def attributes(self) -> list[tuple[Place, Any]]:
        """All attributes that can be a part of the state, and their values."""
        return [
            ((i, name), value)
            for i, layer in enumerate(self.layers)
            for name, value in vars(layer).items()
            if name not in self.no_state
            and (i, name) not in self.hidden
            and (type(value) in ATOMS or not isinstance(value, GENERATORS))
        ]

    def play(self, actions: list[Any], episodes: int = 2, steps: int = 50) -> None:
        """See in a short play which attributes nothing changes, and which count the steps."""
        env, rng = self.layers[0], np.random.default_rng(0)
        same: dict[Place, Hashable] = {}
        counting: dict[Place, int] = {}
        for episode in range(episodes):
            env.reset(seed=episode)
            ended = False
            for step in range(steps + 1):
                now = {p: v - step for p, v in self.attributes() if type(v) is int}
                counting = now if episode == step == 0 else dict(counting.items() & now.items())
                if step in (0, steps) or ended:
                    values = {place: self.by_value(value) for place, value in self.attributes()}
                    same = values if episode == step == 0 else dict(same.items() & values.items())
                if step == steps or ended:
                    break
                try:
                    ended = any(env.step(actions[rng.integers(len(actions))])[2:4])
                except Exception:  # noqa: BLE001 (a step that is not allowed ends the episode)
                    break
        env.reset(seed=0)
        self.layers[-1].np_random  # noqa: B018 (makes it)
        self.counting, self.left_alone = counting, {}
        for place, value in self.attributes():
            if place in same and self.by_value(value) == same[place]:
                self.left_alone[place] = value, same[place]
        self.start = [dict(vars(layer)) for layer in self.layers]

    def guess(self) -> None:
        """Guess what is constant, never read, or a clock, but for the guesses that were wrong."""
        for (layer, kind, _), held in zip(self.original, self.start, strict=True):
            layer.__class__ = kind
            vars(layer).update((k, v) for k, v in held.items() if not isinstance(v, GENERATORS))
        self.hidden = set()
        places = [place for place, _ in self.attributes() if place not in self.used]
        self.constants = {p: self.left_alone[p] for p in places if p in self.left_alone}
        self.kept = parts_of([value for value, _ in self.constants.values()])
        self.kept |= {id(layer): layer for layer in self.layers}
        rest = [place for place in places if place not in self.constants]
        self.clocks = {p: self.counting[p] for p in rest if p in self.counting}
        self.hidden = set(rest)
        for i, layer in enumerate(self.layers):
            names = {place[1]: self._property(place) for place in rest if place[0] == i}
            kind = type(layer)
            layer.__class__ = type(kind.__name__, (kind,), {"__module__": kind.__module__} | names)

    def _property(self, place: Place) -> property:
        """In place of an attribute that is watched; it is no longer among the attributes."""

        def read(_: Env) -> Any:
            value = self.watched[place]
            if place in self.clocks:
                return value
            if isinstance(value, Ghost | int | float | list | np.number):
                return Ghost(self.script, place)
            raise Refuted(place)

        def write(_: Env, value: Any) -> None:
            self.watched[place] = value

        self.watched[place] = vars(self.layers[place[0]]).pop(place[1])
        return property(read, write)

    def check_clocks(self, is_reset: bool) -> None:
        """Every clock must have counted the step, or start anew."""
        for place, start in self.clocks.items():
            value = self.watched[place]
            if is_reset or not isinstance(value, Clock):
                right = is_reset and type(value) is int and value == start
            else:
                right = (value.scale, value.shift) == (1, start + 1)
            if not right:
                raise Refuted(place)

    def check_constants(self) -> None:
        """Constants must not have changed in place."""
        kept, self.kept = self.kept, {}
        wrong = [p for p, (value, held) in self.constants.items() if self.by_value(value) != held]
        self.kept = kept
        if wrong:
            raise Refuted(wrong[0])

    def variables(self) -> Saved:
        """The attributes that are the state now."""
        found = {}
        for place, value in self.attributes():
            constant = self.constants.get(place)
            if constant is None:
                found[place] = value
            elif value is not constant[0]:
                if self.by_value(value) != constant[1]:
                    raise Refuted(place)
                vars(self.layers[place[0]])[place[1]] = constant[0]
        return found

    def key(self, variables: Saved) -> Hashable:
        """The state by value."""
        seen: dict[int, Any] = {}
        return tuple(
            [(place, self.by_value(variables[place], seen)) for place in sorted(variables)]
        )

    def save(self, variables: Saved) -> bytes:
        """A state to restore, in which constants are the objects that they were."""
        file = io.BytesIO()
        pickler: Any = pickle.Pickler(file)
        pickler.persistent_id = self._reference
        try:
            pickler.dump(variables)
        except (TypeError, AttributeError, pickle.PicklingError) as error:
            for place, value in variables.items() if len(variables) > 1 else ():
                self.save({place: value})
            raise Stop(f"`{next(iter(variables))[1]}` cannot be saved: {error}") from None
        return file.getvalue()

    def _reference(self, value: Any) -> int | None:
        if isinstance(value, (*BY_IDENTITY, *GENERATORS)):
            self.kept[id(value)] = value
        return id(value) if id(value) in self.kept else None

    def saved(self, saved: bytes) -> Saved:
        """The attributes of a saved state."""
        unpickler: Any = pickle.Unpickler(io.BytesIO(saved))  # noqa: S301 (its own, in memory)
        unpickler.persistent_load = self.kept.__getitem__
        values: Saved = unpickler.load()
        return values

    def restore(self, saved: bytes) -> None:
        """Put a saved state into the environment, whose clocks show the script's time."""
        values = self.saved(saved)
        for (i, name), _ in self.attributes():
            if (i, name) not in values and (i, name) not in self.constants:
                del vars(self.layers[i])[name]
        for (i, name), value in values.items():
            vars(self.layers[i])[name] = value
        for place, start in self.clocks.items():
            self.watched[place] = Clock(self.script, None, 1, start)

    def by_value(self, value: Any, seen: dict[int, Any] | None = None) -> Hashable:
        """Something hashable that is equal for equal values; which parts are shared counts."""
        kind, i = type(value), id(value)
        seen = {} if seen is None else seen
        if kind in ATOMS or isinstance(value, np.generic):
            return value  # type: ignore[no-any-return]
        if kind is tuple:
            return tuple([self.by_value(part, seen) for part in value])
        if isinstance(value, GENERATORS):
            return "generator"
        if isinstance(value, Symbol):
            return value.now()  # type: ignore[no-any-return]
        if i in seen:
            return "again", seen[i][0]
        if i in self.kept or isinstance(value, BY_IDENTITY):
            return "object", i
        seen[i] = len(seen), value
        if kind is np.ndarray and value.dtype != object:
            return value.dtype.char, value.shape, value.tobytes()
        if kind in (set, frozenset):
            return kind, frozenset([self.by_value(part) for part in value])
        parts: Any = value
        if kind is dict:
            parts = value.items()
        elif kind is not list:
            try:
                parts = [list(x) if hasattr(x, "__next__") else x for x in value.__reduce_ex__(4)]
            except Exception:  # noqa: BLE001 (classes decide what they raise)
                return "object", i
            seen[-len(seen)] = 0, parts  # their ids are not used again while these live
        return kind, *[self.by_value(part, seen) for part in parts]


def parts_of(values: list[Any]) -> dict[int, Any]:
    """The values and all objects that they hold, by id."""
    found: dict[int, Any] = {}
    todo = list(values)
    while todo:
        value = todo.pop()
        if id(value) in found or isinstance(value, LEAVES):
            continue
        found[id(value)] = value
        parts: Iterable[Any] = getattr(value, "__dict__", {}).values()
        if isinstance(value, dict | list | tuple | set | deque):
            parts = value.values() if isinstance(value, dict) else value
        elif isinstance(value, np.ndarray) and value.dtype == object:
            parts = value.ravel().tolist()
        todo.extend([part for part in parts if type(part) not in ATOMS])
    return found
