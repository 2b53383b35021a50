"""Checks that an agent fits an environment, and computes the values of ``auto``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, get_args

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.agents import ALGORITHMS, fitting_algorithms, load_algorithm
from rl_yardstick.agents.registry import is_bandit
from rl_yardstick.envs.known_models import time_limit, transition_model
from rl_yardstick.envs.wrappers import has_masks
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.errors import UserError, shown, unknown
from rl_yardstick.pipeline.settings.hyperparams import component_specs, read_hyperparams, split
from rl_yardstick.pipeline.settings.values import algorithm_parameters
from rl_yardstick.pipeline.train_spec import TrainSpec


def check_algorithm(algo: str) -> None:
    """Check that the agent exists and that its requirements are installed."""
    entry = ALGORITHMS.get(algo)
    if entry is None and algo.lower() == "her":
        raise UserError(
            "hindsight experience replay is no agent but a replay buffer, for environments with "
            "goals: --algo sac -params replay_buffer_class:HerReplayBuffer policy:MultiInputPolicy"
        )
    if entry is None:
        raise unknown("unknown agent", algo, ALGORITHMS)
    if not entry.is_installed:
        raise UserError(
            f"{algo} needs {entry.package}, which is not installed: {entry.install_command}"
        )


def with_engine(algo: str, settings: Mapping[str, Any], word: str | None) -> dict[str, Any]:
    """The typed settings of an agent, with the value of ``--engine``, if given."""
    if word is None or algo not in ALGORITHMS:
        return dict(settings)
    said = settings.get("engine", word)
    if said != word:
        raise UserError(f"--engine {word} and -params engine:{said} disagree: give one of them")
    entry = ALGORITHMS[algo]
    engines: Sequence[str] = entry.engines
    if not engines and not entry.entry_point.startswith(
        "rl_yardstick.agents."
    ):  # the user's own agent
        parameter = algorithm_parameters(load_algorithm(algo)).get("engine")
        engines = () if parameter is None else get_args(parameter.annotation)
    if len(engines) > 1 and word in engines:
        return {**settings, "engine": word}
    if len(engines) < 2 and word in ("auto", *engines):
        return dict(settings)
    has = (
        f"the engines {', '.join(engines)}" if len(engines) > 1 else "one engine, which auto means"
    )
    raise UserError(f"--engine {word}: {algo} has {has}")


def check_fit(spec: TrainSpec) -> None:
    """Check that the agent can work with the wrapped environment."""
    with closing(make_single_env(spec, training=True)) as env:
        misfit = ALGORITHMS[spec.algo].env_misfit(env)
        fitting = fitting_algorithms(
            env.observation_space, env.action_space, is_bandit(env), has_masks(env)
        )
    if misfit:
        others = f"fitting agents: {', '.join(fitting)}" if fitting else "no agent here fits"
        raise UserError(f"{spec.algo} does not fit {spec.env_id}: {misfit}; {others}")


# --- the values of ``auto`` -----------------------------------------------------------------------
#
# The best values depend on the environment; an entry with ``auto`` suits a family of environments.
# Agents, engines and model files get only computed values; `TrainSpec.origins` has their formulas.

AUTO = "auto"
# For a plain ``auto``: training steps per pair of state and action, and the least number of pairs,
# because exploring a small map takes time too.
STEPS_PER_PAIR = 2500
FEWEST_PAIRS = 100
# Step sizes: 1 / n averages over about the last n visits; the first one; bounds of the last one.
VISITS_AVERAGED = 10
FIRST_STEP_SIZE = 0.3
LAST_STEP_SIZES = (0.003, 0.05)
_WORD = re.compile(r"auto(?:_([1-9]\d{0,8}))?")


class Found(NamedTuple):
    """The computed value of ``auto``."""

    value: Any  # the setting
    how: str  # the formula with its numbers, for readers


@dataclass(frozen=True)
class _Asked:
    """A setting with the value ``auto``."""

    env: gym.Env[Any, Any]  # the evaluation environment
    amount: str  # the number in ``auto_1000``; empty for a plain ``auto``
    n_timesteps: int | None  # training steps, if already known
    where: str  # begins every error message

    def pairs(self) -> tuple[int, int]:
        """The numbers of states and of actions."""
        sizes = self.env.observation_space, self.env.action_space
        if not all(isinstance(space, spaces.Discrete) for space in sizes):
            raise UserError(f"{self.where}: auto needs Discrete observations and actions")
        states, actions = (int(space.n) for space in sizes if isinstance(space, spaces.Discrete))
        return states, actions


def _budget(asked: _Asked) -> Found:
    states, actions = asked.pairs()
    steps, counted = int(asked.amount or STEPS_PER_PAIR), max(states * actions, FEWEST_PAIRS)
    least = f", counted as {counted} pairs" if counted > states * actions else ""
    how = f"auto: {steps:,} for each pair of {states:,} states and {actions:,} actions{least}"
    return Found(steps * counted, how)


def _discount(asked: _Asked) -> Found:
    """Compute gamma: a reward one time limit ahead has the weight 0.6."""
    limit = time_limit(asked.env)
    if limit is None:
        raise UserError(f"{asked.where}: auto needs an environment with a time limit")
    return Found(round(1 - 1 / (2 * limit), 7), f"auto: 1 - 1/(2 x time limit of {limit:,})")


def _step_size(asked: _Asked) -> Found:
    """Compute the schedule of the step size; in a short training, it stays large."""
    states, actions = asked.pairs()
    low, high = LAST_STEP_SIZES
    if asked.n_timesteps is None:  # the budget is in episodes
        return Found(f"exp_{FIRST_STEP_SIZE:g}_{high:g}", "auto")
    last = min(max(VISITS_AVERAGED * states * actions / asked.n_timesteps, low), high)
    how = f"auto: ends at {VISITS_AVERAGED} x states x actions / steps, within {low} and {high}"
    return Found(f"exp_{FIRST_STEP_SIZE:g}_{last:.2g}", how)


def _highest_value(asked: _Asked) -> Found:
    """The highest return if only the end of an episode is rewarded, as on FrozenLake."""
    model = transition_model(asked.env)
    if model is None:
        raise UserError(f"{asked.where}: auto needs an environment whose model is known")
    # Unreachable states count too: excluding them would take longer than all other work here.
    ends = model.terminated & (model.prob > 0)
    if not ends.any():
        raise UserError(f"{asked.where}: auto needs an environment whose episodes can end")
    return Found(float(model.reward[ends].max()), "auto: the highest reward that ends an episode")


# In this order, because the step size depends on the number of steps.
_RULES: Mapping[str, Callable[[_Asked], Found]] = {
    "n_timesteps": _budget,
    "gamma": _discount,
    "learning_rate": _step_size,
    "initial_q": _highest_value,
    "value_bound": _highest_value,
}


def _scale(rewards: NDArray[np.floating[Any]]) -> Found:
    largest = float(np.abs(rewards).max())
    return Found(1 / largest if largest else 1.0, f"1 / the largest reward, {largest:g}")


def _lowest_reward(rewards: NDArray[np.floating[Any]]) -> Found:
    """Compute the lower bound of rewards: large costs would teach a network to stand still."""
    highest, lowest = float(rewards.max()), float(rewards.min())
    if highest <= 0 or -highest / 10 < lowest:
        return Found(lowest, f"{lowest:g}, the lowest reward")
    return Found(-highest / 10, f"{-highest / 10:g}, a tenth of the highest reward below zero")


_REWARD_RULES: Mapping[str, Callable[[NDArray[np.floating[Any]]], Found]] = {
    "scale": _scale,
    "min_reward": _lowest_reward,
}


def _wrappers(raw: Mapping[str, Any], spec: TrainSpec, where: str) -> dict[str, Found]:
    """The training wrappers with numbers for ``auto``, inner ones first; empty without ``auto``."""
    wrappers = list(component_specs(raw.get("train_env_wrapper"), f"{where}: train_env_wrapper"))
    told = []
    for place, one in enumerate(wrappers):
        for key in [key for key in _REWARD_RULES if one.kwargs.get(key) == AUTO]:
            inner = replace(spec.hyperparams, train_env_wrapper=tuple(wrappers[:place]))
            with closing(make_single_env(replace(spec, hyperparams=inner), training=True)) as env:
                model = transition_model(env)
            if model is None:
                raise UserError(f"{where}: {key}: auto needs an environment whose model is known")
            found = _REWARD_RULES[key](model.reward[model.prob > 0])
            wrappers[place] = replace(one, kwargs={**one.kwargs, key: found.value})
            told.append(f"{key} auto: {found.how}")
    if not told:
        return {}
    listed = [{one.name: one.kwargs} for one in wrappers]
    spelt = listed if len(listed) > 1 else listed[0]
    return {"train_env_wrapper": Found(spelt, "; ".join(told))}


def without_auto(entry: Mapping[str, Any]) -> dict[str, Any]:
    """The entry without settings that are ``auto``."""
    return {key: value for key, value in entry.items() if _word(key, value) is None}


def training_follows(
    entry: Mapping[str, Any], typed: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, str] | None]:
    """Apply typed env_kwargs to training too; returns the entry, and notes for `origins`."""
    variant, own = entry.get("train_env_kwargs"), typed.get("train_env_kwargs")
    asked = typed.get("env_kwargs")
    if not (isinstance(variant, dict) and isinstance(asked, dict)):
        return dict(entry), None
    own = own if isinstance(own, dict) else {}
    gone = {key: variant[key] for key in asked if key in variant and key not in own}
    told = ", ".join(f"{key}: {value}" for key, value in gone.items() if value != asked[key])
    kept = {key: value for key, value in variant.items() if key not in gone}
    how = f"without {told}, because typed env_kwargs apply to training too"
    return {**entry, "train_env_kwargs": kept}, {"train_env_kwargs": how} if told else None


def resolved_spec(
    raw: Mapping[str, Any],
    where: str = "hyperparameters",
    origins: Mapping[str, str] | None = None,
    **fields: Any,
) -> TrainSpec:
    """Make a spec with a computed value in place of each ``auto``.

    - ``gamma: auto`` is 1 - 1/(2 x time limit of evaluations).
    - ``n_timesteps: auto_K`` is K steps for each pair of state and action, for at least 100 pairs;
      ``auto`` is ``auto_2500``.
    - ``learning_rate: auto`` falls from 0.3 to 10 x pairs / steps, within 0.003 and 0.05.
    - ``initial_q: auto`` and ``value_bound: auto`` are the highest reward that ends an episode.
    - In ``train_env_wrapper``, ``scale: auto`` is 1 / the largest absolute reward of training;
      ``min_reward: auto`` is the lowest reward, but at least -1/10 of a positive highest reward.

    ``where`` begins every error message; ``fields`` are the other fields of `TrainSpec`.
    """
    rest = without_auto(raw)
    spec = TrainSpec(hyperparams=split(rest, where), saved_hyperparams=rest, **fields)
    found = _wrappers(raw, spec, where)
    if len(rest) < len(raw):
        known = {**rest, **{key: one.value for key, one in found.items()}}
        spec = replace(spec, hyperparams=split(known, where))
        check_fit(spec)
        n_timesteps = spec.hyperparams.n_timesteps
        with closing(make_single_env(spec)) as env:
            for key, rule in _RULES.items():
                match = _word(key, raw.get(key))
                if match is not None:
                    found[key] = rule(_Asked(env, match[1] or "", n_timesteps, f"{where}: {key}"))
                    n_timesteps = found[key].value if key == "n_timesteps" else n_timesteps
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


# Settings of the task: a run's shipped settings are those for its own task.
_TASK = ("env_kwargs", "eval_env_kwargs", "env_wrapper")


def shipped_settings(spec: TrainSpec) -> dict[str, Any]:
    """The shipped settings of a run's agent on its task; the class's defaults without an entry."""
    saved, entry = spec.saved_hyperparams, dict[str, Any]()
    task = {key: saved[key] for key in _TASK if key in saved}
    with suppress(UserError):
        entry |= read_hyperparams(spec.algo, spec.env_id, env_kwargs=task.get("env_kwargs"))
    raw, _ = training_follows({k: v for k, v in entry.items() if k not in _TASK}, task)
    budgets = ("n_timesteps", "n_episodes")
    if not any(raw.get(key) for key in budgets):
        raw |= {key: saved[key] for key in budgets if key in saved}
    raw = {**raw, **task}
    named = {key: getattr(spec, key) for key in ("algo", "env_id", "gym_packages", "user_modules")}
    with suppress(UserError):  # if an automatic value does not exist here
        return resolved_spec(raw, seed=0, **named).saved_hyperparams
    return without_auto(raw)


def _word(key: str, value: Any) -> re.Match[str] | None:
    if key not in _RULES or not isinstance(value, str) or not value.startswith("auto"):
        return None
    match = _WORD.fullmatch(value)
    if match is None or (match[1] and key != "n_timesteps"):
        form = "auto, or auto_1000 with the steps for each pair of state and action"
        raise UserError(f"{key}: {shown(value)} is not {form if key == 'n_timesteps' else 'auto'}")
    return match
