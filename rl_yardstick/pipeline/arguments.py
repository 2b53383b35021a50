"""The arguments of the agents' constructors, and the check of values against them.

Importing an agent takes two seconds, for torch. So the signatures of the registered agents stand in
``hyperparams/arguments.json``, which a test compares with the classes; after a change run
``python -m rl_yardstick.pipeline.arguments``. Agents that are not in it are imported.
"""

from __future__ import annotations

import importlib
import inspect
import json
import math
import typing
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from rl_yardstick.pipeline.errors import UserError, shown, unknown

TABLE = Path(__file__).parents[1] / "hyperparams" / "arguments.json"

# Arguments that a flag or another key sets.
_SET_ELSEWHERE = {"env", "seed", "device", "verbose", "tensorboard_log", "action_noise"}
_INTERNAL = {"self", "_init_setup_model", "venv", "filename"}
_PLAIN = {"bool": bool, "int": int, "float": float, "str": str, "dict": dict, "list": list}
_WORDS = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "a text"}
_WORDS |= {"schedule": "a schedule such as lin_0.001", "dict": "a mapping", "list": "a list"}
_WORDS |= {"None": "none"}

# Ranges that hold for every agent; an agent's own checks come when it is made.
_RANGES = {
    "gamma gae_lambda tau": Field(ge=0, le=1),
    "exploration_fraction exploration_initial_eps exploration_final_eps": Field(ge=0, le=1),
    "n_steps batch_size n_epochs buffer_size": Field(ge=1, le=2**62),
    "train_freq target_update_interval stats_window_size": Field(ge=1, le=2**62),
    "learning_starts temperature vf_coef target_kl": Field(ge=0),
    "clip_range clip_range_vf rms_prop_eps max_grad_norm": Field(ge=0),
    "gradient_steps sde_sample_freq": Field(ge=-1),  # -1: each step, never
    # Larger rates overflow single precision in the first update.
    "learning_rate": Field(ge=0, le=1e37),
}
_RANGE_OF: dict[str, Any] = {name: r for names, r in _RANGES.items() for name in names.split()}
AUTO = ("gamma", "learning_rate", "initial_q", "value_bound")  # which may be ``auto``
# Keys of an entry that hold arguments of a class of the library's.
WRAPPERS = {
    "normalize": "stable_baselines3.common.vec_env:VecNormalize",
    "monitor_kwargs": "stable_baselines3.common.monitor:Monitor",
}


@cache
def _table() -> dict[str, dict[str, list[str]]]:
    return json.loads(TABLE.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def arguments_of(algo: str) -> dict[str, list[str]]:
    """The arguments that hyperparameters may set: names, and the kinds of value each takes."""
    return _table()[algo] if algo in _table() else read_signature(algo)


def known_names() -> set[str]:
    """The arguments of all registered agents."""
    return {name for algo in _table().keys() - WRAPPERS for name in _table()[algo]}


def read_signature(name: str) -> dict[str, list[str]]:
    """Import the class of an agent, or of a key of `WRAPPERS`, and read its signature."""
    from rl_yardstick.agents import load_algorithm

    module, _, cls = WRAPPERS.get(name, "").partition(":")
    found = constructor_parameters(
        getattr(importlib.import_module(module), cls) if module else load_algorithm(name)
    )
    kinds = {name: sorted(_kinds(p.annotation, p.default)) for name, p in found.items()}
    return {name: kinds[name] for name in kinds if name not in _SET_ELSEWHERE | _INTERNAL}


def constructor_parameters(cls: type) -> dict[str, inspect.Parameter]:
    """The arguments of a constructor, with those that ``**kwargs`` passes to base classes."""
    try:
        signature = inspect.signature(cls, eval_str=True)
    except (NameError, TypeError, AttributeError):  # some annotations are for type checkers alone
        signature = inspect.signature(cls)
    parameters = signature.parameters.values()
    named = {p.name: p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
    owners = [base for base in cls.__mro__[:-1] if "__init__" in vars(base)]
    if any(p.kind is p.VAR_KEYWORD for p in parameters) and len(owners) > 1:
        inherited = constructor_parameters(owners[1])
        if "env" in named and "policy" not in named:
            inherited.pop("policy", None)  # the constructor passes it itself
        named = {**inherited, **named}
    return named


def _kinds(annotation: Any, default: Any = None) -> set[str]:
    """The kinds of plain value that an annotation admits; ``any`` for classes and the unknown."""
    if annotation in (None, type(None)):
        return {"None"}
    if annotation is inspect.Parameter.empty and type(default) in (int, float):
        annotation = type(default)
    origin, members = typing.get_origin(annotation), typing.get_args(annotation)
    name = getattr(origin or annotation, "__name__", "")
    if name in _PLAIN:
        return {name}
    if origin is Literal:
        return {f"={word}" for word in members}
    if origin is Sequence:
        return {"list"}
    if Callable in (annotation, origin):
        return {"schedule"}
    if members and origin not in (type, tuple):
        return set().union(*map(_kinds, members))
    return {"any"}


def check_arguments(owner: str, values: Any, where: str = "") -> dict[str, Any]:
    """The values of constructor arguments, each of its type (``"1e-4"`` becomes a number).

    ``owner`` is an agent, or a key of `WRAPPERS`; ``where`` begins every message. Raises UserError
    for an argument that does not exist, or a value that is not of its type or range.
    """
    if not isinstance(values, dict):
        raise UserError(f"{owner} must be a mapping, not {shown(values)}")
    known = arguments_of(owner)
    for name in values:
        if name not in known:
            raise unknown(f"{where}unknown argument", str(name), known)
    return {name: _checked(f"{where}{name}", value, known[name]) for name, value in values.items()}


def _checked(name: str, value: Any, kinds: list[str]) -> Any:
    """The value, converted to one of the kinds."""
    if name == "train_freq" and not isinstance(value, list | tuple):  # or [4, "episode"]
        kinds = ["int"]
    if "any" in kinds or (value is None and "None" in kinds):
        return value
    if isinstance(value, str):
        if f"={value}" in kinds or (value == "auto" and name in AUTO):
            return value
        if "schedule" in kinds and value.startswith(("lin_", "exp_")):
            return value
    described = " or ".join(_WORDS.get(kind, kind.lstrip("=")) for kind in kinds)
    fault = f"{name} must be {described}, not {shown(value)}"
    plain = [_PLAIN[kind] for kind in kinds if kind in _PLAIN]
    if (isinstance(value, bool) and bool not in plain) or not plain:
        raise UserError(fault)
    limits = _RANGE_OF.get(name)
    expected: Any = typing.Union[tuple(plain)]  # noqa: UP007
    try:
        given = expected if limits is None or str in plain else Annotated[expected, limits]
        found = TypeAdapter(given).validate_python(value)
    except ValidationError as error:
        reason = error.errors()[0]["msg"]
        reason = f": {reason[0].lower()}{reason[1:]}" if limits is not None else ""
        raise UserError(f"{fault}{reason}") from None
    if isinstance(found, float) and not math.isfinite(found) and name != "max_grad_norm":
        raise UserError(f"{name} must be finite, not {shown(value)}")
    return found


if __name__ == "__main__":
    from rl_yardstick.agents import ALGORITHMS

    names = [name for name, entry in ALGORITHMS.items() if entry.is_installed]
    signatures = {name: read_signature(name) for name in (*names, *WRAPPERS)}
    TABLE.write_text(json.dumps(signatures, indent=1) + "\n", encoding="utf-8")
