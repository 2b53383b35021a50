"""The policies whose returns are the lower ends of `optimum_brackets`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from _double_pendulum import N_TORQUES, way_up
from _pushed_motion import MOTIONS, PushedMotion, best_action, interpolated_costs

from mdp.array_types import Floats

# A policy is handed what is observed, and how many steps of the episode are done.
Policy = Callable[[Any, int], Any]

# Nodes of positions and of speeds, and actions, when costs are planned and when one is chosen.
GRIDS = {
    "MountainCar-v0": (400, 300, 3, 3),
    "MountainCarContinuous-v0": (100, 100, 21, 81),
    "Pendulum-v1": (200, 201, 21, 81),
}


# Of Acrobot's search: a wider one finds ways that are shorter by a hundredth.
BEAM_WIDTH = 500


def policy_of(env_id: str) -> Policy:
    """The policy that the lower end is the return of."""
    if env_id in GRIDS:
        return planned(env_id)
    return {"CartPole-v1": balancing, "Acrobot-v1": searching}[env_id]()


def balancing() -> Policy:
    """CartPole: push to where a weighted sum of what is observed says that the pole falls."""
    weights = np.array([0.5, 1.0, 10.0, 2.0])
    return lambda obs, _: int(weights @ obs > 0)


def searching() -> Policy:
    """Acrobot: the torques of a search from the first state; from a later one where they end."""
    way: list[int] = []

    def policy(obs: Any, n_steps: int) -> int:
        if n_steps == 0 or not way:
            first, second = math.atan2(obs[1], obs[0]), math.atan2(obs[3], obs[2])
            state = np.array([first, second, obs[4], obs[5]], dtype=np.float64)
            way[:] = way_up(state, BEAM_WIDTH, 500)[::-1].tolist()
        return way.pop() if way else N_TORQUES // 2

    return policy


def planned(env_id: str) -> Policy:
    """Cars and pendulum: the best action by costs that were planned on a grid, step by step."""
    motion = MOTIONS[env_id]
    n_positions, n_speeds, n_planned, n_chosen = GRIDS[env_id]
    costs = interpolated_costs(motion, n_positions, n_speeds, _actions(motion, n_planned))
    actions = _actions(motion, n_chosen)

    def policy(obs: Any, n_steps: int) -> Any:
        position, speed = (float(obs[0]), float(obs[1])) if len(obs) == 2 else _turned(obs)
        left = motion.horizon - n_steps - 1
        action, _ = best_action(motion, actions, costs[left], position, speed)
        return np.array([action], np.float32) if motion.is_continuous else int(action) + 1

    return policy


def _actions(motion: PushedMotion, n: int) -> Floats:
    return np.linspace(motion.actions.min(), motion.actions.max(), n)


def _turned(obs: Any) -> tuple[float, float]:
    """The pendulum's angle and speed."""
    return math.atan2(obs[1], obs[0]), float(obs[2])


def returns_of(env_id: str, policy: Policy, n_episodes: int, seed: int) -> Floats:
    """Play a policy in Gymnasium's environment as it is.

    Returns:
        Undiscounted returns of episodes from starts that are drawn, shape (n_episodes,).
    """
    env = gym.make(env_id)
    env.reset(seed=seed)
    returns = np.zeros(n_episodes)
    for episode in range(n_episodes):
        obs, _ = env.reset()
        n_steps, is_over = 0, False
        while not is_over:
            obs, reward, terminated, truncated, _ = env.step(policy(obs, n_steps))
            returns[episode] += float(reward)
            n_steps += 1
            is_over = terminated or truncated
    env.close()
    return returns


def blind_policies(env_id: str, seed: int) -> dict[str, Policy]:
    """Uniformly random actions, and constant ones; of a continuous action nine."""
    space = gym.make(env_id).action_space
    space.seed(seed)
    if isinstance(space, gym.spaces.Discrete):
        constants: list[Any] = list(range(int(space.n)))
    else:
        assert isinstance(space, gym.spaces.Box)
        constants = list(np.linspace(space.low, space.high, 9))
    named = {f"always {np.round(a, 3)}": _always(a) for a in constants}
    return {"random": lambda obs, n_steps: space.sample(), **named}


def _always(action: Any) -> Policy:
    return lambda obs, n_steps: action
