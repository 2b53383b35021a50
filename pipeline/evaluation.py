"""How good an agent is: played on the environment as it is, never on a training variant of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv


@dataclass(frozen=True)
class Evaluation:
    """Episodes that an agent has played.

    Attributes:
        returns: undiscounted return of each episode, shape (n_episodes,).
        lengths: number of steps of each, shape (n_episodes,).
        successes: whether each succeeded, shape (n_episodes,); None where the environment does not
            say.
    """

    returns: NDArray[np.float64]
    lengths: NDArray[np.int64]
    successes: NDArray[np.bool_] | None

    @property
    def mean_return(self) -> float:
        """Mean of the returns."""
        return float(self.returns.mean())

    @property
    def std_return(self) -> float:
        """Standard deviation of the returns."""
        return float(self.returns.std())

    @property
    def success_rate(self) -> float | None:
        """Share of the episodes that succeeded, if the environment says so."""
        return None if self.successes is None else float(self.successes.mean())

    def summary(self) -> dict[str, Any]:
        """The figures as JSON."""
        return {
            "mean_return": self.mean_return,
            "std_return": self.std_return,
            "mean_length": float(self.lengths.mean()),
            "success_rate": self.success_rate,
            "n_episodes": len(self.returns),
        }


def evaluate(
    model: BaseAlgorithm, env: VecEnv, n_episodes: int, seed: int, deterministic: bool = True
) -> Evaluation:
    """Play ``n_episodes``, the same ones each time that ``seed`` is the same.

    Args:
        model: the agent.
        env: environments to play on, with a time limit.
        n_episodes: how many episodes, shared evenly between the environments.
        seed: of the environments.
        deterministic: play the policy's best action rather than sample one.
    """
    successes: list[bool] = []

    def note_success(local: dict[str, Any], _: dict[str, Any]) -> None:
        if local["done"] and "is_success" in local["info"]:
            successes.append(bool(local["info"]["is_success"]))

    env.seed(seed)
    returns, lengths = evaluate_policy(
        model,
        env,
        n_eval_episodes=n_episodes,
        deterministic=deterministic,
        return_episode_rewards=True,
        callback=note_success,
        warn=False,
    )
    return Evaluation(
        np.asarray(returns, dtype=np.float64),
        np.asarray(lengths, dtype=np.int64),
        np.array(successes) if len(successes) == n_episodes else None,
    )


def evaluation_seed(seed: int, purpose: int) -> int:
    """A seed for evaluations that lies apart from training's and from other purposes'.

    Args:
        seed: the run's seed.
        purpose: 1 during training, 2 at its end, 3 when playing.
    """
    stream = np.random.SeedSequence(seed, spawn_key=(purpose,))
    return int(stream.generate_state(1)[0] % 2**31)
