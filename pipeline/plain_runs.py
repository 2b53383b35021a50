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

# Agents whose random numbers are all their own, or drawn after they have been seeded.
FAMILIES = frozenset({"tabular", "linear"})
# Those of the library, once they train on compiled code: weights are drawn after that too. In the
# library's own loop they take too long to gain anything, but for what `auto` leaves there.
NETWORKS = frozenset({"dqn", "double_dqn", "deep_qlearning", "ppo", "a2c"})

HOMES = ("envs.", "gymnasium.envs.")
# Around the environments of a training: they hold nothing but numbers.
WRAPPERS = frozenset(
    {
        "envs.wrappers.ScaleReward",
        "envs.wrappers.TerminationReward",
        "gymnasium.wrappers.ClipReward",
    }
)

# What such a run may ask for besides: nothing that names code.
_SETTINGS = (
    "algorithm",
    "n_timesteps",
    "n_episodes",
    "n_envs",
    "env_kwargs",
    "train_env_kwargs",
    "eval_env_kwargs",
    "train_env_wrapper",
)


def is_plain(spec: TrainSpec) -> bool:
    """Whether a run is such a one."""
    if not _is_known_agent(spec) or not _is_known_wrapping(spec):
        return False
    if spec.gym_packages or spec.user_modules or spec.tensorboard_log or spec.trained_agent:
        return False
    special, untouched = spec.hyperparams, Hyperparams()
    rest = replace(special, **{name: getattr(untouched, name) for name in _SETTINGS})
    return spec.vec_env == "dummy" and rest == untouched and is_known_environment(spec.env_id)


def _is_known_agent(spec: TrainSpec) -> bool:
    if spec.algo in NETWORKS:
        default = ALGORITHMS[spec.algo].engines[0]
        return bool(spec.hyperparams.algorithm.get("engine", default) != "library")
    return spec.algo in ALGORITHMS and ALGORITHMS[spec.algo].family in FAMILIES


def _is_known_wrapping(spec: TrainSpec) -> bool:
    return {wrapper.name for wrapper in spec.hyperparams.train_env_wrapper} <= WRAPPERS


def is_known_environment(env_id: str) -> bool:
    """Whether an environment is one of Gymnasium's or of this project's, as it was registered."""
    registered = gym.registry.get(env_id)
    entry = None if registered is None else registered.entry_point
    wrapped = registered is not None and registered.additional_wrappers
    return isinstance(entry, str) and entry.startswith(HOMES) and not wrapped
