"""The arguments of an agent's constructor, checked down to its policy's, and built."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, get_args, get_origin

from pipeline.errors import UserError, unknown
from pipeline.settings.class_names import find_class
from pipeline.settings.components import build_value
from pipeline.settings.constructor_arguments import (
    algorithm_parameters,
    check_arguments,
    constructor_parameters,
)
from pipeline.settings.hyperparams import check_algorithm_kwargs
from pipeline.settings.literals import DottedName

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import BasePolicy


def build_algorithm_kwargs(
    algorithm: type[BaseAlgorithm],
    kwargs: Mapping[str, Any],
    where: str,
    extra_packages: Sequence[str] = (),
) -> dict[str, Any]:
    """An agent's constructor arguments, checked to the last one and built.

    Beyond `check_algorithm_kwargs` and `build_value`, the policy must exist and know what
    ``policy_kwargs`` says, where the class tells by ``policy_aliases`` which policies it has.

    Args:
        algorithm: the agent's class.
        kwargs: the arguments as they stand in a file, such as `Hyperparams.algorithm`.
        where: begins every error message.
        extra_packages: packages that the user allows besides the usual ones.

    Raises:
        UserError: naming the argument, and what it must be.
    """
    parameters = algorithm_parameters(algorithm)
    checked = check_algorithm_kwargs(kwargs, parameters, where)
    policy = _policy_class(algorithm, checked, parameters, where, extra_packages)
    if policy is not None and checked.get("policy_kwargs") is not None:
        accepted = constructor_parameters(policy)
        policy_kwargs = check_arguments(
            checked["policy_kwargs"], accepted, f"{where}: policy_kwargs"
        )
        checked["policy_kwargs"] = _build(policy_kwargs, accepted, where, extra_packages)
    if isinstance(checked.get("policy"), DottedName):
        checked["policy"] = policy
    built = _build(checked, parameters, where, extra_packages)
    return built if _is_hand_written(algorithm) else _as_library_schedules(built)


def _is_hand_written(algorithm: type[BaseAlgorithm]) -> bool:
    from agents.common.model_files import JsonAlgorithm

    return issubclass(algorithm, JsonAlgorithm)


def _as_library_schedules(kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Schedules of classes that a library agent's zip finds wherever that agent is installed."""
    from agents.common.schedules import ExponentialSchedule, library_schedule

    return {
        name: library_schedule(value) if isinstance(value, ExponentialSchedule) else value
        for name, value in kwargs.items()
    }


def needs_policy(algorithm: type[BaseAlgorithm], kwargs: Mapping[str, Any]) -> bool:
    """Whether the constructor wants a policy that the arguments do not say."""
    policy = algorithm_parameters(algorithm).get("policy")
    return policy is not None and policy.default is policy.empty and "policy" not in kwargs


def default_policy(algorithm: type[BaseAlgorithm], is_dict: bool) -> str:
    """The policy of an agent for which none is said.

    Args:
        algorithm: the agent's class.
        is_dict: whether it observes a dictionary.
    """
    prefix = "MultiInput" if is_dict else "Mlp"
    known = algorithm.policy_aliases
    fitting = (name for name in known if name.startswith(prefix))
    return next(fitting, next(iter(known), f"{prefix}Policy"))


def _policy_class(
    algorithm: type[BaseAlgorithm],
    kwargs: Mapping[str, Any],
    parameters: Mapping[str, inspect.Parameter],
    where: str,
    extra_packages: Sequence[str],
) -> type[BasePolicy] | None:
    """The class of the policy; None where only the agent's constructor knows it."""
    from stable_baselines3.common.policies import BasePolicy

    if needs_policy(algorithm, kwargs):
        raise UserError(f"{where}: policy is missing: {', '.join(algorithm.policy_aliases)}")
    default = parameters["policy"].default if "policy" in parameters else None
    policy = kwargs.get("policy", default)
    if isinstance(policy, DottedName):
        return find_class(policy.name, (BasePolicy,), f"{where}: policy", extra_packages)
    known = algorithm.policy_aliases
    if isinstance(policy, str) and known and policy not in known and "policy" in kwargs:
        raise unknown(f"{where}: unknown policy", policy, known)
    return known.get(policy) if isinstance(policy, str) else None


def _build(
    kwargs: Mapping[str, Any],
    parameters: Mapping[str, inspect.Parameter],
    where: str,
    extra_packages: Sequence[str],
) -> dict[str, Any]:
    """Build each argument, and hold classes against ``type[...]`` in the annotations."""
    built = {}
    for name, value in kwargs.items():
        built[name] = build_value(value, extra_packages, f"{where}: {name}")
        annotation = parameters[name].annotation if name in parameters else None
        bases = tuple(
            get_args(option)[0]
            for option in (annotation, *get_args(annotation))
            if get_origin(option) is type
        )
        if isinstance(value, DottedName) and bases and not issubclass(built[name], bases):
            wanted = " or ".join(base.__name__ for base in bases)
            raise UserError(f"{where}: {name}: {value} is no {wanted}")
    return built
