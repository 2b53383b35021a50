"""What environments, without their wrappers, say of their own dynamics, and whose word is enough.

Gymnasium's FrozenLake, CliffWalking and Taxi and this project's own classes step as they say, which
tests hold. Gymnasium's Blackjack says nothing, but `envs.blackjack_model` knows its rules. Whatever
else brings a model, a subclass of one of these too, only claims to.
"""

from __future__ import annotations

import pickle
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

from envs.bandits.clicks import ClickBandit
from envs.blackjack_model import blackjack_model, blackjack_observations
from envs.finite_env import FiniteEnv
from envs.grid import GridWorld
from mdp.transition_model import TransitionModel

Env = gym.Env[Any, Any]

TRUSTED_CLASSES = (FrozenLakeEnv, CliffWalkingEnv, TaxiEnv)
OWN_CLASSES = (GridWorld, ClickBandit, FiniteEnv)


@dataclass(frozen=True, eq=False)
class Claim:
    """What an environment says of its dynamics, worked out when it is asked for.

    Args:
        base: an environment that `brings_model`, without wrappers.
    """

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
        """What is observed in each state, states along the first axis; None if it does not say."""
        if isinstance(self.base, GridWorld):
            return self.base.observation_of(np.arange(self.base.dynamics.n_states))
        if isinstance(self.base, FiniteEnv):
            return np.asarray(self.base.observation_of(np.arange(self.model.n_states)))
        if isinstance(self.base, BlackjackEnv):
            return blackjack_observations()
        space = self.base.observation_space
        return np.arange(space.n) if isinstance(space, gym.spaces.Discrete) else None

    @property
    def plays_from_model(self) -> bool:
        """Whether a trusted environment draws just what its model says, and goes on from any state.

        Blackjack draws cards, and others draw rewards of which the model holds the means.
        """
        if isinstance(self.base, FiniteEnv):
            return self.model.reward_variance is None
        return not isinstance(self.base, BlackjackEnv)

    @cached_property
    def observes_states(self) -> bool:
        """Whether an observation is the number of the state."""
        if isinstance(self.base, GridWorld):
            return False
        seen = self.observations
        return seen is not None and np.array_equal(seen, np.arange(self.model.n_states))

    def check_spaces(self) -> None:
        """Make sure that the model has the environment's actions and as many states.

        Raises:
            ValueError: if not.
        """
        base, model = self.base, self.model
        if not isinstance(base.action_space, gym.spaces.Discrete) or (
            int(base.action_space.n) != model.n_actions
        ):
            text = f"it has {model.n_actions} actions, where the space is {base.action_space}"
            raise ValueError(text)
        if self.observations is not None and len(self.observations) != model.n_states:
            text = f"it has {model.n_states} states, where the space is {base.observation_space}"
            raise ValueError(text)


def claim_of(base: Env) -> Claim | None:
    """What an environment says of its dynamics, None where it says nothing.

    Args:
        base: the environment, without wrappers.

    Raises:
        ValueError: where what it says is no model, in one line.
    """
    try:
        if not brings_model(base):
            return None
        claim = Claim(base)
        if not (is_ours(base) or isinstance(base, BlackjackEnv)):
            claim.check_spaces()
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"the environment's P is no model: {reason}") from error
    return claim


def brings_model(base: Env) -> bool:
    """Whether an environment says anything of its dynamics."""
    if isinstance(base, OWN_CLASSES):
        return not isinstance(base, GridWorld) or base.is_stationary
    if isinstance(base, BlackjackEnv):
        return _is_known_blackjack(base)
    # A fickle passenger of Taxi changes his mind outside of P.
    fickle = getattr(base, "fickle_passenger", False)
    brings = isinstance(getattr(base, "P", None), Mapping)
    return brings and hasattr(base, "initial_state_distrib") and not fickle


def is_trusted(base: Env) -> bool:
    """Whether an environment's own word on its dynamics is enough."""
    trusted = type(base) in TRUSTED_CLASSES and not _is_changed(base)
    return is_ours(base) or trusted or _is_known_blackjack(base)


def is_ours(base: Env) -> bool:
    """Whether it is one of this project's, as it was made."""
    ours = isinstance(base, OWN_CLASSES)
    return ours and type(base).__module__.startswith("envs.") and not _is_changed(base)


def _is_known_blackjack(base: Env) -> bool:
    """Whether it is Gymnasium's Blackjack; what a subclass does could not even be looked at."""
    return type(base) is BlackjackEnv and not _is_changed(base)


def _is_changed(base: Env) -> bool:
    """Whether a method of this very object was replaced by hand."""
    return any(callable(getattr(type(base), name, None)) for name in vars(base))


# --- what dynamics are made from ------------------------------------------------------------------
# Working out the model of a million states takes longer than a training on it. It can be kept as
# long as all that it was made from is as it was, to the last bit: attributes may be changed by hand
# at any time.

# What changes while an environment is played or shown, and what is worked out from the rest.
PLAYED = frozenset(
    {"s", "spec", "render_mode", "_np_random", "_np_random_seed", "_renderer", "_steps"}
    | {"_last_action", "last_action", "P"}
)


@dataclass(frozen=True, eq=False)
class Sources:
    """All that an environment's dynamics are made from.

    Attributes:
        parts: the class and those above it, and what stands in them.
        content: what the environment holds, as bytes that are compared and never read.
    """

    parts: tuple[Any, ...]
    content: bytes

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sources) or len(self.parts) != len(other.parts):
            return False
        same = all(mine is theirs for mine, theirs in zip(self.parts, other.parts, strict=True))
        return same and self.content == other.content

    __hash__ = None  # type: ignore[assignment]  # what is compared by identity may not be hashable


def sources_of(base: Env) -> Sources | None:
    """What the model of an environment without wrappers is made from; None if not all is known.

    It is known of Gymnasium's toy_text and of this project's environments, see `is_trusted`.
    """
    if not is_trusted(base):
        return None
    parts = [type(base)]
    if isinstance(base, GridWorld | FiniteEnv):
        base.initial_state_distrib  # noqa: B018  # worked out now, so that it is always there
        held = {name: _lasting(value) for name, value in vars(base).items() if name not in PLAYED}
        for cls in type(base).__mro__[: type(base).__mro__.index(gym.Env)]:
            parts += vars(cls).values()
    elif isinstance(base, TRUSTED_CLASSES):
        names = ("P", "initial_state_distrib", "observation_space", "action_space")
        held = {name: _lasting(getattr(base, name)) for name in names}
        held["fickle"] = getattr(base, "fickle_passenger", False)
    else:
        return None
    content = pickled(held)
    return None if content is None else Sources(tuple(parts), content)


def _lasting(value: object) -> object:
    """A space without its generator, which is drawn from; anything else as it is."""
    return repr(value) if isinstance(value, gym.Space) else value


def pickled(held: object) -> bytes | None:
    """Bytes that are the same for what is the same; None where there are none such."""
    try:
        return pickle.dumps(held)
    except Exception:  # noqa: BLE001  # an object that cannot be written down may be anything
        return None
