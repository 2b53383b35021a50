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
import itertools
import pickle
import types
from collections import deque
from collections.abc import Hashable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np

from rl_yardstick.envs.model_of.draws import GENERATORS, Script, owner_of
from rl_yardstick.envs.model_of.symbols import Stop, Symbol

Env = gym.Env[Any, Any]
Place = tuple[int, str]  # of an attribute: the number of the layer, the outermost first; the name
Saved = list[dict[str, Any]]  # attributes of each layer

TRANSPARENT = {"HumanRendering", "Monitor", "OrderEnforcing", "PassiveEnvChecker", "TimeLimit"}
TRANSPARENT |= {"RecordEpisodeStatistics", "RecordVideo", "RenderCollection"}
NO_STATE = {"_cached_spec", "_np_random_seed", "action_space", "metadata"}
NO_STATE |= {"observation_space", "render_mode", "spec"}
MOST_IN_SHORT = 100  # numbers of a constant that is looked at after each step
PLAYED = 50  # steps of each of the two episodes that are played first
SIMPLE = (int, float, str, bytes, complex, types.NoneType, np.generic)
ATOMS = frozenset({*SIMPLE, bool})
NUMBERS = (np.generic, Symbol)
BY_IDENTITY: tuple[Any, ...] = (types.FunctionType, types.BuiltinFunctionType, types.ModuleType)
BY_IDENTITY += (type, np.dtype, np.ufunc, gym.Space, enum.Enum, *GENERATORS)


class Refuted(BaseException):
    """The attribute at the place given belongs to the state after all."""


class Ghost(Symbol):
    """Something that nobody reads: numbers and items may be added to it, the rest raises."""

    def now(self, *given: Any) -> Any:
        raise self.known

    __getattr__ = __len__ = __getitem__ = __setitem__ = __iter__ = __contains__ = now

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **keywords: Any) -> Any:
        return self if ufunc in (np.add, np.subtract, np.multiply) else self.now()

    def append(self, item: Any) -> None:
        """Nobody reads what is appended."""


class Clock(Symbol):
    """The number of steps taken, plus ``shift``: comparing it tells which times act alike."""

    def now(self) -> Any:
        self.script.until = self.script.time
        return self.scale * self.script.time + self.shift

    def over(self, divisor: Any) -> Any:
        if (self.scale, type(self.shift), type(divisor)) != (1, int, int) or divisor < 1:
            return self.now() // divisor
        script, value = self.script, self.script.time + self.shift
        script.until = min(script.until, script.time + divisor - 1 - value % divisor)
        return value // divisor

    def below(self, cut: float, closed: bool) -> bool:
        last = np.floor(cut) if closed else np.ceil(cut) - 1  # the last time below
        if is_below := bool(self.script.time <= last):
            self.script.until = int(min(last, self.script.until))
        return is_below


def short(value: Any, depth: int = 2) -> list[Any]:
    """Some numbers that change with most changes of an object in place."""
    if isinstance(value, np.ndarray) or not depth:
        return [value.tobytes() if isinstance(value, np.ndarray) else id(value)]
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list | tuple | set | deque):
        value = getattr(value, "__dict__", {}).values()
    return [number for part in value for number in short(part, depth - 1)]


def is_plain_array(value: Any) -> bool:
    """Whether a value is an array of numbers."""
    return type(value) is np.ndarray and not value.dtype.hasobject


class ByValue(pickle.Pickler):
    """Equal values become equal bytes; which parts are shared counts."""

    def __init__(self, file: io.BytesIO, state: State) -> None:
        super().__init__(file)
        self.fast = True  # writes strings where they are, and not where they were first
        self.reference = state.reference
        self.seen: dict[int, Any] = {}  # kept alive, so that no other object gets the same id

    def persistent_id(self, value: Any) -> Any:
        kind, i = type(value), id(value)
        if kind in ATOMS:
            return value
        if kind is tuple:
            return None
        if i in self.seen:
            return "again", self.seen[i][0]
        if isinstance(value, NUMBERS):
            return value.now() if isinstance(value, Symbol) else value.item()
        self.seen[i] = len(self.seen), value
        if is_plain_array(value):
            return value.dtype.char, value.shape, value.tobytes()
        if self.reference(value) is not None:
            return "generator" if isinstance(value, GENERATORS) else ("object", i)
        return ("set", *sorted(value, key=hash)) if kind in (set, frozenset) else None

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, gym.Env):  # an inner one
            held = {name: part for name, part in vars(value).items() if name not in NO_STATE}
            return type(value), (), held
        try:
            parts = value.__reduce_ex__(4)
        except Exception:  # noqa: BLE001 (classes decide what they raise)
            parts = ""
        return (int, (id(value),)) if isinstance(parts, str) else parts  # as an object, by identity


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
        self.script, self.ignored, self.no_state = script, ignored, NO_STATE | set(ignored)
        self.used: set[Place] = set()  # guesses that were wrong
        self.clocks: dict[Place, int] = {}  # with their values at the start of an episode
        self.watched: dict[Place, Any] = {}  # what was last written to ghosts and clocks
        self.constants: dict[Place, Hashable] = {}  # by value
        self.fixed: Saved = []  # the constants of each layer, and what is no state
        self.by_id = {id(layer): layer for layer in self.layers}
        self.kept: dict[int, Any] = dict(self.by_id)  # objects that are saved by reference
        self.in_short: list[tuple[Any, Any]] = []  # constants that can change in place
        self.is_plain = False  # whether watched attributes have values

    def restore_original(self, without_transparent: bool) -> None:
        """Give the layers the classes and attributes that they had."""
        for layer, kind, held in self.original:
            layer.__class__ = kind
            vars(layer).clear()
            vars(layer).update(held)
        for outer, inner in zip(self.layers, self.layers[1:], strict=False):
            if without_transparent:
                vars(outer)["env"] = inner

    def attributes(self) -> dict[Place, Any]:
        """All attributes that can be a part of the state."""
        return {
            (i, name): value
            for i, layer in enumerate(self.layers)
            for name, value in vars(layer).items()
            if name not in self.no_state and owner_of(value) is None
            if layer is self.layers[-1] or name != "env"
        }

    def play(self, actions: list[Any]) -> None:
        """See in a short play which attributes nothing changes, and which count the steps."""
        env, rng = self.layers[0], np.random.default_rng(0)
        counts, values = [], []

        def note() -> None:
            now = self.attributes().items()
            values.append({(place, self.by_value(value)) for place, value in now})

        for seed in (0, 1, 0):
            env.reset(seed=seed)
            note()
            for step in range(PLAYED):
                now = self.attributes().items()
                counts.append({(p, value - step) for p, value in now if type(value) is int})
                try:
                    if any(env.step(actions[rng.integers(len(actions))])[2:4]):
                        break
                except Exception:  # noqa: BLE001 (a step that is not allowed ends the episode)
                    break
            note()
        env.reset(seed=0)
        self.layers[-1].np_random  # noqa: B018 (makes it)
        self.at_first = values[0]  # attributes by value, after the first reset of all
        self.counting = dict(set.intersection(*counts))
        self.left_alone = dict(set.intersection(*values))
        self.start = [dict(vars(layer)) for layer in self.layers]
        arrays = [(n, v) for (_, n), v in self.attributes().items() if isinstance(v, np.ndarray)]
        for (one, a), (other, b) in itertools.combinations(arrays, 2):
            if a is not b and np.may_share_memory(a, b):
                raise Stop(f"`{one}` and `{other}` share their numbers: one is a view")
        for name in self.ignored:
            if name not in {name for layer in self.layers for name in vars(layer)}:
                raise Stop(f"there is no attribute `{name}` to ignore")

    def guess(self) -> None:
        """Guess what is constant, never read, or a clock, but for the guesses that were wrong."""
        for (layer, kind, _), held in zip(self.original, self.start, strict=True):
            layer.__class__ = kind
            vars(layer).update((k, v) for k, v in held.items() if owner_of(v) is None)
        guessed = {p: value for p, value in self.attributes().items() if p not in self.used}
        self.constants = {p: self.left_alone[p] for p in guessed if p in self.left_alone}
        self.kept = self.parts([guessed[place] for place in self.constants])
        self.kept |= self.by_id
        held_fast = [guessed[place] for place in self.constants]
        shorts = [(v, short(v)) for v in held_fast if not isinstance(v, SIMPLE)]
        self.in_short = [(v, known) for v, known in shorts if len(known) <= MOST_IN_SHORT]
        self.watched = {p: value for p, value in guessed.items() if p not in self.constants}
        self.clocks = {p: self.counting[p] for p in self.watched if p in self.counting}
        self.fixed = []
        for i, layer in enumerate(self.layers):
            fixed = {k: v for k, v in vars(layer).items() if (i, k) not in self.used}
            self.fixed.append(dict.fromkeys(self.no_state) | fixed)
            names = {name: self._property((j, name)) for j, name in self.watched if i == j}
            for name in names:
                del vars(layer)[name]
            kind = type(layer)
            layer.__class__ = type(kind.__name__, (kind,), {"__module__": kind.__module__} | names)

    def _property(self, place: Place) -> property:
        """In place of an attribute that is watched; it is no longer among the attributes."""

        def read(_: Env) -> Any:
            value = self.watched[place]
            if place in self.clocks or self.is_plain:
                return value
            if isinstance(value, Ghost | int | float | list | np.number):
                return Ghost(self.script, Refuted(place))
            raise Refuted(place)

        return property(read, lambda _, value: self.watched.update({place: value}))

    def check_clocks(self, is_reset: bool) -> None:
        """Every clock must have counted the step, or start anew."""
        for place, start in self.clocks.items():
            value = self.watched[place]
            right = type(value) is int and value == start
            if not is_reset:
                right = isinstance(value, Clock) and (value.scale, value.shift) == (1, start + 1)
            if not right:
                raise Refuted(place)

    @contextmanager
    def plain(self) -> Iterator[None]:
        """Give watched attributes values: to clocks the script's time."""
        self.is_plain = True
        try:
            yield
        finally:
            self.is_plain = False

    def check_constants(self, in_short: bool = False) -> None:
        """Constants must not have changed in place."""
        if in_short and all(known == short(value) for value, known in self.in_short):
            return
        now = [
            {name: held[name] for j, name in self.constants if i == j}
            for i, held in enumerate(self.fixed)
        ]
        for place, value in self.contents(now):
            if value != self.constants[place]:
                raise Refuted(place)

    def variables(self) -> Saved:
        """The attributes that are the state now."""
        found = []
        for i, layer in enumerate(self.layers):
            held, fixed, own = vars(layer), self.fixed[i], {}
            for name in sorted(held):
                value = held[name]
                if name not in fixed:
                    own[name] = value.now() if isinstance(value, Clock) else value
                elif value is not fixed[name] and (i, name) in self.constants:
                    if self.by_value(value) != self.constants[i, name]:
                        raise Refuted((i, name))
                    held[name] = fixed[name]
            found.append(own)
        return found

    def key(self, variables: Saved) -> Hashable:
        """The state by value."""
        flat = [pair for own in variables for pair in own.items()]
        arrays = {id(x) for _, x in flat if is_plain_array(x)}
        if len(arrays) + sum(isinstance(x, SIMPLE) for _, x in flat) == len(flat):
            return tuple((name, self.by_value(x)) for name, x in flat)
        return self.by_value(flat)

    def save(self, variables: Saved) -> bytes:
        """A state to restore, in which constants are the objects that they were."""
        file = io.BytesIO()
        pickler: Any = pickle.Pickler(file)
        pickler.persistent_id = self.reference
        try:
            pickler.dump(variables)
        except (TypeError, AttributeError, pickle.PicklingError) as error:
            single = [(name, value) for layer in variables for name, value in layer.items()]
            for name, value in single if len(single) > 1 else ():
                self.save([{name: value}])
            raise Stop(f"`{single[0][0]}` cannot be saved: {error}") from None
        return file.getvalue()

    def reference(self, value: Any) -> int | None:
        """The number of an object that is not saved, as it stays the same."""
        if id(value) not in self.kept:
            if type(value) in ATOMS or not isinstance(value, BY_IDENTITY):
                return None
            self.kept[id(value)] = value
        return id(value)

    def saved(self, saved: bytes) -> Saved:
        """The attributes of a saved state."""
        unpickler: Any = pickle.Unpickler(io.BytesIO(saved))  # noqa: S301 (its own, in memory)
        unpickler.persistent_load = self.kept.__getitem__
        values: Saved = unpickler.load()
        return values

    def restore(self, saved: bytes) -> None:
        """Put a saved state into the environment, whose clocks show the script's time."""
        for layer, fixed, values in zip(self.layers, self.fixed, self.saved(saved), strict=True):
            held = vars(layer)
            for name in held.keys() - values.keys() - fixed.keys():
                del held[name]
            held.update(values)
        for place, start in self.clocks.items():
            clock = Clock(self.script, None, 1, start)
            self.watched[place] = clock.now() if self.is_plain else clock

    def contents(self, variables: Saved) -> list[tuple[Place, Hashable]]:
        """Attributes by value, also those that are saved by reference."""
        kept, self.kept = self.kept, dict(self.by_id)
        held = [((i, k), v) for i, own in enumerate(variables) for k, v in own.items()]
        found = [(place, self.by_value(value)) for place, value in held]
        self.kept = kept
        return found

    def by_value(self, value: Any) -> Hashable:
        """Something hashable that is equal for equal values."""
        value = value.now() if isinstance(value, Symbol) else value
        if isinstance(value, SIMPLE):
            return value
        if is_plain_array(value):
            return value.dtype.char, value.shape, value.tobytes()
        file = io.BytesIO()
        ByValue(file, self).dump(value)
        return file.getvalue()

    def parts(self, value: Any) -> dict[int, Any]:
        """The objects that a value is made of, by id."""
        self.kept = {}
        pickler = ByValue(io.BytesIO(), self)
        pickler.dump(value)
        return {i: part for i, (_, part) in pickler.seen.items()}
