"""The values of ``auto``: settings that follow from the environment's size and rewards.

- ``gamma: auto`` is 1 - 1/(2 x time limit of evaluations): a reward one time limit ahead has the
  weight 0.6.
- ``n_timesteps: auto_K`` is K steps for each pair of state and action, for at least 100 pairs;
  ``auto`` is ``auto_2500``.
- ``learning_rate: auto`` falls from 0.3 to 10 x pairs / steps, within 0.003 and 0.05.
- ``initial_q: auto`` and ``value_bound: auto`` are the highest reward that ends an episode.
- In ``train_env_wrapper``, ``scale: auto`` is 1 / the largest absolute reward; ``min_reward: auto``
  is the lowest reward, but at least -1/10 of a positive highest one.
"""

from __future__ import annotations

import re
from contextlib import closing
from typing import Any

import numpy as np
from gymnasium import spaces

from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.spec import TrainSpec, validated

STEPS_PER_PAIR, FEWEST_PAIRS = 2500, 100  # training steps per state and action
VISITS_AVERAGED = 10  # a step size of 1 / n averages over about the last n visits
FIRST_STEP_SIZE, LAST_STEP_SIZES = 0.3, (0.003, 0.05)
OF_TABLES = ("gamma", "learning_rate", "initial_q", "value_bound")
_STEPS = re.compile(r"auto(?:_([1-9]\d{0,8}))?")


def resolved(fields: dict[str, Any]) -> TrainSpec:
    """The spec with these fields, and numbers in place of ``auto``; ``origins`` tells how.

    Raises:
        UserError: where an automatic value does not exist.
    """
    algorithm, steps = dict(fields["algorithm"]), fields.get("n_timesteps")
    asked = [key for key in OF_TABLES if algorithm.get(key) == "auto"]
    is_auto = isinstance(steps, str) and steps.startswith("auto")
    if is_auto and not _STEPS.fullmatch(str(steps)):
        raise UserError(
            f"n_timesteps: {steps!r} is not auto, or auto_1000 with the steps for each pair of "
            "state and action"
        )
    plain = {key: value for key, value in algorithm.items() if key not in asked}
    spec = validated({**fields, "algorithm": plain, **({"n_timesteps": None} if is_auto else {})})
    origins = dict(spec.origins)
    spec = _with_rewards(spec, origins)
    if asked or is_auto:
        spec = _with_numbers(spec, asked, str(steps) if is_auto else "", origins)
    if not (spec.n_timesteps or spec.n_episodes):
        raise UserError("the training has no budget: give -n STEPS or --n-episodes N")
    return spec.changed(origins=origins)


def _with_numbers(
    spec: TrainSpec, asked: list[str], steps: str, origins: dict[str, str]
) -> TrainSpec:
    """Settings of tables, from the evaluation environment."""
    from rl_yardstick.envs.known_models import time_limit, transition_model
    from rl_yardstick.pipeline.environments import check_fit, make_single_env

    check_fit(spec)
    where = f"{spec.algo} on {spec.env_id}"
    n_timesteps, algorithm = spec.n_timesteps, dict(spec.algorithm)
    with closing(make_single_env(spec)) as env:
        states, actions = _pairs(env, where)
        if steps:
            per_pair, counted = (
                int(steps[5:] or STEPS_PER_PAIR),
                max(states * actions, FEWEST_PAIRS),
            )
            least = f", counted as {counted} pairs" if counted > states * actions else ""
            n_timesteps = per_pair * counted
            origins["n_timesteps"] = (
                f"auto: {per_pair:,} for each pair of {states:,} states and {actions:,} "
                f"actions{least}"
            )
        for key in asked:
            if key == "gamma":
                if (limit := time_limit(env)) is None:
                    raise UserError(f"{where}: gamma: auto needs an environment with a time limit")
                algorithm[key] = round(1 - 1 / (2 * limit), 7)
                origins[key] = f"auto: 1 - 1/(2 x time limit of {limit:,})"
            elif key == "learning_rate":
                low, high = LAST_STEP_SIZES
                last, origins[key] = high, "auto"
                if n_timesteps is not None:
                    last = min(max(VISITS_AVERAGED * states * actions / n_timesteps, low), high)
                    origins[key] += (
                        f": ends at {VISITS_AVERAGED} x states x actions / steps, within {low} and "
                        f"{high}"
                    )
                algorithm[key] = f"exp_{FIRST_STEP_SIZE:g}_{last:.2g}"
            else:
                model = transition_model(env)
                if model is None or not (ends := model.terminated & (model.prob > 0)).any():
                    needed = "a known model whose episodes can end"
                    raise UserError(f"{where}: {key}: auto needs {needed}")
                algorithm[key] = float(model.reward[ends].max())
                origins[key] = "auto: the highest reward that ends an episode"
    return spec.changed(n_timesteps=n_timesteps, algorithm=algorithm)


def _pairs(env: Any, where: str) -> tuple[int, int]:
    """The numbers of states and of actions."""
    states, actions = env.observation_space, env.action_space
    if not (isinstance(states, spaces.Discrete) and isinstance(actions, spaces.Discrete)):
        raise UserError(f"{where}: auto needs Discrete observations and actions")
    return int(states.n), int(actions.n)


def _with_rewards(spec: TrainSpec, origins: dict[str, str]) -> TrainSpec:
    """The arguments of training wrappers, from the rewards that reach them."""
    from rl_yardstick.envs.known_models import transition_model
    from rl_yardstick.pipeline.environments import make_single_env

    wrappers, told = list(spec.train_env_wrapper), []
    for place, one in enumerate(wrappers):
        for key in [key for key in ("scale", "min_reward") if one.kwargs.get(key) == "auto"]:
            inner = spec.changed(train_env_wrapper=wrappers[:place])
            with closing(make_single_env(inner, training=True)) as env:
                model = transition_model(env)
            if model is None:
                raise UserError(f"{spec.env_id}: {key}: auto needs an environment with a model")
            rewards = model.reward[model.prob > 0]
            largest, high, low = float(np.abs(rewards).max()), rewards.max(), float(rewards.min())
            if key == "scale":
                value, how = 1 / largest if largest else 1.0, f"1 / the largest reward, {largest:g}"
            elif high <= 0 or -high / 10 < low:
                value, how = low, f"{low:g}, the lowest reward"
            else:  # large costs would teach a network to stand still
                value = -float(high) / 10
                how = f"{value:g}, a tenth of the highest reward below zero"
            one = one.model_copy(update={"kwargs": {**one.kwargs, key: value}})  # noqa: PLW2901
            wrappers[place] = one
            told.append(f"{key} auto: {how}")
    if told:
        origins["train_env_wrapper"] = "; ".join(told)
    return spec.changed(train_env_wrapper=wrappers)
