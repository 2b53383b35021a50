"""Constructors that hand arguments on to their base class, and yet name all of them.

A constructor may take ``**kwargs: Unpack[CommonArguments]``. Hyperparameter files are checked
against the signature, and `help` shows it: so the arguments behind ``**kwargs`` are written out.
"""

from __future__ import annotations

import inspect
from abc import ABCMeta
from typing import Any, Literal, TypedDict, get_args, get_type_hints

import torch as th

TieBreaking = Literal["random", "first"]
ExplorationDecay = Literal["constant", "linear", "exponential"]

_STARRED = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


class CommonArguments(TypedDict, total=False):
    """What every hand-written agent's constructor takes; see `OnlineAlgorithm`."""

    stats_window_size: int
    tensorboard_log: str | None
    verbose: int
    seed: int | None
    device: th.device | str
    _init_setup_model: bool


class LearningArguments(CommonArguments, total=False):
    """What that of every learning agent takes; see `LearningAlgorithm`."""

    tie_breaking: TieBreaking


class CheckedConstructor(ABCMeta):
    """The class of classes whose constructors take what their signature names, and nothing else."""

    __signature__: inspect.Signature

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        for name in kwargs:
            if name not in cls.__signature__.parameters:
                raise TypeError(f"{cls.__name__} has no argument {name!r}")
        return super().__call__(*args, **kwargs)


def full_signature(cls: type) -> inspect.Signature:
    """The constructor's own arguments, and in place of ``**kwargs`` those of the base class.

    Where ``**kwargs`` is annotated with the keys that it may have, no others are added. A
    constructor that takes ``*args`` hands those on as well, and adds what is given by name.
    """
    merged = _merged([base for base in cls.__mro__ if "__init__" in vars(base)])
    return inspect.Signature(sorted(merged.values(), key=lambda parameter: parameter.kind))


def _merged(owners: list[Any]) -> dict[str, inspect.Parameter]:
    """The arguments of the first constructor, and behind ``**kwargs`` those of the others."""
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
