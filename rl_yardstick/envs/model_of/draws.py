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
from gymnasium.utils import seeding

from rl_yardstick.envs.model_of.symbols import NORMAL, TAIL, UNIFORM, Drawn, Stop, where

NEVER = 1 << 60  # a time that no episode reaches
MOST = 20_000  # branches of one draw
LEAST_CHANCE = 1e-13  # branches of a lower probability are cut off
CUT_OFF = -1


class Again(BaseException):
    """A loop has come back to the draw after so many branches; or `CUT_OFF`."""


class Suspect(BaseException):
    """A place in the code (given) draws a second time; also given: when it drew first, the run."""


class Script:
    """The branches that the draws of one run take, and what the run tells about them."""

    def __init__(self) -> None:
        self.time, self.until = 0, NEVER  # what a run does at this time holds until then
        self.level = 0.5  # the quantile, of what is known, at which a continuous number is a float
        self.begin([], 0, {})

    def begin(self, choices: list[int], root: int, loops: dict[Any, bool]) -> None:
        """Start a run. Loops are looked for after ``root`` branches; the known ones are given."""
        self.choices, self.root, self.loops = choices, root, loops
        self.trace: list[tuple[int, list[float]]] = []
        self.chance = 1.0
        self.visits: dict[Any, int] = {}
        self.floats: list[Drawn] = []  # continuous numbers that were turned into floats

    def branch(self, chances: int | Sequence[float]) -> int:
        """The number of the branch to take, of so many equal ones or of ones with these weights."""
        weights = [1.0] * min(chances, MOST + 1) if isinstance(chances, int) else chances
        if len(weights) > MOST:
            raise Stop(f"{where()} draws one of more than {MOST:,} values")
        if len(weights) == 1:
            return 0
        depth, total = len(self.trace), math.fsum(weights)
        shares = [float(weight) / total for weight in weights]
        taken = depth < len(self.choices)
        choice = self.choices[depth] if taken else next(i for i, p in enumerate(shares) if p > 0)
        self.trace.append((choice, shares))
        self.chance *= shares[choice]
        if self.chance < LEAST_CHANCE and depth >= self.root:
            raise Again(CUT_OFF)
        return choice

    def visit(self) -> None:
        """Note the place in the code that draws, to find loops that draw until they like it."""
        depth, frame = len(self.trace), sys._getframe(1)
        place: tuple[Any, ...] = ()
        while frame.f_code is not take_step.__code__ and frame.f_back:
            if frame.f_code.co_filename != __file__:
                place = (*place, frame.f_code, frame.f_lasti)
            frame = frame.f_back
        if depth >= self.root and (first := self.visits.setdefault(place, depth)) < depth:
            if (starts_again := self.loops.get(place)) is None:
                raise Suspect(place, first, [choice for choice, _ in self.trace])
            if starts_again:
                raise Again(first)
            self.visits[place] = depth


def take_step(env: gym.Env[Any, Any], action: Any) -> tuple[Any, ...]:
    """One step, or the reset if the action is None; here the stack of a script ends."""
    return (env.reset()[0], 0.0, False, False) if action is None else env.step(action)[:4]


# The law, its parameters (scale and shift of a continuous one) and the size, from the arguments.
LAWS: dict[str, Callable[..., tuple[Any, ...]]] = {
    "random": lambda size=None, dtype=None: (UNIFORM, 1.0, 0.0, size),
    "rand": lambda *shape: (UNIFORM, 1.0, 0.0, shape or None),
    "uniform": lambda low=0.0, high=1.0, size=None: (UNIFORM, np.subtract(high, low), low, size),
    "normal": lambda loc=0.0, scale=1.0, size=None: (NORMAL, scale, loc, size),
    "standard_normal": lambda size=None: (NORMAL, 1.0, 0.0, size),
    "randn": lambda *shape: (NORMAL, 1.0, 0.0, shape or None),
    "binomial": lambda n, p, size=None: ("binom", n, p, size),
    "poisson": lambda lam=1.0, size=None: ("poisson", lam, size),
    "geometric": lambda p, size=None: ("geom", p, size),
}
LAWS |= {"random_sample": LAWS["random"], "gauss": LAWS["normal"], "normalvariate": LAWS["normal"]}


@functools.cache
def table(name: str, *parameters: float) -> tuple[int, list[float]]:
    """The lowest value of one of SciPy's distributions, and the chances of it and the next ones."""
    from scipy import stats

    law = getattr(stats, name)(*parameters)
    low, high = int(law.support()[0]), int(law.isf(TAIL))
    return low, law.pmf(np.arange(low, high + 1)).tolist()


class NumpyDraws:
    """The methods of `numpy.random.Generator` and `RandomState`, drawn by a script."""

    def __init__(self, script: Script) -> None:
        self._script = script

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return functools.partial(self._distribution, name)

    def _distribution(self, name: str, *given: Any, **named: Any) -> Any:
        """A draw from the law of this name."""
        if name == "seed":
            return None
        if name not in LAWS:
            raise Stop(f"{where()} draws by `{name}`, which cannot be enumerated")
        law, *parameters, size = LAWS[name](*given, **named)

        def draw(*parameters: float) -> Any:
            if isinstance(law, str):
                low, weights = table(law, *parameters)
                return low + self._script.branch(weights)
            scale, shift = parameters
            known = [law, 0.0, 1.0, where()]
            return Drawn(self._script, known, scale, shift) if scale else shift

        return self._each(draw, size, *parameters, dtype=int if isinstance(law, str) else object)

    def _each(self, draw: Callable[..., Any], size: Any, *given: Any, dtype: Any = int) -> Any:
        """One draw, or an array of draws, with parameters that may be arrays."""
        self._script.visit()
        if size is None and not any(map(np.ndim, given)):
            return np.asarray(draw(*given), dtype)[()]
        shaped = np.zeros(() if size is None else size)
        drawn = np.frompyfunc(lambda _, *given: draw(*given), 1 + len(given), 1)(shaped, *given)
        return np.asarray(drawn, dtype)[()]

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

    def _in_order(self, n: int, of: int, weights: list[float] | None = None) -> list[int]:
        """``n`` different numbers below ``of``, in the order in which they are drawn."""
        self._script.visit()
        if math.perm(of, n) > MOST:
            verb = f"shuffles {n}" if n == of else f"draws {n} of {of}"
            raise Stop(f"{where()} {verb} things: too many orders")
        left, picked = list(range(of)), []
        for _ in range(n):
            i = self._script.branch(weights or len(left))
            picked.append(left.pop(i))
            if weights:
                del weights[i]
        return picked

    def choice(
        self, a: Any, size: Any = None, replace: bool = True, p: Any = None, shuffle: bool = True
    ) -> Any:
        pool = np.arange(a) if isinstance(a, int | np.integer) else np.asarray(a)
        weights = None if p is None else [float(x) for x in p]
        if replace or size is None:
            return pool[self._each(lambda: self._script.branch(weights or len(pool)), size)]
        indices = self._in_order(int(np.prod(size)), len(pool), weights)
        return pool[indices].reshape(np.empty(size).shape + pool.shape[1:])

    def permutation(self, x: Any) -> Any:
        pool = np.arange(x) if isinstance(x, int | np.integer) else np.asarray(x)
        return pool[self._in_order(len(pool), len(pool))]

    def shuffle(self, x: Any) -> None:
        order = self._in_order(len(x), len(x))
        x[:] = x[order] if isinstance(x, np.ndarray) else [x[i] for i in order]


class PythonDraws(NumpyDraws):
    """The methods of Python's `random.Random`, drawn by a script."""

    def randrange(self, *bounds: int) -> int:
        return range(*bounds)[int(self.integers(len(range(*bounds))))]

    def randint(self, a: int, b: int) -> int:  # type: ignore[override]
        return self.randrange(a, b + 1)

    def choice(self, seq: Sequence[Any]) -> Any:  # type: ignore[override]
        return seq[self.randrange(len(seq))]

    def choices(
        self, population: Sequence[Any], weights: Any = None, *, cum_weights: Any = None, k: int = 1
    ) -> list[Any]:
        self._script.visit()
        weights = weights if cum_weights is None else np.diff(cum_weights, prepend=0.0).tolist()
        return [population[self._script.branch(weights or len(population))] for _ in range(k)]

    def sample(self, population: Sequence[Any], k: int) -> list[Any]:
        return [population[i] for i in self._in_order(k, len(population))]


GENERATORS = (np.random.Generator, np.random.RandomState, random.Random, NumpyDraws)

NOT_REPLACED = {"_inst", "_rand", "getstate", "setstate", "get_state", "set_state"}


def owner_of(value: Any) -> Any:
    """The generator that a value is, or whose method it is; None if it is neither."""
    owner = getattr(getattr(value, "func", value), "__self__", value)
    return owner if isinstance(owner, GENERATORS) else None


def _made(make: Callable[..., Any], scripted: Any) -> Callable[..., Any]:
    """What makes generators, which follow the script unless they are given a seed."""

    def made(*given: Any, **named: Any) -> Any:
        is_seeded = {*given, *named.values()} - {None}
        is_of_scipy = sys._getframe(1).f_globals["__name__"].startswith("scipy.")  # at its import
        return make(*given, **named) if is_seeded or is_of_scipy else scripted

    if isinstance(make, type):  # others may ask what is an instance of it
        return type(
            make.__name__, (make,), {"__new__": lambda _, *given, **named: made(*given, **named)}
        )
    return made


@contextmanager
def scripted(script: Script, holders: Iterable[Any]) -> Iterator[Callable[[bool], None]]:
    """Let generators that the holders hold follow the script, and `random` and `numpy.random`.

    A holder is a list, or an object or module with attributes. Methods of generators that it
    holds by name follow the script, too, and so do generators made without a seed. The function
    given puts them all in their places, or the real ones.
    """
    python, numpy_ = PythonDraws(script), NumpyDraws(script)
    makers: list[tuple[Any, Any]] = [
        (np.random.default_rng, numpy_),
        (np.random.RandomState, numpy_),
    ]
    makers += [(random.Random, python), (seeding.np_random, (numpy_, 0))]
    replaced = []
    for holder in [random, np.random, seeding, *holders]:
        held: Any = holder if isinstance(holder, dict | list) else getattr(holder, "__dict__", {})
        for key, value in list(held.items() if isinstance(held, dict) else enumerate(held)):
            owner = owner_of(value)
            new: Any = next((_made(make, made) for make, made in makers if value is make), None)
            if owner is not None and key not in NOT_REPLACED:
                draws = python if isinstance(owner, random.Random) else numpy_
                new = draws if value is owner else getattr(draws, value.__name__)
            if new is not None:
                replaced.append((held, key, (value, new)))

    def put(is_scripted: bool) -> None:
        for held, key, values in replaced:
            held[key] = values[is_scripted]

    put(True)
    try:
        yield put
    finally:
        put(False)
