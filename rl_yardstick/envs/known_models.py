"""The exact dynamics of a Gymnasium environment, with the effects of its wrappers.

A model is the one that the environment brings (see `envs.published_models`), or one that a search
in its code finds (`envs.found_models`); both are tested against `step`. Known wrappers change a
model in a known way; around others, the search looks at the environment in its wrappers.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.toy_text.blackjack import BlackjackEnv
from gymnasium.envs.toy_text.taxi import TaxiEnv
from gymnasium.wrappers import ClipReward
from numpy.typing import NDArray

from rl_yardstick.envs import found_models
from rl_yardstick.envs.finite_env import FiniteEnv, MaskedFiniteEnv
from rl_yardstick.envs.found_models import NotFound
from rl_yardstick.envs.grid import GOAL, GridWorld
from rl_yardstick.envs.model_of import FoundModel
from rl_yardstick.envs.published_models import (
    ModelCheck,
    PublishedModel,
    checked,
    is_trusted,
    published_model,
)
from rl_yardstick.envs.wrappers import (
    ActionMasks,
    DiscretizeObservation,
    FlattenToDiscrete,
    IdleActionMasks,
    OneHotObservation,
    ScaleReward,
    TerminationReward,
    mask_source,
)
from rl_yardstick.mdp.transition_model import Bools, TransitionModel

Env = gym.Env[Any, Any]
Wrapper = gym.Wrapper[Any, Any, Any, Any]

# By name, and not as classes: this package does not import Stable-Baselines3, and a subclass may
# do anything.
TRANSPARENT_WRAPPERS = frozenset(
    {
        "gymnasium.wrappers.common.OrderEnforcing",
        "gymnasium.wrappers.common.PassiveEnvChecker",
        "gymnasium.wrappers.common.RecordEpisodeStatistics",
        "gymnasium.wrappers.common.TimeLimit",
        "gymnasium.wrappers.rendering.HumanRendering",
        "gymnasium.wrappers.rendering.RecordVideo",
        "gymnasium.wrappers.rendering.RenderCollection",
        "stable_baselines3.common.monitor.Monitor",
    }
)
OBSERVATION_WRAPPERS = (DiscretizeObservation, FlattenToDiscrete, OneHotObservation)

Judgement = tuple[PublishedModel | FoundModel | NotFound | None, ModelCheck | None]

# A cache of judgements of environments, by `id`: set only while these live.
_looked_at: dict[int, Judgement] = {}


def transition_model(env: Env) -> TransitionModel | None:
    """The exact dynamics of an environment, with the rewards that its outermost wrapper gives.

    The model is known for this project's grid worlds and textbook environments, its bandits with
    click rates, Gymnasium's FrozenLake, CliffWalking, Taxi and Blackjack, environments that hold
    ``P`` and ``initial_state_distrib`` as toy_text's do, and those in which a search finds it. A
    time limit is no part of the model: see `time_limit`. None where the model is not known.
    """
    core, wrappers = core_of(env)
    known = _believed(core)
    if known is None:
        return None
    model = known.model
    reward, variance = model.reward, model.reward_variance
    for wrapper in wrappers:
        if isinstance(wrapper, ScaleReward):
            reward = reward * wrapper.scale
            variance = None if variance is None else variance * wrapper.scale**2
        elif isinstance(wrapper, TerminationReward):
            reward = np.where(model.terminated, wrapper.last_reward, reward)
            variance = None if variance is None else np.where(model.terminated, 0.0, variance)
        elif isinstance(wrapper, ClipReward):
            if variance is not None:
                return None
            reward = np.asarray(wrapper.func(reward), dtype=np.float64)
    if reward is model.reward:
        return model
    return replace(model, reward=reward, reward_variance=variance)


def model_check(env: Env) -> ModelCheck | None:
    """The test of the model that the environment brings against its `step`; None if it has none.

    Trusted environments pass without a test.
    """
    return _judged(core_of(env)[0])[1]


def found_model(env: Env) -> FoundModel | None:
    """What a search has found of an environment; None where the model is not from a search."""
    found = _judged(core_of(env)[0])[0]
    return found if isinstance(found, FoundModel) else None


def why_unknown(env: Env, at_limits_only: bool = False) -> str | None:
    """Why the model is not known, in one line; None where it is, or nothing is to be said.

    With ``at_limits_only``, a search has nothing to say but that it ended at its limits.
    """
    found, check = _judged(core_of(env)[0])
    if not isinstance(found, NotFound):
        return None if check is None else check.refusal
    return found.reason if found.is_at_limit or not at_limits_only else None


def time_limit(env: Env) -> int | None:
    """The number of steps after which an episode is cut off, None where there is no limit."""
    wrappers = layers(env)[1]
    limits = [w._max_episode_steps for w in wrappers if isinstance(w, gym.wrappers.TimeLimit)]
    if (found := found_model(env)) is not None and found.horizon is not None:
        limits.append(found.horizon)
    return min(limits, default=None)


def success_outcomes(env: Env) -> Bools | None:
    """The transitions that end an episode well, bool of shape (S, A, K) as in `transition_model`.

    In a grid world those are the ones that reach a goal. Elsewhere they are the ones that
    terminate with the highest reward that any termination has before wrappers change it: the goal
    of FrozenLake and CliffWalking, the passenger delivered in Taxi. In Blackjack it is any win.
    None where the model is not known or no episode terminates.
    """
    base, known = env.unwrapped, _believed(core_of(env)[0])
    if known is None:
        return None
    model = known.model
    ends = model.terminated & (model.prob > 0) & model.reachable[:, None, None]
    if not ends.any():
        return None
    if isinstance(base, GridWorld) and not isinstance(known, FoundModel):
        codes = np.frombuffer(base.map.codes, np.uint8)
        good = codes[model.next_state % base.map.n_cells] == ord(GOAL)
    elif isinstance(base, BlackjackEnv):
        good = model.reward > 0
    else:
        good = model.reward == model.reward[ends].max()
    success: Bools = ends & good
    return success


def observations_of_states(env: Env) -> NDArray[Any] | None:
    """The observation of each state of `transition_model`; None where it is not known."""
    core, wrappers = core_of(env)
    known = _believed(core)
    observations = None if known is None else known.observations
    for wrapper in wrappers:
        if observations is not None and isinstance(wrapper, OBSERVATION_WRAPPERS):
            observations = wrapper.map_observations(observations)
    return observations


def action_masks_of_states(env: Env) -> Bools | None:
    """The action mask of each state of `transition_model`, bool of shape (S, A).

    Known for this project's environments, Gymnasium's Taxi, and `IdleActionMasks`, under known
    wrappers, and where some actions raise an error; None elsewhere.
    """
    core, wrappers = core_of(env)
    idle = [wrapper.masks for wrapper in wrappers if isinstance(wrapper, IdleActionMasks)]
    if idle:
        return np.array(idle[-1])
    if isinstance(found := _judged(core)[0], FoundModel):
        return found.mask if mask_source(env) is None else None
    # A subclass may have masks of its own.
    base: Any = core
    kind: Any = type(core)
    if isinstance(base, GridWorld) and not base.is_stationary:
        return None
    own = GridWorld.action_masks, MaskedFiniteEnv.action_masks
    if isinstance(base, MaskedFiniteEnv) and kind.action_masks in own:
        return base.masks_of_states()
    if isinstance(base, TaxiEnv) and kind.action_mask is TaxiEnv.action_mask:
        return np.array([base.action_mask(state) for state in sorted(base.P)], dtype=np.bool_)
    return None


def layers(env: Env) -> tuple[Env, list[Wrapper]]:
    """The environment without its wrappers, and the wrappers, the innermost first."""
    wrappers = []
    while isinstance(env, gym.Wrapper):
        wrappers.append(env)
        env = env.env
    return env, wrappers[::-1]


def core_of(env: Env) -> tuple[Env, list[Wrapper]]:
    """The environment up to its outermost unknown wrapper; and those around, innermost first."""
    base, wrappers = layers(env)
    unknown = [place for place, wrapper in enumerate(wrappers, 1) if not folds(wrapper)]
    n_inside = max(unknown, default=0)
    return wrappers[n_inside - 1] if n_inside else base, wrappers[n_inside:]


def folds(wrapper: Wrapper) -> bool:
    """Whether a wrapper keeps the states, and changes rewards at most in a known way."""
    if type(wrapper) is TerminationReward:
        return not wrapper.on_truncation
    if type(wrapper) is FlattenToDiscrete:
        return not wrapper.changes_actions
    if type(wrapper) is ClipReward:  # as it was made, with the same bounds for all rewards
        is_own = getattr(wrapper.func, "__qualname__", "").startswith("ClipReward.__init__.")
        return is_own and all(np.ndim(bound) == 0 for bound in wrapper._saved_kwargs.values())
    if type(wrapper) in {ScaleReward, ActionMasks, IdleActionMasks, *OBSERVATION_WRAPPERS}:
        return True
    return f"{type(wrapper).__module__}.{type(wrapper).__qualname__}" in TRANSPARENT_WRAPPERS


def _believed(core: Env) -> PublishedModel | FoundModel | None:
    """What is known of an environment's dynamics, if it stands the test."""
    known, check = _judged(core)
    is_refused = check is not None and check.refusal is not None
    return None if isinstance(known, NotFound) or is_refused else known


@contextmanager
def one_look(env: Env) -> Iterator[None]:
    """Cache the model of ``env``, which must not change within the ``with`` statement."""
    core = core_of(env)[0]
    _looked_at[id(core)] = _judged(core)
    try:
        yield
    finally:
        _looked_at.pop(id(core), None)


def _judged(core: Env) -> Judgement:
    """What is known of an environment's dynamics, and the result of its test."""
    if id(core) in _looked_at:
        return _looked_at[id(core)]
    if isinstance(core, gym.Wrapper):
        return found_models.found(core), None
    try:
        known = published_model(core)
    except ValueError as error:
        return None, ModelCheck(str(error))
    if known is None:
        return found_models.found(core), None
    if not is_trusted(core):
        return known, checked(known)
    # Blackjack draws cards, and random rewards have only their means in the model.
    draws = isinstance(core, FiniteEnv) and known.model.reward_variance is not None
    plays = not draws and not isinstance(core, BlackjackEnv)
    return known, ModelCheck(None, bit_for_bit=plays, state_can_be_set=plays)
