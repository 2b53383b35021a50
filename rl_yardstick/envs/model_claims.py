"""The models that environments (without wrappers) claim for themselves, and which are trusted.

Gymnasium's FrozenLake, CliffWalking and Taxi and this project's own classes follow their models,
as tests confirm. Gymnasium's Blackjack has no model, but `envs.blackjack_model` knows its rules.
The models of all others, subclasses of these too, are only claims.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.toy_text.blackjack import BlackjackEnv
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.envs.toy_text.taxi import TaxiEnv
from numpy.typing import NDArray

from rl_yardstick.envs.bandits.clicks import ClickBandit
from rl_yardstick.envs.blackjack_model import blackjack_model, blackjack_observations
from rl_yardstick.envs.finite_env import FiniteEnv
from rl_yardstick.envs.grid import GridWorld
from rl_yardstick.mdp.transition_model import TransitionModel

Env = gym.Env[Any, Any]

TRUSTED_CLASSES = (FrozenLakeEnv, CliffWalkingEnv, TaxiEnv, BlackjackEnv)
OWN_CLASSES = (ClickBandit, FiniteEnv)


@dataclass(frozen=True, eq=False)
class Claim:
    """An environment's claim about its dynamics, without wrappers, computed on first access."""

    base: Env

    @cached_property
    def model(self) -> TransitionModel:
        """The dynamics."""
        base = self.base
        if isinstance(base, OWN_CLASSES):
            return base.transition_model()
        if isinstance(base, BlackjackEnv):
            return blackjack_model(base)
        P = base.get_wrapper_attr("P")  # noqa: N806 (Gymnasium's own name)
        return TransitionModel.from_gymnasium(P, base.get_wrapper_attr("initial_state_distrib"))

    @cached_property
    def observations(self) -> NDArray[Any] | None:
        """The observation of each state, states along the first axis; None if unknown."""
        if isinstance(self.base, FiniteEnv):
            return np.asarray(self.base.observation_of(np.arange(self.model.n_states)))
        if isinstance(self.base, BlackjackEnv):
            return blackjack_observations()
        space = self.base.observation_space
        return np.arange(space.n) if isinstance(space, gym.spaces.Discrete) else None

    @property
    def plays_from_model(self) -> bool:
        """Whether a trusted environment samples exactly its model, and goes on from any state.

        Blackjack draws cards, and random rewards have only their means in the model.
        """
        if isinstance(self.base, FiniteEnv):
            return self.model.reward_variance is None
        return not isinstance(self.base, BlackjackEnv)

    @cached_property
    def observes_states(self) -> bool:
        """Whether an observation is the number of the state."""
        seen = self.observations
        return seen is not None and np.array_equal(seen, np.arange(self.model.n_states))


def claim_of(base: Env) -> Claim | None:
    """The claim of an environment without wrappers about its dynamics, None without a model.

    Raises:
        ValueError: where the model is invalid, in one line.
    """
    if not _brings_model(base):
        return None
    claim = Claim(base)
    if is_ours(base):
        return claim
    try:
        model, actions, observations = claim.model, base.action_space, claim.observations
        if not isinstance(actions, gym.spaces.Discrete) or actions.n != model.n_actions:
            raise ValueError(f"it has {model.n_actions} actions, where the space is {actions}")
        if observations is not None and len(observations) != model.n_states:
            space = base.observation_space
            raise ValueError(f"it has {model.n_states} states, where the space is {space}")
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise ValueError(f"the environment's P is no model: {one_line(error)}") from error
    return claim


def _brings_model(base: Env) -> bool:
    if isinstance(base, OWN_CLASSES):
        return not isinstance(base, GridWorld) or base.is_stationary
    if isinstance(base, BlackjackEnv):
        return is_trusted(base)  # a subclass could not even be checked
    # A fickle passenger of Taxi changes his mind outside of P.
    fickle = getattr(base, "fickle_passenger", False)
    brings = isinstance(getattr(base, "P", None), Mapping)
    return brings and hasattr(base, "initial_state_distrib") and not fickle


def is_trusted(base: Env) -> bool:
    """Whether an environment's claim about its dynamics needs no check."""
    return is_ours(base) or (type(base) in TRUSTED_CLASSES and not is_changed(base))


def is_ours(base: Env) -> bool:
    """Whether it is an environment of this project, with no method replaced by hand."""
    ours = isinstance(base, OWN_CLASSES)
    return ours and type(base).__module__.startswith("rl_yardstick.envs.") and not is_changed(base)


def is_changed(base: Env) -> bool:
    """Whether a method of this very object was replaced by hand."""
    return any(callable(getattr(type(base), name, None)) for name in vars(base))


def one_line(error: Exception) -> str:
    """The message of an error in one line, or its name where it has none."""
    return " ".join(str(error).split()) or type(error).__name__
