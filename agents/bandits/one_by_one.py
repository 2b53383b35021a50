"""Independent runs of any agent on a bandit, one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor

from agents.bandits.batch import checked_pulls
from agents.bandits.batch_result import BatchResult
from agents.bandits.linear_bandits import LinearBanditAgent
from agents.bandits.pull_log import PullLog
from agents.bandits.table_bandit import TableBandit
from agents.registry import load_algorithm
from envs.wrappers import ActionMasks


def run_one_by_one(
    algorithm: str | type[Any],
    kwargs: Mapping[str, Any] | None,
    env_id: str,
    env_kwargs: Mapping[str, Any] | None,
    seeds: Iterable[int],
    pulls: int | None = None,
) -> BatchResult:
    """What `agents.bandits.batch.run_batch` does, step by step, for any agent that fits.

    Arguments as there; agents of Stable-Baselines3 want ``policy`` among theirs. Posteriors are not
    kept.
    """
    cls = load_algorithm(algorithm) if isinstance(algorithm, str) else algorithm
    numbers = list(seeds)
    runs = [_run(cls, kwargs or {}, env_id, env_kwargs or {}, seed, pulls) for seed in numbers]

    def stacked(name: str) -> Any:
        return np.stack([run[name] for run in runs]) if name in runs[0] else None

    return BatchResult(
        np.array(numbers, dtype=np.int64),
        stacked("arms"),
        stacked("rewards"),
        stacked("regrets"),
        stacked("contexts"),
        stacked("estimates"),
        stacked("coefficients"),
    )


def _run(
    cls: type[Any],
    kwargs: Mapping[str, Any],
    env_id: str,
    env_kwargs: Mapping[str, Any],
    seed: int,
    pulls: int | None,
) -> dict[str, Any]:
    """The arrays of one run, without their first axis."""
    made = gym.make(env_id, **env_kwargs)
    env = Monitor(ActionMasks(made) if kwargs.get("mask_actions") else made)
    log = PullLog()
    try:
        n_pulls = checked_pulls(env, pulls)
        agent = cls(env=env, seed=seed, **kwargs)
        agent.learn(n_pulls, callback=log)
        # Agents that collect whole rollouts go on beyond what was asked for.
        run = {name: array[0, :n_pulls] for name, array in log.arrays().items()}
    finally:
        env.close()
    if getattr(env.unwrapped, "n_contexts", 0) <= 1:
        run.pop("contexts", None)
    return {**run, **_knowledge(agent)}


def _knowledge(agent: Any) -> dict[str, Any]:
    """What a bandit agent thinks of the arms at the end."""
    if isinstance(agent, TableBandit):
        return {"estimates": agent.estimates(agent.policy.tables)}
    if isinstance(agent, LinearBanditAgent):
        discrete = isinstance(agent.observation_space, spaces.Discrete)
        coefficients = agent.policy.models.coefficients
        return {"coefficients": coefficients} | ({"estimates": coefficients.T} if discrete else {})
    return {}
