"""The models that environments bring, and a test of these against `step` and `reset`.

Gymnasium's FrozenLake, CliffWalking, Taxi and Blackjack and this project's own classes are trusted:
tests confirm that they follow their models. All other models, those of subclasses too, are tested.
"""

from __future__ import annotations

import copy
import operator
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.toy_text.blackjack import BlackjackEnv
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.envs.toy_text.taxi import TaxiEnv
from gymnasium.utils import seeding
from numpy.typing import NDArray

from rl_yardstick.envs.bandits.clicks import ClickBandit
from rl_yardstick.envs.blackjack_model import blackjack_model, blackjack_observations
from rl_yardstick.envs.finite_env import FiniteEnv, first_above
from rl_yardstick.envs.grid import GridWorld
from rl_yardstick.envs.model_of.check import STEPS, refutation, seeded_globally
from rl_yardstick.mdp.transition_model import Ints, TransitionModel

Env = gym.Env[Any, Any]

TRUSTED_CLASSES = (FrozenLakeEnv, CliffWalkingEnv, TaxiEnv, BlackjackEnv)
OWN_CLASSES = (ClickBandit, FiniteEnv)
N_TRIES = 250  # at setting the state, and at drawing as toy_text does
STEPS_PER_PAIR = 3  # of a state and an action, where the state can be set
STEPS_IN_TURN = 10


@dataclass(frozen=True, eq=False)
class PublishedModel:
    """The model that an environment brings, without wrappers, computed on first access."""

    base: Env

    @cached_property
    def model(self) -> TransitionModel:
        """The dynamics."""
        base = self.base
        if isinstance(base, OWN_CLASSES):
            return base.transition_model()
        if isinstance(base, BlackjackEnv):
            return blackjack_model(bool(base.natural), bool(base.sab))
        P = base.get_wrapper_attr("P")  # noqa: N806 (Gymnasium's own name)
        return TransitionModel.from_gymnasium(P, base.get_wrapper_attr("initial_state_distrib"))

    @cached_property
    def observations(self) -> NDArray[Any] | None:
        """The observation of each state, states along the first axis; None if unknown."""
        if isinstance(self.base, FiniteEnv):
            return np.asarray(self.base.observation_of(np.arange(self.model.n_states)))
        if isinstance(self.base, BlackjackEnv):
            return blackjack_observations()
        space: Any = self.base.observation_space
        return np.arange(space.n) + space.start if isinstance(space, gym.spaces.Discrete) else None


def published_model(base: Env) -> PublishedModel | None:
    """The model that an environment without wrappers brings; None if it brings none.

    Raises:
        ValueError: where the model is invalid, in one line.
    """
    if isinstance(base, OWN_CLASSES):
        brings_model = not isinstance(base, GridWorld) or base.is_stationary
    elif isinstance(base, BlackjackEnv):
        brings_model = is_trusted(base)  # a subclass could not even be checked
    else:
        has_model = isinstance(getattr(base, "P", None), Mapping)
        has_model &= hasattr(base, "initial_state_distrib")
        # A fickle passenger of Taxi changes his mind outside of P.
        brings_model = has_model and not getattr(base, "fickle_passenger", False)
    if not brings_model:
        return None
    published = PublishedModel(base)
    if isinstance(base, OWN_CLASSES) and is_trusted(base):
        return published
    try:
        model, actions, observations = published.model, base.action_space, published.observations
        if not isinstance(actions, gym.spaces.Discrete) or actions.n != model.n_actions:
            raise ValueError(f"it has {model.n_actions} actions, where the space is {actions}")
        if observations is not None and len(observations) != model.n_states:
            space = base.observation_space
            raise ValueError(f"it has {model.n_states} states, where the space is {space}")
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"the environment's P is no model: {text}") from error
    return published


def is_trusted(base: Env) -> bool:
    """Whether the model that an environment brings needs no check."""
    ours = isinstance(base, OWN_CLASSES) and type(base).__module__.startswith("rl_yardstick.envs.")
    return (ours or type(base) in TRUSTED_CLASSES) and not is_changed(base)


def is_changed(base: Env) -> bool:
    """Whether a method of this very object was replaced by hand."""
    return any(callable(getattr(type(base), name, None)) for name in vars(base))


@dataclass(frozen=True)
class ModelCheck:
    """The result of a test of a model against `step`."""

    refusal: str | None  #: why the model is rejected, in one line; None where it is accepted
    #: whether the environment samples as toy_text does, one uniform number for each start and step,
    #: or has nothing to sample: then the model gives the same episodes with the same generator
    bit_for_bit: bool = False
    state_can_be_set: bool = False  #: whether setting the attribute ``s`` sets the state


_checks: dict[tuple[Any, ...], ModelCheck] = {}


def checked(published: PublishedModel) -> ModelCheck:
    """The test of a model, once for environments of the same class, arguments and model.

    A copy without wrappers plays the 20,000 steps of `envs.model_of.check`, and, if its attribute
    ``s`` sets the state, as many again from states drawn from all that the model can reach.
    """
    base, model = published.base, published.model
    arguments = base if base.spec is None else (repr(base.spec.kwargs), base.spec.max_episode_steps)
    parts = model.prob, model.next_state, model.reward, model.terminated, model.initial
    key = type(base), arguments, model.prob.shape, *(hash(part.tobytes()) for part in parts)
    if key not in _checks:
        if is_changed(base):  # a method of the copy may act on the original
            refusal = "a method was replaced by hand: P cannot be compared with it on a copy"
            return ModelCheck(refusal)
        _checks[key] = _check(published)
    return _checks[key]


def _check(published: PublishedModel) -> ModelCheck:
    model = published.model
    try:
        played = Played(copy_of(published.base), published)
        problem = refutation(played, model, played.state, played.actions)
        with seeded_globally(0):
            can_be_set = problem is None and played.can_be_set()
            alike = problem is None and played.draws_alike()
        if can_be_set:
            played.starts = np.flatnonzero(model.reachable)
            anywhere = replace(model, initial=model.reachable / len(played.starts))
            steps = max(STEPS, STEPS_PER_PAIR * len(played.starts) * model.n_actions)
            problem = refutation(played, anywhere, played.state, played.actions, steps=steps)
    except Exception as error:  # noqa: BLE001  # the environment may raise any
        text = " ".join(f"step, which raised {type(error).__name__}: {error}".split())
        return ModelCheck(f"the environment's P cannot be held against {text}")
    if problem is not None:
        return ModelCheck(f"the environment's P is not what step does: {problem}")
    return ModelCheck(None, alike, can_be_set)


def copy_of(env: Env) -> Any:
    """A deep copy without rendering; where that fails, an environment of the same spec."""
    try:
        twin = copy.deepcopy(env)
    except Exception:
        if env.spec is None:
            raise
        twin = gym.make(env.spec)
        twin = twin if isinstance(env, gym.Wrapper) else twin.unwrapped
    vars(twin.unwrapped)["render_mode"] = None
    return twin


class Played(gym.Wrapper[Any, Any, Any, Any]):
    """A copy of an environment that brings a model, and the numbers of its states."""

    env: Any

    def __init__(self, env: Any, published: PublishedModel) -> None:
        super().__init__(env)
        self.model, self.observations = published.model, published.observations
        self.actions = list(range(self.model.n_actions))
        shown: Any = self.observations
        self.observes_states = np.array_equal(np.arange(self.model.n_states), shown)
        self.now, self.seen = 0, set[tuple[int, int]]()
        self.starts: Ints | None = None  # of episodes of one step, if the state can be set
        self.rng = np.random.default_rng(0)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """As the environment, or in one of the starts."""
        result = self.env.reset(seed=seed)
        if self.starts is None:
            return result
        state = self.env.s = self.rng.choice(self.starts)
        return state if self.observations is None else self.observations[state], {}

    def step(self, action: Any) -> Any:
        """As the environment; ValueError where it ends an episode by time."""
        self.seen.add((self.now, action))
        observation, reward, terminated, truncated, info = self.env.step(action)
        if truncated:
            raise ValueError("it gave truncated: leave time limits to max_episode_steps")
        return observation, reward, terminated, self.starts is not None, info

    def state(self, observation: Any, _time: int = 0) -> int | None:
        """The number of the present state, by the observation or ``s``; None if it has none."""
        found: Any = observation if self.observes_states else getattr(self.env, "s", None)
        state = operator.index(found) if hasattr(found, "__index__") else -1
        if not 0 <= state < self.model.n_states:
            return None
        shown = self.observations
        if shown is not None and not np.array_equal(shown[state], observation):
            return None
        self.now = state
        return state

    def outcome(self, action: int) -> tuple[int | None, float, bool]:
        """What a step of the environment leads to: next state, reward, termination."""
        observation, reward, terminated, *_ = self.env.step(action)
        return self.state(observation), float(np.float32(reward)), bool(terminated)

    def draws_alike(self) -> bool:
        """Whether it draws as toy_text does."""
        for seed in range(N_TRIES):
            uniforms = seeding.np_random(seed)[0]
            drawn: Any = first_above(self.model.initial.cumsum(), uniforms.random()), 0.0, False
            seen: Any = self.state(self.env.reset(seed=seed)[0]), 0.0, False
            for action in self.rng.integers(self.model.n_actions, size=STEPS_IN_TURN).tolist():
                if seen != drawn:
                    return False
                if seen[2]:
                    break
                drawn = _outcomes(self.model, seen[0], action, uniforms.random())[1]
                seen = self.outcome(action)
        return True

    def can_be_set(self) -> bool:
        """Whether setting ``s`` sets the whole state.

        Tried are states and actions that episodes have seen: there, the model is right.
        """
        was_set, pairs = self.model.n_states == 1, sorted(self.seen)
        for i in self.rng.integers(len(pairs), size=N_TRIES).tolist():
            begun: Any = self.state(self.env.reset()[0])
            state, action = pairs[i]
            self.env.s = state
            try:
                seen = self.outcome(action)
            except Exception:  # noqa: BLE001  # it may refuse the state in any way
                return False
            if seen not in _outcomes(self.model, state, action, 0.0)[0]:
                return False
            was_set |= seen not in _outcomes(self.model, begun, action, 0.0)[0]
        return was_set


def _outcomes(model: TransitionModel, state: int, action: int, uniform: float) -> tuple[Any, Any]:
    """What an action can lead to, and what toy_text draws: next state, reward, termination."""
    at, chances = (state, action), model.prob[state, action]
    parts = model.next_state[at], np.float32(model.reward[at]), model.terminated[at]
    outcomes = list(zip(*(part.tolist() for part in parts), strict=True))
    drawn = outcomes[first_above(chances.cumsum(), uniform)]
    return [outcomes[k] for k in np.flatnonzero(chances > 0)], drawn
