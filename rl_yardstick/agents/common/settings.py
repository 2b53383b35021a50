"""Settings of agents: checks of values, and complete constructor signatures."""

from __future__ import annotations

import inspect
import math
from abc import ABCMeta
from numbers import Integral
from typing import Any, Literal, NamedTuple, get_args, get_origin

from gymnasium import spaces

from rl_yardstick.envs.finite_spaces import bijection_of
from rl_yardstick.machine_code.compiling import inlined

TieBreaking = Literal["random", "first"]
ExplorationDecay = Literal["constant", "linear", "exponential"]


class CheckedConstructor(ABCMeta):
    """Metaclass: the constructor refuses arguments that its signature does not name."""

    __signature__: inspect.Signature

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        for name in kwargs:
            if name not in cls.__signature__.parameters:
                raise TypeError(f"{cls.__name__} has no argument {name!r}")
        return super().__call__(*args, **kwargs)


def full_signature(cls: type) -> inspect.Signature:
    """The constructor's signature, with the base class's arguments in place of ``**kwargs``.

    A class's ``hidden_arguments`` are those of its base class that it sets itself. Hyperparameter
    files are checked against the signature, and `help` shows it.
    """
    merged = _merged([base for base in cls.__mro__ if "__init__" in vars(base)])
    return inspect.Signature(sorted(merged.values(), key=lambda parameter: parameter.kind))


def _merged(owners: list[Any]) -> dict[str, inspect.Parameter]:
    """The arguments of the first constructor, and for ``**kwargs`` those of the others."""
    if owners[0] is object:
        return {}
    try:
        own = inspect.signature(owners[0].__init__, eval_str=True).parameters.values()
    except NameError:  # annotations that only a type checker can resolve
        own = inspect.signature(owners[0].__init__).parameters.values()
    starred = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    merged = {p.name: p for p in own if p.name != "self" and p.kind not in starred}
    if any(p.kind is p.VAR_KEYWORD for p in own):
        hidden = vars(owners[0]).get("hidden_arguments", ())
        passed_on = _merged(owners[1:]).items()
        merged = {**{n: p for n, p in passed_on if n not in hidden}, **merged}
    return merged


# Step sizes: how far an estimate moves towards its target.
#
# Sutton and Barto (2nd edition), section 2.4 (sample averages) and 2.5 (constant step size).

SAMPLE_AVERAGE = "sample_average"


@inlined
def step_size(learning_rate: float, sample_average: bool, visit_count: int) -> float:
    """1/N at the N-th visit if ``sample_average``, else the learning rate."""
    if sample_average:
        return 1.0 / visit_count
    return learning_rate


# Checks of arguments: each error is one line that names the argument and its range.


class Range(NamedTuple):
    """The finite numbers that an argument may be; schedules and None pass."""

    low: float = -math.inf
    high: float = math.inf
    is_open: bool = False  # whether ``low`` itself is left out
    is_whole: bool = False

    def check(self, name: str, value: Any) -> None:
        """Raise ValueError for another number."""
        if value is None or callable(value):
            return
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if self.is_whole and not (whole and value >= self.low):
            raise ValueError(
                f"{name} must be a whole number of at least {self.low:g}, not {value!r}"
            )
        if self.is_open and not value > self.low:
            raise ValueError(f"{name} must be above {self.low:g}, not {value}")
        if self.is_whole and value > self.high:
            raise ValueError(f"{name} must be at most {self.high:.0f}, not {value}")
        if self.high < math.inf and not self.low <= value <= self.high:
            raise ValueError(f"{name} must lie between {self.low:g} and {self.high:g}, not {value}")
        if self.low > -math.inf and not value >= self.low:
            raise ValueError(f"{name} must be at least {self.low:g}, not {value}")
        if not math.isfinite(value):
            raise ValueError(f"{name} must be finite, not {value}")


FINITE, NOT_NEGATIVE, POSITIVE = Range(), Range(0), Range(0, is_open=True)
SHARE, POSITIVE_SHARE = Range(0, 1), Range(0, 1, is_open=True)


def whole(low: int) -> Range:
    """The whole numbers from ``low`` to a billion."""
    return Range(low, 1e9, is_whole=True)


EPSILONS = dict.fromkeys(
    ("exploration_fraction", "exploration_initial_eps", "exploration_final_eps"), SHARE
)


def check_settings(agent: Any) -> None:
    """Check an agent's settings by the ``ranges`` of its classes and the words of its signature."""
    ranges: dict[str, Range] = {}
    for cls in type(agent).__mro__:
        ranges = {**vars(cls).get("ranges", {}), **ranges}
    for name, parameter in type(agent).__signature__.parameters.items():
        value, known = getattr(agent, name, None), words(parameter.annotation)
        if not isinstance(value, str):
            if name in ranges:
                ranges[name].check(name, value)
        elif value not in known and name in ranges:
            last = f", a schedule or {known[0]!r}" if known else " or a schedule"
            raise ValueError(f"{name} must be a number{last}, not {value!r}")
        elif value not in known and known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, not {value!r}")


def words(annotation: Any) -> list[str]:
    """The words that an annotation allows."""
    kinds = (annotation, *get_args(annotation))
    return [word for kind in kinds if get_origin(kind) is Literal for word in get_args(kind)]


def check_space(agent: object, role: str, space: spaces.Space[Any]) -> None:
    """Refuse spaces other than Discrete ones that start at 0."""
    if not isinstance(space, spaces.Discrete) or space.start != 0:
        fault = f"{type(agent).__name__} needs {role} in a Discrete space that starts at 0"
        way_out = "wrap each environment in rl_yardstick.envs.wrappers.FlattenToDiscrete"
        raise ValueError(f"{fault}, not {space}{f': {way_out}' if bijection_of(space) else ''}")


def check_vectors(agent: object, space: spaces.Space[Any]) -> None:
    """Refuse observation spaces that hold no vectors and that `check_space` refuses."""
    if not (isinstance(space, spaces.Box) and len(space.shape) == 1):
        check_space(agent, "observations of shape (d,) in a Box space or", space)
