"""Runs of which all that takes part comes from this project or from Gymnasium.

What they leave depends on their spec alone, and they leave nothing behind in their process: any
number of them can be done there one after the other.
"""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym

from agents import ALGORITHMS
from pipeline.settings.hyperparams import Hyperparams
from pipeline.train_spec import TrainSpec

# Agents whose random numbers are all their own.
FAMILIES = frozenset({"tabular"})
HOMES = ("envs.", "gymnasium.envs.")

# What such a run may ask for: nothing that names code, and nothing that wraps environments.
_SETTINGS = (
    "algorithm",
    "n_timesteps",
    "n_episodes",
    "n_envs",
    "env_kwargs",
    "train_env_kwargs",
    "eval_env_kwargs",
)


def is_plain(spec: TrainSpec) -> bool:
    """Whether a run is such a one."""
    if spec.algo not in ALGORITHMS or ALGORITHMS[spec.algo].family not in FAMILIES:
        return False
    if spec.gym_packages or spec.user_modules or spec.tensorboard_log or spec.trained_agent:
        return False
    special, untouched = spec.hyperparams, Hyperparams()
    rest = replace(special, **{name: getattr(untouched, name) for name in _SETTINGS})
    return spec.vec_env == "dummy" and rest == untouched and is_known_environment(spec.env_id)


def is_known_environment(env_id: str) -> bool:
    """Whether an environment is one of Gymnasium's or of this project's, as it was registered."""
    registered = gym.registry.get(env_id)
    entry = None if registered is None else registered.entry_point
    wrapped = registered is not None and registered.additional_wrappers
    return isinstance(entry, str) and entry.startswith(HOMES) and not wrapped
