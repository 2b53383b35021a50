"""Predicting the values of random walks, which three figures have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from _figures import MOST_STEPS, ValueErrors, agent_on
from stable_baselines3.common.callbacks import CallbackList, StopTrainingOnMaxEpisodes

from mdp.array_types import Floats

WALK = "envs:RandomWalk-v0"


def true_values(env_kwargs: dict[str, Any]) -> Floats:
    """The probability of ending on the right, turned into rewards, shape (n_states + 2,)."""
    walk: Any = gym.make(WALK, **env_kwargs).unwrapped
    right = np.arange(walk.n_states + 2) / (walk.n_states + 1)
    return np.asarray(walk.left_reward + (walk.right_reward - walk.left_reward) * right)


def errors_of_runs(
    algo: str, seeds: Sequence[int], n_episodes: int, env_kwargs: dict[str, Any], **settings: Any
) -> Floats:
    """Root mean square errors over the states, after each episode of each run.

    There is one action, so what a method learns of it is the state's value.

    Returns:
        Shape (len(seeds), n_episodes).
    """
    values = true_values(env_kwargs)
    counted = np.ones(len(values), dtype=bool)
    counted[[0, -1]] = False  # the ends
    agent = agent_on(WALK, algo, 0, env_kwargs=env_kwargs, **settings)
    start = {name: table.clone() for name, table in agent.policy.state_dict().items()}
    runs = []
    for seed in seeds:
        # The same agent begins anew, which takes a tenth of the time of making another.
        agent.policy.load_state_dict(start)
        agent.set_random_seed(seed)
        errors = ValueErrors(values, counted)
        stop = StopTrainingOnMaxEpisodes(n_episodes)
        agent.learn(MOST_STEPS, callback=CallbackList([errors, stop]), log_interval=None)
        runs.append(errors.errors[:n_episodes])
    return np.array(runs)
