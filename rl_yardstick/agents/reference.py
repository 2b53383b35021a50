"""Agents that do not learn, as baselines for the others."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from rl_yardstick.agents.common.algorithm import OnlineAlgorithm
from rl_yardstick.agents.common.model_files import TablePolicy

POLE_ANGLE = 2
LEFT, RIGHT = 0, 1


class RandomPolicy(TablePolicy):
    """Uniformly random actions from the action space's own generator."""

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        first = next(iter(observation.values())) if isinstance(observation, dict) else observation
        return th.from_numpy(np.stack([self.action_space.sample() for _ in range(len(first))]))


class AnglePolicy(TablePolicy):
    """Push the cart towards the side that the pole leans to."""

    def _predict(
        self, observation: th.Tensor | dict[str, th.Tensor], deterministic: bool = False
    ) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        return th.where(observation[:, POLE_ANGLE] > 0, RIGHT, LEFT)


class ReferenceAgent(OnlineAlgorithm):
    """Acts by a fixed policy; training it changes nothing but its counters.

    Args:
        policy: name of the policy.
        env: environment, or its id.
    """

    hidden_arguments = ("learning_rate", "policy_kwargs", "supported_action_spaces")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.policy_class(self.observation_space, self.action_space)

    def _choose_actions(self) -> NDArray[Any]:
        assert self._last_obs is not None
        return self.predict(self._last_obs)[0]


class RandomAgent(ReferenceAgent):
    """Uniformly random actions, whatever is observed."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"RandomPolicy": RandomPolicy}


class AngleAgent(ReferenceAgent):
    """CartPole: push the cart towards the side that the pole leans to."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"AnglePolicy": AnglePolicy}
