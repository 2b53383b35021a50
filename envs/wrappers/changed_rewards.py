"""Other rewards than the environment's own, for training."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs

from envs.argument_checks import check_flag, check_number


class ScaleReward(gym.RewardWrapper[Any, Any], RecordConstructorArgs):
    """Multiplies every reward.

    Args:
        env: any environment.
        scale: the factor.

    Raises:
        ValueError: if the factor is zero or not a finite number.
    """

    def __init__(self, env: gym.Env[Any, Any], scale: float) -> None:
        RecordConstructorArgs.__init__(self, scale=scale)
        gym.RewardWrapper.__init__(self, env)
        self.scale = check_number("scale", scale)
        if self.scale == 0:
            raise ValueError("scale must not be 0: every reward would be the same")

    def reward(self, reward: SupportsFloat) -> float:
        """The scaled reward."""
        return float(reward) * self.scale


class TerminationReward(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Puts a reward in place of the last one of an episode.

    Args:
        env: any environment. What lies outside this wrapper, such as a further time limit, it does
            not see.
        reward: the reward of the step that terminates the episode.
        on_truncation: give it also where time runs out.

    Raises:
        ValueError: if the reward is not a finite number.
    """

    def __init__(self, env: gym.Env[Any, Any], reward: float, on_truncation: bool = False) -> None:
        RecordConstructorArgs.__init__(self, reward=reward, on_truncation=on_truncation)
        gym.Wrapper.__init__(self, env)
        self.last_reward = check_number("reward", reward)
        self.on_truncation = check_flag("on_truncation", on_truncation)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if terminated or (truncated and self.on_truncation):
            reward = self.last_reward
        return obs, reward, terminated, truncated, info
