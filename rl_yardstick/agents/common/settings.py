"""Settings of agents: checks of values, and complete constructor signatures."""

from __future__ import annotations

import inspect
import math
from abc import ABCMeta
from collections.abc import Iterable
from numbers import Integral
from typing import Any, Literal, TypedDict, get_args, get_type_hints

import torch as th
from gymnasium import spaces

from rl_yardstick.machine_code.compiling import inlined

# Constructors that pass arguments on to their base class, and still name all of them.
#
# A constructor may take ``**kwargs: Unpack[CommonArguments]``. Hyperparameter files are checked
# against the signature, and `help` shows it. So the signature lists the arguments in ``**kwargs``.

TieBreaking = Literal["random", "first"]
ExplorationDecay = Literal["constant", "linear", "exponential"]

_STARRED = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


class CommonArguments(TypedDict, total=False):
    """Arguments of every hand-written agent's constructor; see `OnlineAlgorithm`."""

    stats_window_size: int
    tensorboard_log: str | None
    verbose: int
    seed: int | None
    device: th.device | str
    _init_setup_model: bool


class LearningArguments(CommonArguments, total=False):
    """Arguments of every learning agent's constructor; see `LearningAlgorithm`."""

    tie_breaking: TieBreaking


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

    If ``**kwargs`` is annotated with its possible keys, only these are added. A constructor that
    takes ``*args`` passes positional arguments on as well, and adds keyword arguments.
    """
    merged = _merged([base for base in cls.__mro__ if "__init__" in vars(base)])
    return inspect.Signature(sorted(merged.values(), key=lambda parameter: parameter.kind))


def _merged(owners: list[Any]) -> dict[str, inspect.Parameter]:
    """The arguments of the first constructor, and for ``**kwargs`` those of the others."""
    if owners[0] is object:
        return {}
    own = _parameters(owners[0])
    merged = {p.name: p for p in own if p.name != "self" and p.kind not in _STARRED}
    rest = next((p for p in own if p.kind is p.VAR_KEYWORD), None)
    if rest is not None:
        known = get_args(rest.annotation)
        names = get_type_hints(known[0]) if known else None
        for name, parameter in _merged(owners[1:]).items():
            if names is None or name in names:
                merged.setdefault(name, parameter)
    return merged


def _parameters(owner: Any) -> list[inspect.Parameter]:
    try:
        return list(inspect.signature(owner.__init__, eval_str=True).parameters.values())
    except NameError:  # annotations that only a type checker can resolve
        return list(inspect.signature(owner.__init__).parameters.values())


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

Settings = Iterable[tuple[str, Any]]


def settings_of(agent: object, *names: str) -> Settings:
    """The values of the named arguments of an agent."""
    return [(name, getattr(agent, name)) for name in names]


def check_space(agent: object, role: str, space: spaces.Space[Any]) -> None:
    """Refuse spaces other than Discrete ones that start at 0."""
    if not isinstance(space, spaces.Discrete) or space.start != 0:
        raise ValueError(
            f"{type(agent).__name__} needs {role} in a Discrete space that starts at 0, not {space}"
        )


def check_vectors(agent: object, space: spaces.Space[Any]) -> None:
    """Refuse observation spaces that hold no vectors and that `check_space` refuses."""
    if not (isinstance(space, spaces.Box) and len(space.shape) == 1):
        check_space(agent, "observations of shape (d,) in a Box space or", space)


def check_option(name: str, value: object, options: Any) -> None:
    """Refuse a word that is not in the Literal ``options``."""
    if value not in get_args(options):
        raise ValueError(f"{name} must be one of {', '.join(get_args(options))}, not {value!r}")


def check_at_least(low: float, settings: Settings) -> None:
    """Refuse numbers below ``low``; other types pass."""
    for name, value in settings:
        if isinstance(value, int | float) and not value >= low:
            raise ValueError(f"{name} must be at least {low:g}, not {value}")


def check_whole(low: int, settings: Settings, high: int = 10**9) -> None:
    """Refuse values that are not integers from ``low`` to ``high``."""
    for name, value in settings:
        if isinstance(value, bool) or not isinstance(value, Integral) or value < low:
            raise ValueError(f"{name} must be a whole number of at least {low}, not {value!r}")
        if int(value) > high:
            raise ValueError(f"{name} must be at most {high}, not {value}")


def check_above_zero(settings: Settings) -> None:
    """Refuse numbers that are not above 0; other types pass."""
    for name, value in settings:
        if isinstance(value, int | float) and not value > 0:
            raise ValueError(f"{name} must be above 0, not {value}")


def check_share(settings: Settings) -> None:
    """Refuse numbers outside [0, 1]."""
    for name, value in settings:
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must lie between 0 and 1, not {value}")


def check_finite(settings: Settings) -> None:
    """Refuse infinite numbers and nan."""
    for name, value in settings:
        if not math.isfinite(value):
            raise ValueError(f"{name} must be finite, not {value}")


def check_epsilons(agent: Any) -> None:
    """Check the settings of the epsilon schedule."""
    check_option("exploration_decay", agent.exploration_decay, ExplorationDecay)
    names = ("exploration_fraction", "exploration_initial_eps", "exploration_final_eps")
    check_share(settings_of(agent, *names))


def check_learning_rate(learning_rate: object) -> None:
    """Refuse words except ``"sample_average"``, and numbers that are not step sizes."""
    if isinstance(learning_rate, int | float):
        check_at_least(0.0, [("learning_rate", learning_rate)])
        check_finite([("learning_rate", learning_rate)])
    if isinstance(learning_rate, str) and learning_rate != SAMPLE_AVERAGE:
        raise ValueError(
            f"learning_rate must be a number, a schedule or {SAMPLE_AVERAGE!r}, "
            f"not {learning_rate!r}"
        )
