"""Whether an environment's model is what its `step` and `reset` do."""

from __future__ import annotations

import hashlib
import pickle
import random
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from envs.checking.claimed_models import Claim, claim_of
from envs.checking.env_copies import copy_of, global_generators_apart
from envs.checking.model_sampling import Budget, sample
from envs.checking.odd_frequencies import odd_frequencies
from envs.checking.watched_env import SEED, DisagreementError, WatchedEnv
from mdp.transition_model import TransitionModel

Env = gym.Env[Any, Any]

N_STEPS = 60_000
# Where the environment has no limit of its own.
EPISODE_LIMIT = 1000

DIFFERENT = "the environment's P is not what step does: "

# What changes while an environment is played, and says nothing of its dynamics.
PLAYED = frozenset({"s", "lastaction", "spec", "render_mode", "_np_random", "_np_random_seed"})
PLAYED_KINDS = (np.random.Generator, np.random.RandomState, random.Random, gym.Space)


@dataclass(frozen=True)
class ModelCheck:
    """What came of holding a model against `step`.

    Attributes:
        refusal: why the model is not believed, in one line; None where it is.
        bit_for_bit: whether the environment draws as Gymnasium's toy_text environments do, one
            uniform number for each start and each step, looked up in the cumulative sum of the
            probabilities as ``P`` orders them, or never has anything to draw. Whoever draws so
            from the model, by the same generator, gets the very same episodes.
        state_can_be_set: whether the environment goes on from where its attribute ``s`` is put.
        n_steps: the steps that were held against the model.
    """

    refusal: str | None
    bit_for_bit: bool = False
    state_can_be_set: bool = False
    n_steps: int = 0


_checks: dict[tuple[Any, ...], ModelCheck] = {}
_kept_alive: list[object] = []


def check_transition_model(env: Env, n_steps: int = N_STEPS) -> ModelCheck:
    """Hold the model that an environment brings against what its `step` and `reset` do.

    A copy of the environment, without its wrappers, plays random episodes, up to their time limit
    or 1000 steps. Then, where its attribute ``s`` can be set, which is tried out, it takes every
    action in every state that the model says can be reached, and most often those whose frequencies
    fit least; elsewhere it is steered to where it was least.

    - Whatever the model gives no chance (a next state, a reward that differs in single precision,
      a termination or none, a start, an observation that is not the state's number, a truncation)
      is found as soon as it happens once.
    - Frequencies are held against the model's probabilities: for each state and action, for all
      that should be alike together, and these by the step of the episode, by the number of steps so
      far, by the last outcome and by the last action, so that much of what depends on more than the
      state shows. A right model is refused with a chance of at most one in a million, if ``s``,
      where it can be set, is all of the state.

    Not found is what happens too seldom to be seen, what is hidden in states that neither episodes
    nor setting ``s`` lead to, and what changes after the check. The copy is a deep one, or another
    environment made alike (see `envs.checking.env_copies.copy_of`): the caller's episode and
    generators stay as they are, but what the environment shares with its copies, such as an
    attribute of its class, is used. The same environment is always judged in the same way, unless
    it draws from a generator that `reset` does not seed.

    Args:
        env: an environment that has ``P`` and ``initial_state_distrib``, wrapped or not.
        n_steps: steps to take; more where there are more states and actions.

    Raises:
        ValueError: if it brings no model.
    """
    base = env.unwrapped
    try:
        claim = claim_of(base)
    except ValueError as error:
        return ModelCheck(str(error))
    if claim is None:
        raise ValueError(f"{base} brings no model to check: no P and initial_state_distrib")
    return _check(base, claim, n_steps)


def checked(base: Env, claim: Claim) -> ModelCheck:
    """As `check_transition_model`, worked out once for environments of the same attributes."""
    kind = (type(base), _limit(base))
    now = (*kind, _digest(base, claim.model))
    if now not in _checks:
        # An environment that is being played differs from a new one, and yet is the same.
        new = (*kind, _digest_when_new(base, claim.model))
        if new not in _checks:
            _checks[new] = _check(base, claim, N_STEPS)
        _checks[now] = _checks[new]
    return _checks[now]


def _check(base: Env, claim: Claim, n_steps: int) -> ModelCheck:
    try:
        with global_generators_apart(SEED):
            twin = copy_of(base)
            _require_same(claim, twin)
            watched = WatchedEnv(twin, claim)
            can_be_set = sample(watched, Budget(n_steps, _limit(base)))
    except DisagreementError as error:
        return ModelCheck(DIFFERENT + str(error))
    except ValueError as error:
        return ModelCheck(f"the environment's P cannot be held against step: {error}")
    odd = next(odd_frequencies(watched), None)
    n_done = len(watched.steps.row)
    if odd is not None:
        return ModelCheck(DIFFERENT + odd, n_steps=n_done)
    return ModelCheck(None, watched.draws_as_toy_text(), can_be_set, n_done)


def _require_same(claim: Claim, twin: Env) -> None:
    """Make sure that a copy says the same of itself.

    Raises:
        ValueError: if it does not.
    """
    other = claim_of(twin)
    if other is None or _model_digest(other.model) != _model_digest(claim.model):
        raise ValueError("another environment made in the same way has another P")


def _limit(base: Env) -> int:
    limit = None if base.spec is None else base.spec.max_episode_steps
    return limit or EPISODE_LIMIT


def _digest_when_new(base: Env, model: TransitionModel) -> bytes:
    """The digest that the environment has at the beginning of an episode."""
    try:
        with global_generators_apart(SEED):
            twin = copy_of(base)
            twin.reset(seed=SEED)
    except Exception:  # noqa: BLE001  # whatever it is, the check will say
        return _digest(base, model)
    return _digest(twin, model)


def _digest(base: Env, model: TransitionModel) -> bytes:
    """What an environment's dynamics may depend on: its model and its attributes."""
    found = hashlib.blake2b(_model_digest(model))
    for name, value in sorted(vars(base).items()):
        if name in PLAYED or isinstance(value, PLAYED_KINDS):
            continue
        try:
            # Written to be compared, and never read.
            found.update(pickle.dumps((name, value)))
        except Exception:  # noqa: BLE001  # such as a function without a name: that very object
            _kept_alive.append(value)
            found.update(f"{name} {id(value)}".encode())
    return found.digest()


def _model_digest(model: TransitionModel) -> bytes:
    found = hashlib.blake2b(repr(model.prob.shape).encode())
    for array in (model.prob, model.next_state, model.reward, model.terminated, model.initial):
        found.update(array.tobytes())
    return found.digest()
