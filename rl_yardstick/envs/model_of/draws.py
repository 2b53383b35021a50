"""Random draws that follow a script, so that every outcome of a step gets its exact probability.

`step` runs once for each script. A script is a list of branches, one for each draw; after its end
the first possible branch is taken. The trace of a run tells which other branches there were.
"""

from __future__ import annotations

import functools
import math
import random
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np

from rl_yardstick.envs.model_of.symbols import NORMAL, UNIFORM, Count, Drawn, Stop, table, where

NEVER = 1 << 60  # a time that no episode reaches
MOST_BRANCHES = 20_000
LEAST_CHANCE = 1e-13  # branches of a lower probability are cut off


class Again(BaseException):
    """A loop has come back to the draw after so many branches; -1: its chance is too low."""


class Suspect(BaseException):
    """A place in the code (given) draws a second time; also given: when it drew first, the run."""


class Script:
    """The branches that the draws of one run take, and what the run tells about them."""

    def __init__(self) -> None:
        self.time, self.until = 0, NEVER  # what a run does at this time holds until then
        self.begin([], 0, {})

    def begin(self, choices: list[int], root: int, loops: dict[Any, bool]) -> None:
        """Start a run. Loops are looked for after ``root`` branches; the known ones are given."""
        self.choices, self.root, self.loops = choices, root, loops
        self.trace: list[tuple[int, int | Sequence[float]]] = []
        self.chance = 1.0
        self.visits: dict[Any, int] = {}
        # Continuous numbers that were turned into floats, at this quantile of what is known.
        self.floats: list[Drawn] = []
        self.level = 0.5

    def branch(self, chances: int | Sequence[float]) -> int:
        """The number of the branch to take, of so many equal ones or of ones with these chances."""
        n = chances if isinstance(chances, int) else len(chances)
        if n > MOST_BRANCHES:
            raise Stop(f"{where()} draws one of {n:,} values")
        if n == 1:
            return 0
        depth = len(self.trace)
        if depth < len(self.choices):
            choice = self.choices[depth]
        else:
            choice = 0 if isinstance(chances, int) else next(i for i in range(n) if chances[i] > 0)
        self.trace.append((choice, chances))
        self.chance *= 1 / n if isinstance(chances, int) else chances[choice]
        if self.chance < LEAST_CHANCE and depth >= self.root:
            raise Again(-1)
        return choice

    def visit(self) -> None:
        """Note the place in the code that draws, to find loops that draw until they like it."""
        depth, place, frame = len(self.trace), [], sys._getframe(1)
        while frame.f_code is not take_step.__code__:
            if frame.f_code.co_filename != __file__:
                place.append((frame.f_code, frame.f_lasti))
            assert frame.f_back is not None
            frame = frame.f_back
        key = tuple(place)
        if depth >= self.root and (first := self.visits.setdefault(key, depth)) < depth:
            starts_again = self.loops.get(key)
            if starts_again is None:
                raise Suspect(key, first, [choice for choice, _ in self.trace])
            if starts_again:
                raise Again(first)
            self.visits[key] = depth


def take_step(env: gym.Env[Any, Any], action: Any) -> tuple[Any, ...]:
    """One step, or the reset if the action is None; here the stack of a script ends."""
    return env.reset() if action is None else env.step(action)


# Scale, shift and size of continuous numbers, from the arguments of the method.
CONTINUOUS: dict[str, Any] = {
    "random": (UNIFORM, lambda size=None, dtype=None: (1.0, 0.0, size)),
    "rand": (UNIFORM, lambda *shape: (1.0, 0.0, shape or None)),
    "uniform": (UNIFORM, lambda low=0.0, high=1.0, size=None: (np.subtract(high, low), low, size)),
    "normal": (NORMAL, lambda loc=0.0, scale=1.0, size=None: (scale, loc, size)),
    "standard_normal": (NORMAL, lambda size=None: (1.0, 0.0, size)),
    "randn": (NORMAL, lambda *shape: (1.0, 0.0, shape or None)),
}
CONTINUOUS |= dict.fromkeys(("random_sample", "ranf"), CONTINUOUS["random"])
CONTINUOUS |= dict.fromkeys(("gauss", "normalvariate"), CONTINUOUS["normal"])
COUNTED = {"binomial": ("binom", 2), "poisson": ("poisson", 1), "geometric": ("geom", 1)}


class NumpyDraws:
    """The methods of `numpy.random.Generator` and `RandomState`, drawn by a script."""

    def __init__(self, script: Script) -> None:
        self._script = script

    def __deepcopy__(self, memo: dict[int, Any]) -> NumpyDraws:
        return self

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return functools.partial(self._distribution, name)

    def _distribution(self, name: str, *given: Any, **named: Any) -> Any:
        """A draw of the distribution of this name."""
        if name in CONTINUOUS:
            law, parameters = CONTINUOUS[name]
            scale, shift, size = parameters(*given, **named)

            def draw(scale: float, shift: float) -> Any:
                return (
                    Drawn(self._script, [law, 0.0, 1.0, where()], scale, shift) if scale else shift
                )

            return self._each(draw, size, scale, shift)
        if name == "seed":
            return None
        if name not in COUNTED:
            raise Stop(f"{where()} draws by `{name}`, which cannot be enumerated")
        kind, n = COUNTED[name]
        size = given[n] if len(given) > n else named.pop("size", None)

        def count(*parameters: float) -> Count:
            low, under = table(kind, *parameters)
            return Count(self._script, [low, low + len(under) - 2, (low, under)])

        return self._each(count, size, *given[:n], *named.values(), dtype=np.int64)

    def _each(self, draw: Callable[..., Any], size: Any, *given: Any, dtype: Any = object) -> Any:
        """One draw, or an array of draws, with parameters that may be arrays."""
        self._script.visit()
        shape = np.broadcast_shapes(*map(np.shape, given)) if size is None else np.empty(size).shape
        flat = [np.broadcast_to(x, shape).ravel().tolist() for x in given]
        drawn = np.empty(math.prod(shape), object)
        drawn[:] = [draw(*parameters) for parameters in zip(*flat, strict=True)]
        if shape == () and isinstance(drawn[0], Drawn | Count):
            return drawn[0]
        return drawn.reshape(shape).astype(dtype)[()]

    def integers(
        self, low: Any, high: Any = None, size: Any = None, dtype: Any = int, endpoint: bool = False
    ) -> Any:
        low, high = (0, low) if high is None else (low, high)

        def draw(low: int, high: int) -> int:
            if (n := int(high) - int(low) + endpoint) < 1:
                raise ValueError("low >= high")
            return int(low) + self._script.branch(n)

        return self._each(draw, size, low, high, dtype=dtype)

    randint = integers

    def _pick(self, n: int, weights: Sequence[float] | None) -> int:
        if weights is None:
            return self._script.branch(n)
        total = math.fsum(weights)
        return self._script.branch([float(w) / total for w in weights])

    def _in_order(self, n: int, of: int, weights: list[float] | None = None) -> list[int]:
        """``n`` different numbers below ``of``, in the order in which they are drawn."""
        self._script.visit()
        if math.perm(of, n) > MOST_BRANCHES:
            verb = f"shuffles {n}" if n == of else f"draws {n} of {of}"
            raise Stop(f"{where()} {verb} things: too many orders")
        left, picked = list(range(of)), []
        for _ in range(n):
            i = self._pick(len(left), weights)
            picked.append(left.pop(i))
            if weights is not None:
                weights.pop(i)
        return picked

    def choice(self, a: Any, size: Any = None, replace: bool = True, p: Any = None) -> Any:
        pool = np.arange(a) if isinstance(a, int | np.integer) else np.asarray(a)
        if replace or size is None:
            indices = self._each(lambda _: self._pick(len(pool), p), size, 0, dtype=int)
            return pool[indices]
        indices = self._in_order(int(np.prod(size)), len(pool), None if p is None else list(p))
        return pool[indices].reshape(np.empty(size).shape + pool.shape[1:])

    def permutation(self, x: Any) -> Any:
        pool = np.arange(x) if isinstance(x, int | np.integer) else np.asarray(x)
        return pool[self._in_order(len(pool), len(pool))]

    def shuffle(self, x: Any) -> None:
        order = self._in_order(len(x), len(x))
        x[:] = x[order] if isinstance(x, np.ndarray) else [x[i] for i in order]


class PythonDraws(NumpyDraws):
    """The methods of Python's `random.Random`, drawn by a script."""

    def randrange(self, start: int, stop: int | None = None, step: int = 1) -> int:
        values = range(start) if stop is None else range(start, stop, step)
        return values[int(self.integers(len(values)))]

    def randint(self, a: int, b: int) -> int:  # type: ignore[override]
        return self.randrange(a, b + 1)

    def choice(self, seq: Sequence[Any]) -> Any:  # type: ignore[override]
        return seq[self.randrange(len(seq))]

    def choices(self, population: Sequence[Any], weights: Any = None, *, k: int = 1) -> list[Any]:
        self._script.visit()
        return [population[self._pick(len(population), weights)] for _ in range(k)]

    def sample(self, population: Sequence[Any], k: int) -> list[Any]:
        return [population[i] for i in self._in_order(k, len(population))]


GENERATORS = (np.random.Generator, np.random.RandomState, random.Random, NumpyDraws)

NOT_REPLACED = {"_inst", "_rand", "getstate", "setstate", "get_state", "set_state"}


@contextmanager
def scripted(script: Script, holders: Iterable[Any]) -> Iterator[None]:
    """Let generators that the holders hold follow the script, and `random` and `numpy.random`.

    A holder is a list, or an object or module with attributes; functions of `random` and
    `numpy.random` that it holds by name follow the script, too.
    """
    python, numpy_ = PythonDraws(script), NumpyDraws(script)
    shared = [np.random.mtrand._rand, random._inst]
    replaced = []
    for holder in [random, np.random, *holders]:
        held: Any = holder if isinstance(holder, dict | list) else getattr(holder, "__dict__", {})
        for key in list(held) if isinstance(held, dict) else range(len(held)):
            value = held[key]
            owner = value if isinstance(value, GENERATORS) else getattr(value, "__self__", None)
            if not isinstance(owner, GENERATORS) or key in NOT_REPLACED:
                continue
            draws = python if isinstance(owner, random.Random) else numpy_
            if value is owner or any(owner is known for known in shared):
                replaced.append((held, key, value))
                held[key] = draws if value is owner else getattr(draws, value.__name__)
    try:
        yield
    finally:
        for held, key, value in replaced:
            held[key] = value
