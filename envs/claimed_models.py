"""What environments, without their wrappers, say of their own dynamics, and whose word is enough.

Gymnasium's FrozenLake, CliffWalking and Taxi and this project's own classes step as they say, which
tests hold. Whatever else brings a model, a subclass of one of these too, only claims to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.envs.toy_text.taxi import TaxiEnv
from numpy.typing import NDArray

from envs.bandits.clicks import ClickBandit
from envs.grid import GridWorld
from mdp.transition_model import TransitionModel

Env = gym.Env[Any, Any]

TRUSTED_CLASSES = (FrozenLakeEnv, CliffWalkingEnv, TaxiEnv)


@dataclass(frozen=True, eq=False)
class Claim:
    """A model as an environment tells it.

    Attributes:
        model: the dynamics.
        observations: what is observed in each state, states along the first axis; None where the
            environment does not say.
        observes_states: whether an observation is the number of the state.
    """

    model: TransitionModel
    observations: NDArray[Any] | None
    observes_states: bool


def claim_of(base: Env) -> Claim | None:
    """What an environment says of its dynamics, None where it says nothing.

    Args:
        base: the environment, without wrappers.

    Raises:
        ValueError: where what it says is no model, in one line.
    """
    try:
        return _claim_of(base) if _brings_model(base) else None
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"the environment's P is no model: {reason}") from error


def is_trusted(base: Env) -> bool:
    """Whether an environment's own word on its dynamics is enough."""
    kind = type(base)
    if any(callable(getattr(kind, name, None)) for name in vars(base)):
        return False  # a method was replaced by hand
    ours = isinstance(base, GridWorld | ClickBandit) and kind.__module__.startswith("envs.")
    return ours or kind in TRUSTED_CLASSES


def _brings_model(base: Env) -> bool:
    if isinstance(base, GridWorld | ClickBandit):
        return True
    # A fickle passenger of Taxi changes his mind outside of P.
    fickle = getattr(base, "fickle_passenger", False)
    brings = isinstance(getattr(base, "P", None), Mapping)
    return brings and hasattr(base, "initial_state_distrib") and not fickle


def _claim_of(base: Env) -> Claim:
    if isinstance(base, GridWorld | ClickBandit):
        model = base.transition_model()
    else:
        model = TransitionModel.from_gymnasium(
            base.get_wrapper_attr("P"), base.get_wrapper_attr("initial_state_distrib")
        )
    _check_space("actions", base.action_space, model.n_actions)
    states = np.arange(model.n_states)
    if isinstance(base, GridWorld):
        return Claim(model, base.observation_of(states), observes_states=False)
    if not isinstance(base.observation_space, gym.spaces.Discrete):
        return Claim(model, None, observes_states=False)
    _check_space("states", base.observation_space, model.n_states)
    return Claim(model, states, observes_states=True)


def _check_space(what: str, space: gym.Space[Any], number: int) -> None:
    if not isinstance(space, gym.spaces.Discrete) or int(space.n) != number:
        raise ValueError(f"it has {number} {what}, where the space is {space}")
