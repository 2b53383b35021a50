"""A search space held against the agent that it is for, before anything runs."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any

from pipeline.models.load import agent_class
from pipeline.settings.components import default_policy
from pipeline.settings.hyperparams import Hyperparams, check_algorithm_kwargs, split
from pipeline.settings.values import algorithm_parameters, constructor_parameters


def defaults_of(algo: str, keys: Iterable[str]) -> dict[str, Any]:
    """What settings are where none is said.

    Args:
        algo: an agent of the table.
        keys: names of settings, those inside ``policy_kwargs`` dotted. What has no default, or one
            that depends on other settings, is not in the result.
    """
    algorithm = agent_class(algo)
    policy = algorithm.policy_aliases.get(default_policy(algorithm, is_dict=False), object)
    known = {
        **{key.name: key.default for key in fields(Hyperparams) if "wrapper" not in key.name},
        **dict.fromkeys(("env_wrapper", "train_env_wrapper", "vec_env_wrapper", "callback")),
        "normalize": False,
        **_defaults(algorithm_parameters(algorithm), ""),
        **_defaults(constructor_parameters(policy), "policy_kwargs."),
    }
    return {key: known[key] for key in keys if key in known}


def _defaults(parameters: Mapping[str, inspect.Parameter], prefix: str) -> dict[str, Any]:
    return {
        prefix + name: f"nn.{p.default.__name__}" if isinstance(p.default, type) else p.default
        for name, p in parameters.items()
        if p.default is not p.empty
    }


def check_against_agent(algo: str, settings: Iterable[Mapping[str, Any]], where: str) -> None:
    """Make sure that an agent takes settings, by their names, types and bounds.

    Args:
        algo: an agent of the table.
        settings: entries of hyperparameters, without what the search does not change.
        where: begins every error message.

    Raises:
        UserError: naming the setting, and what it must be.
    """
    parameters = algorithm_parameters(agent_class(algo))
    for entry in settings:
        check_algorithm_kwargs(split(entry, where).algorithm, parameters, where)
