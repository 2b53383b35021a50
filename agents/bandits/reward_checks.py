"""Which rewards an agent can learn from."""

from __future__ import annotations

from typing import Protocol

from stable_baselines3.common.vec_env import VecEnv

ANY = "any"
UNIT = "between 0 and 1"
BINARY = "0 or 1"


class Choosy(Protocol):
    """An agent that says which rewards it can learn from."""

    @property
    def rewards_known(self) -> str:
        """One of `ANY`, `UNIT` and `BINARY`."""


# Environments whose rewards have normal noise on them.
UNBOUNDED_KINDS = ("gaussian", "linear")


def reward_misfit(agent: Choosy, reward: float) -> str:
    """Say why the agent cannot learn from ``reward``; empty where it can."""
    known = agent.rewards_known
    if known == ANY or reward in (0.0, 1.0) or (known == UNIT and 0.0 <= reward <= 1.0):
        return ""
    return f"{type(agent).__name__} as it is set learns from rewards that are {known}"


def check_reward(agent: Choosy, reward: float) -> None:
    """Refuse a reward that the agent cannot learn from.

    Raises:
        ValueError: saying which it can learn from.
    """
    misfit = reward_misfit(agent, reward)
    if misfit:
        raise ValueError(f"{misfit}, not {reward:g}")


def check_kinds(agent: Choosy, env: VecEnv) -> None:
    """Refuse, before the first pull, environments that are known to give other rewards.

    Raises:
        ValueError: saying which rewards the agent can learn from.
    """
    if agent.rewards_known == ANY or not env.has_attr("kind"):
        return
    if set(env.get_attr("kind")) & set(UNBOUNDED_KINDS):
        raise ValueError(
            f"{reward_misfit(agent, float('nan'))}, and this environment's have normal noise"
        )
