"""Noise on continuous actions: what ``noise_type`` and ``noise_std`` ask for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import UserError
from pipeline.settings.constructor_arguments import constructor_parameters
from pipeline.settings.hyperparams import Hyperparams

if TYPE_CHECKING:
    from gymnasium import spaces
    from stable_baselines3.common.base_class import BaseAlgorithm


def check_action_noise(hyperparams: Hyperparams, algorithm: type[BaseAlgorithm], algo: str) -> None:
    """Make sure that the agent takes the noise that is asked for.

    Raises:
        UserError: if it takes none.
    """
    if hyperparams.noise_type is not None and "action_noise" not in constructor_parameters(
        algorithm
    ):
        raise UserError(
            f"{algo}: noise_type is for agents that add noise to continuous actions, such as td3"
        )


def action_noise(hyperparams: Hyperparams, actions: spaces.Space[Any]) -> dict[str, Any]:
    """The constructor argument ``action_noise``, as a mapping; empty where none is asked for.

    Args:
        hyperparams: of the run; the noise has mean 0 and the same standard deviation
            ``noise_std`` in each component of an action, after actions are scaled to [-1, 1].
        actions: what the agent acts in, a Box.
    """
    if hyperparams.noise_type is None:
        return {}
    from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise

    kinds = {"normal": NormalActionNoise, "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise}
    mean = np.zeros(actions.shape or ())
    sigma = np.full_like(mean, hyperparams.noise_std)
    return {"action_noise": kinds[hyperparams.noise_type](mean, sigma)}
