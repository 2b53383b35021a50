"""Constructors that hand arguments on to their base class, and yet name all of them.

A constructor may take ``**kwargs: Unpack[CommonArguments]``. Hyperparameter files are checked
against the signature, and `help` shows it: so the arguments behind ``**kwargs`` are written out.
"""

from __future__ import annotations

import inspect
from typing import Literal, TypedDict, get_args, get_type_hints

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


def full_signature(cls: type) -> inspect.Signature:
    """The constructor's own arguments, and in place of ``**kwargs`` those of the base class.

    Where ``**kwargs`` is annotated with the keys that it may have, no others are added. A
    constructor that takes ``*args`` hands those on as well, and adds what is given by name.
    """
    owner = next(base for base in cls.__mro__ if "__init__" in vars(base))
    own = inspect.signature(vars(owner)["__init__"], eval_str=True).parameters.values()
    merged = {p.name: p for p in own if p.name != "self" and p.kind not in _STARRED}
    rest = next((p for p in own if p.kind is p.VAR_KEYWORD), None)
    if rest is not None:
        above = cls.__mro__[cls.__mro__.index(owner) + 1]
        known = get_args(rest.annotation)
        names = get_type_hints(known[0]) if known else None
        for name, parameter in full_signature(above).parameters.items():
            if names is None or name in names:
                merged.setdefault(name, parameter)
    return inspect.Signature(sorted(merged.values(), key=lambda parameter: parameter.kind))
