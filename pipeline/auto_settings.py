"""Settings of an entry that are worked out from the environment: what the word ``auto`` stands for.

A number that suits one map does not suit the next: an entry that says ``auto`` holds for a family
of environments. The word is replaced by a number before anything else is made of the entry, so that
agents, engines and model files know numbers alone. `TrainSpec.auto` keeps how each was found.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from envs.known_models import time_limit, transition_model
from pipeline.agent_checks import check_fit
from pipeline.environments import make_single_env
from pipeline.errors import UserError, shown
from pipeline.settings.hyperparams import component_specs, split
from pipeline.train_spec import TrainSpec

AUTO = "auto"
# Steps of training for each pair of an observation and an action, where only ``auto`` is said, and
# the fewest pairs that are counted: a small map takes its time to be explored too.
STEPS_PER_PAIR = 1000
FEWEST_PAIRS = 100
_WORD = re.compile(r"auto(?:_([1-9]\d{0,8}))?")

Env = gym.Env[Any, Any]


@dataclass(frozen=True)
class Found:
    """A number in the place of the word.

    Attributes:
        value: the setting.
        how: the formula with its numbers, for people.
    """

    value: Any
    how: str


def _discount(env: Env, amount: str | None, where: str) -> Found:
    """With 1 - 1/(2 x time limit) what lies a whole episode ahead still counts for 0.6."""
    limit = time_limit(env)
    if limit is None:
        raise UserError(f"{where}: auto needs a time limit, which the environment does not have")
    return Found(1 - 1 / (2 * limit), f"auto: 1 - 1/(2 x time limit of {limit:,})")


def _budget(env: Env, amount: str | None, where: str) -> Found:
    sizes = env.observation_space, env.action_space
    if not all(isinstance(space, spaces.Discrete) for space in sizes):
        raise UserError(f"{where}: auto needs Discrete observations and actions: give a number")
    n_states, n_actions = (int(space.n) for space in sizes if isinstance(space, spaces.Discrete))
    steps, pairs = int(amount or STEPS_PER_PAIR), n_states * n_actions
    counted = f"{n_states:,} states x {n_actions:,} actions"
    if pairs < FEWEST_PAIRS:
        counted = f"{FEWEST_PAIRS}, the fewest that are counted, for {counted}"
    return Found(steps * max(pairs, FEWEST_PAIRS), f"auto: {steps:,} x {counted}")


def _highest_value(env: Env, amount: str | None, where: str) -> Found:
    """No return is higher where only the end of an episode is rewarded, as on FrozenLake."""
    model = transition_model(env)
    if model is None:
        raise UserError(f"{where}: auto needs an environment whose model is known: give a number")
    ends = model.terminated & (model.prob > 0) & model.reachable[:, None, None]
    if not ends.any():
        raise UserError(f"{where}: auto needs an environment whose episodes can end")
    return Found(float(model.reward[ends].max()), "auto: the highest reward that ends an episode")


_RULES: Mapping[str, Callable[[Env, str | None, str], Found]] = {
    "gamma": _discount,
    "n_timesteps": _budget,
    "initial_q": _highest_value,
    "value_bound": _highest_value,
}


def _scale(raw: Mapping[str, Any], spec: TrainSpec, where: str) -> dict[str, Found]:
    """The wrappers of training with a number in place of ``scale: auto``; empty without the word.

    What lies inside of the wrapper counts: it scales the rewards that it is handed.
    """
    wrappers = component_specs(raw.get("train_env_wrapper"), f"{where}: train_env_wrapper")
    place = next((i for i, one in enumerate(wrappers) if one.kwargs.get("scale") == AUTO), None)
    if place is None:
        return {}
    inner = replace(spec.hyperparams, train_env_wrapper=wrappers[:place])
    env = make_single_env(replace(spec, hyperparams=inner), training=True)
    model = transition_model(env)
    env.close()
    if model is None:
        raise UserError(f"{where}: scale: auto needs an environment whose model is known")
    largest = float(np.abs(model.reward[model.reachable][model.prob[model.reachable] > 0]).max())
    scaled = replace(wrappers[place], kwargs={"scale": 1 / largest if largest else 1.0})
    listed = [{one.name: one.kwargs} for one in (*wrappers[:place], scaled, *wrappers[place + 1 :])]
    return {"train_env_wrapper": Found(listed, f"scale auto: 1 / the largest reward, {largest:g}")}


def without_auto(entry: Mapping[str, Any]) -> dict[str, Any]:
    """The entry without the settings that say ``auto``."""
    return {key: value for key, value in entry.items() if _word(key, value) is None}


def training_follows(
    entry: Mapping[str, Any], typed: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, str] | None]:
    """Let arguments of the environment that somebody asked for hold in training too.

    An entry may train on a variant, such as cheaper shelves. What was asked for wins.

    Args:
        entry: with ``typed`` in it.
        typed: what was asked for beside the file's entry.

    Returns:
        The entry, and for `TrainSpec.origins` what gave way; None for nothing.
    """
    variant, own = entry.get("train_env_kwargs"), typed.get("train_env_kwargs")
    asked = typed.get("env_kwargs")
    if not (isinstance(variant, dict) and isinstance(asked, dict)):
        return dict(entry), None
    own = own if isinstance(own, dict) else {}
    gone = {key: variant[key] for key in asked if key in variant and key not in own}
    told = ", ".join(f"{key}: {value}" for key, value in gone.items() if value != asked[key])
    kept = {key: value for key, value in variant.items() if key not in gone}
    how = f"without {told}, since what is asked for of the environment holds in training too"
    return {**entry, "train_env_kwargs": kept}, {"train_env_kwargs": how} if told else None


def resolved_spec(
    raw: Mapping[str, Any],
    where: str = "hyperparameters",
    origins: Mapping[str, str] | None = None,
    **fields: Any,
) -> TrainSpec:
    """A spec with a number in place of each ``auto``.

    ``gamma: auto`` is 1 - 1/(2 x time limit) of the environment that the agent is judged on.
    ``n_timesteps: auto_K`` is K steps for each pair of state and action, of which 100 are counted
    at least; ``auto`` is ``auto_1000``. ``initial_q: auto`` and ``value_bound: auto`` are the
    highest reward that ends an episode. ``scale: auto`` of a wrapper in ``train_env_wrapper`` is 1
    by the largest reward of training, its sign aside. In other settings the word is what it was,
    such as ``engine: auto``.

    Args:
        raw: an entry of hyperparameters.
        where: begins every error message.
        origins: what is known already for `TrainSpec.origins`.
        fields: all others of `TrainSpec`.

    Raises:
        UserError: if a setting cannot be read, or the environment does not tell what it would be.
    """
    rest = without_auto(raw)
    spec = TrainSpec(hyperparams=split(rest, where), saved_hyperparams=rest, **fields)
    found = _scale(raw, spec, where)
    if len(rest) < len(raw):
        check_fit(spec)
        env = make_single_env(spec)
        for key, value in raw.items():
            match = _word(key, value)
            if match is not None and key in _RULES:
                found[key] = _RULES[key](env, match[1], f"{where}: {key}")
        env.close()
    if not found:
        return replace(spec, origins=dict(origins) if origins else None)
    numbers = {**raw, **{key: one.value for key, one in found.items()}}
    told = {key: one.how for key, one in found.items()}
    return replace(
        spec,
        hyperparams=split(numbers, where),
        saved_hyperparams=numbers,
        origins={**(origins or {}), **told},
    )


def _word(key: str, value: Any) -> re.Match[str] | None:
    if key not in _RULES or not isinstance(value, str) or not value.startswith("auto"):
        return None
    match = _WORD.fullmatch(value)
    if match is None or (match[1] and key != "n_timesteps"):
        form = "auto, or auto_1000 with the steps for each pair of state and action"
        raise UserError(f"{key}: {shown(value)} is not {form if key == 'n_timesteps' else 'auto'}")
    return match
