"""Arguments of a constructor: checked by name, by type, and against bounds."""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, get_args

from pipeline.errors import UserError, shown, unknown
from pipeline.settings.coercion import ScheduleSpec, coerce

_FINITE = sys.float_info.max
_LARGEST_WHOLE = 2**63 - 1
_STARRED = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)

# Bounds, both included, of hyperparameters that mean the same in every algorithm.
RANGES: Mapping[str, tuple[float, float]] = {
    "n_timesteps": (1, _FINITE),
    "n_episodes": (1, _FINITE),
    "n_envs": (1, _FINITE),
    "frame_stack": (1, _FINITE),
    "noise_std": (0, _FINITE),
    # Above that a network's first step has no single precision any more.
    "learning_rate": (0, 1e37),
    "gamma": (0, 1),
    "gae_lambda": (0, 1),
    "tau": (0, 1),
    "clip_range": (0, _FINITE),
    "clip_range_vf": (0, _FINITE),
    "exploration_fraction": (0, 1),
    "exploration_initial_eps": (0, 1),
    "exploration_final_eps": (0, 1),
    "temperature": (0, _FINITE),
    "batch_size": (1, _FINITE),
    "buffer_size": (1, _FINITE),
    "n_steps": (1, _FINITE),
    "n_epochs": (1, _FINITE),
    "learning_starts": (0, _FINITE),
    "train_freq": (1, _FINITE),
    # -1 stands for one for every step of the environment, or for never.
    "gradient_steps": (-1, _FINITE),
    "sde_sample_freq": (-1, _FINITE),
    "target_update_interval": (1, _FINITE),
    "max_grad_norm": (0, math.inf),
    "vf_coef": (0, _FINITE),
    "rms_prop_eps": (0, _FINITE),
    "target_kl": (0, _FINITE),
    "stats_window_size": (1, _FINITE),
}


def constructor_parameters(cls: type) -> Mapping[str, inspect.Parameter]:
    """The arguments of a class's constructor, annotations as objects wherever they resolve."""
    try:
        return inspect.signature(cls, eval_str=True).parameters
    except (NameError, AttributeError, TypeError, SyntaxError):
        # A name that only type checkers import; annotations that stay texts go unchecked.
        return inspect.signature(cls).parameters


@cache  # a run asks six times, and signatures take long to read
def algorithm_parameters(cls: type) -> Mapping[str, inspect.Parameter]:
    """The arguments of an algorithm's constructor, and those that ``**kwargs`` may hand on.

    ``**kwargs`` stays among them, since it may go elsewhere than to the base class. An argument
    without annotation whose default is a number is read as one wherever it can be.
    """
    own = dict(constructor_parameters(cls))
    rest = next((p for p in own.values() if p.kind is p.VAR_KEYWORD), None)
    owners = [base for base in cls.__mro__[:-1] if "__init__" in vars(base)]
    if rest is not None and len(owners) > 1:
        named = {name: p for name, p in own.items() if p.kind not in _STARRED}
        own = {**algorithm_parameters(owners[1]), **named, rest.name: rest}
        if "env" in named and "policy" not in named:
            own.pop("policy", None)  # which the constructor gives its base class itself
    return MappingProxyType({name: _annotated(parameter) for name, parameter in own.items()})


def _annotated(parameter: inspect.Parameter) -> inspect.Parameter:
    """The argument, with what its default says where it has no annotation."""
    default = parameter.default
    if set(get_args(parameter.annotation)) == {float, Callable}:
        # A number or a function of no said kind: sb3-contrib's TQC means a schedule.
        return parameter.replace(annotation=float | Callable[[float], float])
    if parameter.annotation is not parameter.empty or isinstance(default, bool):
        return parameter
    kinds: dict[type, Any] = {
        int: int | float | Any,
        float: float | Callable[[float], float] | Any,
    }
    return parameter.replace(annotation=kinds.get(type(default), parameter.empty))


def check_arguments(
    kwargs: Mapping[str, Any],
    parameters: Mapping[str, inspect.Parameter],
    where: str,
    what: str = "argument",
    also_known: Iterable[str] = (),
) -> dict[str, Any]:
    """Check arguments by name and type.

    Args:
        kwargs: the arguments as they stand in a file or on the command line.
        parameters: those that exist; with ``**kwargs`` among them any name is allowed.
        where: begins every error message.
        what: what an argument is called there.
        also_known: further names that a message may suggest.

    Returns:
        The arguments, each as its annotation asks for, see `pipeline.settings.coercion.coerce`.

    Raises:
        UserError: if a name is not known, naming the nearest, or a type does not fit.
    """
    admits_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    result = {}
    for name, value in kwargs.items():
        if name not in parameters and not admits_any:
            raise unknown(f"{where}: unknown {what}", name, [*parameters, *also_known])
        annotation = parameters[name].annotation if name in parameters else Any
        result[name] = coerce(value, annotation, f"{where}: {name}")
    return result


def check_range(name: str, value: object, where: str) -> None:
    """Refuse a number, or an end of a schedule, outside of `RANGES`, or that no array can hold.

    Raises:
        UserError: saying what the bounds are.
    """
    if isinstance(value, ScheduleSpec):
        check_range(name, value.start, where)
        check_range(name, value.end, where)
    if isinstance(value, tuple) and value:
        check_range(name, value[0], where)
    if isinstance(value, int) and abs(value) > _LARGEST_WHOLE:
        raise UserError(f"{where}: {name} must be at most {_LARGEST_WHOLE:,}, not {shown(value)}")
    if name in RANGES and isinstance(value, int | float):
        low, high = RANGES[name]
        if not low <= value <= high:
            bounds = f"at least {low}" if high >= _FINITE else f"between {low} and {high}"
            finite = " and finite" if value > high >= _FINITE else ""
            raise UserError(f"{where}: {name} must be {bounds}{finite}, not {shown(value)}")
