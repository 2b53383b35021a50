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
N_TRIES = 500  # at setting the state, and at drawing as toy_text does
STEPS_PER_PAIR = 3  # of a state and an action, where the state can be set
EPISODE_LIMIT = 1000
STEPS_IN_TURN = 10


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


def claim_of(base: Env) -> Claim | None:
    """The claim of an environment without wrappers about its dynamics, None without a model.

    Raises:
        ValueError: where the model is invalid, in one line.
    """
    if isinstance(base, OWN_CLASSES):
        brings_model = not isinstance(base, GridWorld) or base.is_stationary
    elif isinstance(base, BlackjackEnv):
        brings_model = is_trusted(base)  # a subclass could not even be checked
    else:
        has_model = isinstance(getattr(base, "P", None), Mapping)
        if has_model and not hasattr(base, "initial_state_distrib"):
            missing = "initial_state_distrib, the probabilities of the starting states, shape (S,)"
            raise ValueError(f"the environment has P, but not {missing}")
        # A fickle passenger of Taxi changes his mind outside of P.
        brings_model = has_model and not getattr(base, "fickle_passenger", False)
    if not brings_model:
        return None
    claim = Claim(base)
    if isinstance(base, OWN_CLASSES) and is_trusted(base):
        return claim
    try:
        model, actions, observations = claim.model, base.action_space, claim.observations
        if not isinstance(actions, gym.spaces.Discrete) or actions.n != model.n_actions:
            raise ValueError(f"it has {model.n_actions} actions, where the space is {actions}")
        if observations is not None and len(observations) != model.n_states:
            space = base.observation_space
            raise ValueError(f"it has {model.n_states} states, where the space is {space}")
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"the environment's P is no model: {text}") from error
    return claim


def is_trusted(base: Env) -> bool:
    """Whether an environment's claim about its dynamics needs no check."""
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
    is_surprising: bool = True  #: whether a user would expect a model


_checks: dict[tuple[Any, ...], ModelCheck] = {}


def checked(claim: Claim) -> ModelCheck:
    """The test of a model, once for environments of the same class, arguments and model.

    A copy without wrappers plays the 20,000 steps of `envs.model_of.check`, and, if its attribute
    ``s`` sets the state, as many again from states drawn from all that the model can reach.
    """
    base, model = claim.base, claim.model
    arguments = base if base.spec is None else (repr(base.spec.kwargs), base.spec.max_episode_steps)
    parts = model.prob, model.next_state, model.reward, model.terminated, model.initial
    key = type(base), arguments, model.prob.shape, *(hash(part.tobytes()) for part in parts)
    if key not in _checks:
        if is_changed(base):  # a method of the copy may act on the original
            refusal = "a method was replaced by hand: P cannot be compared with it on a copy"
            return ModelCheck(refusal)
        _checks[key] = _check(claim)
    return _checks[key]


def _check(claim: Claim) -> ModelCheck:
    model, states = claim.model, np.flatnonzero(claim.model.reachable)
    try:
        played = Played(copy_of(claim.base), claim)
        problem = refutation(played, model, played.state, played.actions)
        with seeded_globally(0):
            alike, can_be_set = (False, False) if problem else played.follows()
        if can_be_set:
            anywhere = replace(model, initial=model.reachable / len(states))
            steps = max(STEPS, STEPS_PER_PAIR * len(states) * model.n_actions)
            from_anywhere = FromAnywhere(played, states)
            problem = refutation(from_anywhere, anywhere, played.state, played.actions, steps=steps)
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

    def __init__(self, env: Any, claim: Claim) -> None:
        super().__init__(env)
        self.model, self.observations = claim.model, claim.observations
        self.actions = list(range(claim.model.n_actions))
        states = np.arange(self.model.n_states)
        self.observes_states = np.array_equal(
            states, states[:0] if self.observations is None else self.observations
        )
        self.now, self.seen = 0, set[tuple[int, int]]()

    def step(self, action: Any) -> Any:
        """As the environment; ValueError where it ends an episode by time."""
        self.seen.add((self.now, action))
        result = self.env.step(action)
        if result[3]:
            raise ValueError("it gave truncated: leave time limits to max_episode_steps")
        return result

    def state(self, observation: Any, _time: int = 0) -> int | None:
        """The number of the present state, by the observation or ``s``; None if it has none."""
        found: Any = observation if self.observes_states else getattr(self.env, "s", None)
        state = operator.index(found) if hasattr(found, "__index__") else -1
        if not 0 <= state < self.model.n_states:
            return None
        shown = None if self.observes_states or self.observations is None else self.observations
        if shown is not None and not np.array_equal(shown[state], observation):
            return None
        self.now = state
        return state

    def number(self, observation: Any) -> int:
        """As `state`, which is known to have a number."""
        state = self.state(observation)
        assert state is not None
        return state

    def follows(self) -> tuple[bool, bool]:
        """Whether it draws as toy_text does, and whether setting ``s`` sets the whole state.

        Tried are states and actions that episodes have seen: there, the model is right.
        """
        model, rng, pairs = self.model, np.random.default_rng(0), sorted(self.seen)
        alike, alike_if_set, was_set = True, True, model.n_states == 1
        for seed in range(N_TRIES):
            uniforms, sets = seeding.np_random(seed)[0], seed % 2 == 1
            begun = state = self.number(self.env.reset(seed=seed)[0])
            alike &= state == first_above(model.initial.cumsum(), uniforms.random())
            for _ in range(1 if sets else STEPS_IN_TURN):
                action = int(rng.integers(model.n_actions))
                if sets:
                    state, action = pairs[rng.integers(len(pairs))]
                    self.env.s = state
                try:
                    result = self.env.step(action)
                except Exception:  # noqa: BLE001  # it may refuse the state in any way
                    return alike, False
                said, drawn = _outcomes(model, state, action, uniforms.random())
                seen = self.number(result[0]), np.float32(result[1]), bool(result[2])
                if seen not in said:
                    return alike, False
                if sets:
                    alike_if_set &= seen == drawn
                    was_set |= seen not in _outcomes(model, begun, action, 0)[0]
                    break
                alike &= seen == drawn
                state = seen[0]
                if seen[2]:
                    break
        return alike and (alike_if_set or not was_set), was_set


class FromAnywhere(gym.Wrapper[Any, Any, Any, Any]):
    """Episodes of one step from any of the states given."""

    env: Played

    def __init__(self, env: Played, states: Ints) -> None:
        super().__init__(env)
        self.states, self.rng, self.n_steps, self.is_over = (
            states,
            np.random.default_rng(0),
            0,
            True,
        )

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Set the state; the environment begins anew only after an end."""
        if self.is_over or self.n_steps % EPISODE_LIMIT == 0:
            self.env.reset(seed=seed)
        state = self.env.env.s = self.states[self.rng.integers(len(self.states))]
        return state if self.env.observations is None else self.env.observations[state], {}

    def step(self, action: Any) -> Any:
        """As the environment, and the end of the episode."""
        observation, reward, self.is_over, _, info = self.env.step(action)
        self.n_steps += 1
        return observation, reward, self.is_over, True, info


def _outcomes(model: TransitionModel, state: int, action: int, uniform: float) -> tuple[Any, Any]:
    """What an action can lead to, and what toy_text draws: next state, reward, termination."""
    at = state, action
    rows = zip(
        model.next_state[at], model.reward[at].astype(np.float32), model.terminated[at], strict=True
    )
    outcomes = [(int(after), reward, bool(ends)) for after, reward, ends in rows]
    possible = {outcome for outcome, p in zip(outcomes, model.prob[at], strict=True) if p > 0}
    return possible, outcomes[first_above(model.prob[at].cumsum(), uniform)]
