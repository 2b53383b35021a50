"""Numbers without a value: continuous draws, and what stands in for watched attributes.

A continuous number is known by its distribution only. Comparing or rounding it branches with the
exact probability of each side, and narrows what is known of it: ``u < 0.3``, ``int(6 * u)``,
``searchsorted(cdf, u)`` and ``round(normal)`` have as many outcomes as they can show.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import NormalDist
from time import perf_counter, process_time
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

TAIL = 1e-15  # of a distribution, left out
NOT_OF_AN_ENVIRONMENT = (str(Path(__file__).parent), np.__path__[0])
NORMAL = NormalDist()
UNIFORM = SimpleNamespace(
    cdf=lambda x: min(max(x, 0.0), 1.0), inv_cdf=lambda q: q, mean=0.5, variance=1 / 12
)


class Stop(BaseException):
    """No model can be found; passes through an environment's own ``except Exception``."""


class Limit(Stop):
    """The search came to one of its limits."""


def stopwatch() -> Callable[[], float]:
    """What tells the seconds since: of the processor, but half of the clock's if that is more."""
    begun = process_time(), perf_counter()
    return lambda: max(process_time() - begun[0], (perf_counter() - begun[1]) / 2)


def where() -> str:
    """The file and line of the environment that is running, as ``env.py:110``."""
    frame = sys._getframe(1)
    while frame.f_back and frame.f_code.co_filename.startswith(NOT_OF_AN_ENVIRONMENT):
        frame = frame.f_back
    return f"{frame.f_code.co_filename.rpartition('/')[2]}:{frame.f_lineno}"


class Symbol(NDArrayOperatorsMixin):
    """The number ``scale * x + shift``; numbers made from one draw share what is known of x.

    Every operator and NumPy function of it comes to `__array_ufunc__`. A subclass has ``now()``, a
    value or a refusal, and ``below(cut, closed)``: whether x < cut, or x <= cut if closed.
    """

    now: Callable[[], Any]
    below: Callable[[Any, bool], Any]

    def __init__(self, script: Any, known: Any, scale: float = 1, shift: Any = 0) -> None:
        self.script, self.known, self.scale, self.shift = script, known, scale, shift

    def linear(self, scale: float, shift: Any) -> Self:
        """``scale`` times this number plus ``shift``."""
        return type(self)(self.script, self.known, self.scale * scale, self.shift * scale + shift)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **keywords: Any) -> Any:
        if isinstance(keywords.get("out", (None,))[0], Symbol):
            del keywords["out"]  # `x += 1` makes a new number
        rule = RULES.get(ufunc)
        if rule is None or method != "__call__" or keywords:
            inputs = tuple(x.now() if isinstance(x, Symbol) else x for x in inputs)
            result = getattr(ufunc, method)(*inputs, **keywords)
        else:
            result = rule(*(x.item() if isinstance(x, np.generic) else x for x in inputs))
        return result.item() if isinstance(result, np.generic) else result

    def __bool__(self) -> bool:
        return bool(self != 0)

    def over(self, divisor: Any) -> Any:
        """The whole part of its quotient."""
        return float(math.floor(self / divisor))

    def rint(self, decimals: int = 0, out: None = None) -> Any:
        """As `numpy.round` calls it, for arrays; for numbers, it calls ``round``."""
        return float(self.__round__(decimals))  # type: ignore[attr-defined]

    def __reduce_ex__(self, protocol: Any) -> Any:
        value = self.now()
        return type(value), (value,)


def _value_method(name: str) -> Callable[..., Any]:
    return lambda self, *given: getattr(self.now(), name)(*given)


for _name in ["int", "float", "index", "hash", "str", "format", "round", "floor", "ceil", "trunc"]:
    setattr(Symbol, f"__{_name}__", _value_method(f"__{_name}__"))

setattr(Symbol, "round", Symbol.rint)  # noqa: B010


def _add(a: Any, b: Any, sign: int = 1) -> Any:
    if not isinstance(b, Symbol):
        return a.linear(1, sign * b)
    if not isinstance(a, Symbol):
        return b.linear(sign, a)
    if a.known is not b.known:
        return a + sign * b.now()
    scale, shift = a.scale + sign * b.scale, a.shift + sign * b.shift
    return type(a)(a.script, a.known, scale, shift) if scale else shift


def _multiply(a: Any, b: Any) -> Any:
    a, b = (a, b) if isinstance(a, Symbol) else (b, a)
    if isinstance(b, Symbol) or np.ndim(b):
        return a.now() * b
    return a.linear(b, 0) if b else 0 * b


def _less(a: Any, b: Any, or_equal: bool = False) -> Any:
    x = _add(a, b, -1)
    if not isinstance(x, Symbol):
        return x <= 0 if or_equal else x < 0
    is_below = x.below(-x.shift / x.scale, or_equal == (x.scale > 0))
    return is_below if x.scale > 0 else np.logical_not(is_below)


def _equal(a: Any, b: Any) -> Any:
    return np.logical_not(_less(a, b)) & _less(a, b, or_equal=True)


RULES: dict[np.ufunc, Callable[..., Any]] = {
    np.add: _add,
    np.subtract: lambda a, b: _add(a, b, -1),
    np.multiply: _multiply,
    np.divide: lambda a, b: a / b.now() if isinstance(b, Symbol) else _multiply(a, 1 / b),
    np.negative: lambda a: a.linear(-1, 0),
    np.less: _less,
    np.less_equal: lambda a, b: _less(a, b, or_equal=True),
    np.greater: lambda a, b: _less(b, a),
    np.greater_equal: lambda a, b: _less(b, a, or_equal=True),
    np.equal: _equal,
    np.not_equal: lambda a, b: np.logical_not(_equal(a, b)),
    np.maximum: lambda a, b: b if a < b else a,
    np.minimum: lambda a, b: a if a < b else b,
    np.floor: lambda a: float(math.floor(a)),
    np.ceil: lambda a: float(math.ceil(a)),
    np.rint: lambda a: a.rint(),
    np.floor_divide: lambda a, b: a // b.now() if isinstance(b, Symbol) else a.over(b),
}


class Drawn(Symbol):
    """A continuous number; known are its law, two quantiles around it, and where it was drawn."""

    def _split(self, at: list[float]) -> None:
        """Branch over the intervals between these quantiles, and narrow what is known."""
        low, high = self.known[1:3]
        bounds = [low, *sorted({q for q in at if low < q < high}), high]
        interval = self.script.branch([b - a for a, b in pairwise(bounds)])
        self.known[1:3] = bounds[interval : interval + 2]

    def below(self, cut: Any, closed: bool) -> Any:
        at = [self.known[0].cdf(x) for x in np.ravel(cut).tolist()]
        self._split(at)
        return (np.array(at) > self.known[1]).reshape(np.shape(cut))[()]

    def at(self, quantile: float) -> float:
        """Its value at a quantile of what is known."""
        law, low, high, _ = self.known
        q = min(max(low + quantile * (high - low), TAIL), 1 - TAIL)
        return float(self.scale * law.inv_cdf(q) + self.shift)

    def __floor__(self) -> int:
        first, last = (math.floor(end) for end in sorted((self.at(0.0), self.at(1.0))))
        whole = range(first, last + 1) if last - first < 1e6 else self.now()
        self._split([self.known[0].cdf((i - self.shift) / self.scale) for i in whole])
        return int(self.at(0.5) // 1)

    def __ceil__(self) -> int:
        return -int((-self).__floor__())

    def __trunc__(self) -> int:
        return math.ceil(self) if self < 0 else math.floor(self)

    __int__ = __trunc__

    def __round__(self, digits: int | None = None) -> Any:
        power = 10.0 ** (digits or 0)
        whole = math.floor(self * power + 0.5)
        return whole if digits is None else whole / power

    def now(self) -> Any:
        raise Stop(f"{self.known[3]} draws a continuous number, which reaches the state")

    def __float__(self) -> float:
        self.script.floats.append(self)  # the reward may depend on it linearly: see `search`
        return self.at(self.script.level)

    def moments(self) -> tuple[float, float]:
        """Its mean and variance."""
        law, low, high, place = self.known
        mean, variance = law.mean, law.variance
        if law is UNIFORM:
            mean, variance = (low + high) / 2, (high - low) ** 2 / 12
        elif (low, high) != (0.0, 1.0):
            raise Stop(f"{place} draws a continuous reward that is cut off at a bound")
        return self.scale * mean + self.shift, self.scale**2 * variance
