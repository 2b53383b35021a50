"""The arguments of the agents' constructors, and the check of values against them.

Importing an agent takes two seconds, for torch. So the signatures of the registered agents stand in
``hyperparams/arguments.json``, which a test compares with the classes; after a change run
``python -m rl_yardstick.pipeline.arguments``. Agents that are not in it are imported.
"""

from __future__ import annotations

import inspect
import json
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from rl_yardstick.pipeline.errors import UserError, shown, unknown

TABLE = Path(__file__).parents[1] / "hyperparams" / "arguments.json"

# Arguments that a flag or another key sets.
_SET_ELSEWHERE = {"env", "seed", "device", "verbose", "tensorboard_log", "action_noise"}
_INTERNAL = {"self", "_init_setup_model"}
_PLAIN = {"bool": bool, "int": int, "float": float, "str": str, "dict": dict, "list": list}
_SCHEDULES = ("lin_", "exp_")

# Ranges that hold for every agent; an agent's own checks come when it is made.
_SHARE, _FROM_ZERO, _FROM_ONE = Field(ge=0, le=1), Field(ge=0), Field(ge=1, le=2**62)
_RANGES: dict[str, Any] = {
    **dict.fromkeys(("gamma", "gae_lambda", "tau", "exploration_fraction"), _SHARE),
    **dict.fromkeys(("exploration_initial_eps", "exploration_final_eps"), _SHARE),
    **dict.fromkeys(("n_steps", "batch_size", "n_epochs", "buffer_size"), _FROM_ONE),
    **dict.fromkeys(("train_freq", "target_update_interval", "stats_window_size"), _FROM_ONE),
    **dict.fromkeys(("learning_starts", "temperature", "vf_coef", "target_kl"), _FROM_ZERO),
    **dict.fromkeys(("clip_range", "clip_range_vf", "rms_prop_eps", "max_grad_norm"), _FROM_ZERO),
    **dict.fromkeys(("gradient_steps", "sde_sample_freq"), Field(ge=-1)),  # -1: each step, never
    # Larger rates overflow single precision in the first update.
    "learning_rate": Field(ge=0, le=1e37),
}
# Arguments of VecNormalize and Monitor that an entry may give.
_KEYWORDS = {
    "normalize": {
        **{key: ["bool"] for key in ("training", "norm_obs", "norm_reward")},
        **{key: ["float"] for key in ("clip_obs", "clip_reward", "gamma", "epsilon")},
        "norm_obs_keys": ["None", "list"],
    },
    "monitor_kwargs": {
        **{key: ["bool"] for key in ("allow_early_resets", "override_existing")},
        **{key: ["list"] for key in ("reset_keywords", "info_keywords")},
    },
}
AUTO = ("gamma", "learning_rate", "initial_q", "value_bound")


def arguments_of(algo: str) -> dict[str, list[str]]:
    """The arguments that hyperparameters may set: names, and the kinds of value each takes."""
    table = _table()
    return table[algo] if algo in table else read_signature(algo)


@cache
def _table() -> dict[str, dict[str, list[str]]]:
    found: dict[str, dict[str, list[str]]] = json.loads(TABLE.read_text(encoding="utf-8"))
    return found


def known_names() -> set[str]:
    """The arguments of all registered agents."""
    return {name for arguments in _table().values() for name in arguments}


def read_signature(algo: str) -> dict[str, list[str]]:
    """Import the agent's class and read its signature."""
    from rl_yardstick.agents import load_algorithm

    left_out = _SET_ELSEWHERE | _INTERNAL
    found = constructor_parameters(load_algorithm(algo))
    kinds = {name: sorted(_kinds(p.annotation, p.default)) for name, p in found.items()}
    return {name: kinds[name] for name in kinds if name not in left_out}


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
    if annotation in (None, type(None), "None"):
        return {"None"}
    if isinstance(annotation, str):
        parts = annotation.split(" | ")
        if len(parts) > 1:
            return set().union(*map(_kinds, parts))
        name = annotation.partition("[")[0]
        return {name if name in _PLAIN else "schedule" if name == "Schedule" else "any"}
    if annotation is inspect.Parameter.empty and type(default) in (int, float):
        return {type(default).__name__}
    if isinstance(annotation, type) and annotation.__name__ in _PLAIN:
        return {annotation.__name__}
    origin, members = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Literal:
        return {f"={word}" for word in members}
    if origin in (dict, list):
        return {origin.__name__}
    if origin is Sequence:
        return {"list"}
    if Callable in (annotation, origin):
        return {"schedule"}
    if members and origin not in (type, tuple):
        return set().union(*map(_kinds, members))
    return {"any"}


def check_arguments(algo: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values of constructor arguments, each of its type (``"1e-4"`` becomes a number).

    Raises:
        UserError: for a value that is not of its type or range.
    """
    known = arguments_of(algo)
    return {name: _checked(name, value, known[name]) for name, value in values.items()}


def check_keywords(key: str, given: Any) -> dict[str, Any]:
    """The arguments of VecNormalize or Monitor under a key of an entry."""
    if not isinstance(given, dict):
        raise UserError(f"{key} must be a mapping, not {shown(given)}")
    known = _KEYWORDS[key]
    for name in given:
        if name not in known:
            raise unknown(f"{key}: unknown argument", str(name), known)
    return {name: _checked(f"{key}: {name}", value, known[name]) for name, value in given.items()}


def _checked(name: str, value: Any, kinds: list[str]) -> Any:
    """The value, converted to one of the kinds."""
    if name == "train_freq" and not isinstance(value, list | tuple):  # or [4, "episode"]
        kinds = ["int"]
    if "any" in kinds or (value is None and "None" in kinds):
        return value
    if isinstance(value, str):
        if f"={value}" in kinds or (value == "auto" and name in AUTO):
            return value
        if "schedule" in kinds and value.startswith(_SCHEDULES):
            return value
    plain = [_PLAIN[kind] for kind in kinds if kind in _PLAIN]
    if (isinstance(value, bool) and bool not in plain) or not plain:
        raise UserError(f"{name} must be {_described(kinds)}, not {shown(value)}")
    expected: Any = typing.Union[tuple(plain)]  # noqa: UP007
    if name in _RANGES and str not in plain:
        expected = Annotated[expected, _RANGES[name]]
    try:
        found = TypeAdapter(expected).validate_python(value)
    except ValidationError as error:
        reason = error.errors()[0]["msg"]
        reason = f": {reason[0].lower()}{reason[1:]}" if name in _RANGES else ""
        described = _described(kinds)
        raise UserError(f"{name} must be {described}, not {shown(value)}{reason}") from None
    if isinstance(found, float) and not math.isfinite(found) and name != "max_grad_norm":
        raise UserError(f"{name} must be finite, not {shown(value)}")
    return found


def _described(kinds: list[str]) -> str:
    names = {"int": "a whole number", "float": "a number", "bool": "true or false", "str": "a text"}
    names |= {"schedule": "a schedule such as lin_0.001", "dict": "a mapping", "list": "a list"}
    names |= {"None": "none"}
    return " or ".join(names.get(kind, kind.lstrip("=")) for kind in kinds)


if __name__ == "__main__":
    from rl_yardstick.agents import ALGORITHMS

    signatures = {a: read_signature(a) for a, entry in ALGORITHMS.items() if entry.is_installed}
    TABLE.write_text(json.dumps(signatures, indent=1) + "\n", encoding="utf-8")
