"""Wrappers that fit an environment to an agent: masks, rewards, encodings, time limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.toy_text.taxi import TaxiEnv
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike, NDArray

from rl_yardstick.envs.argument_checks import check_flag, check_number, check_whole_number
from rl_yardstick.envs.finite_spaces import MOST_MEMBERS, bijection_of
from rl_yardstick.mdp.transition_model import AnyInts, Bools, Floats, Ints

Env = gym.Env[Any, Any]

# The names of masks in Gymnasium's Taxi (in ``info``) and in sb3-contrib (a method).
INFO_KEY = "action_mask"
METHOD = "action_masks"


def mask_source(env: Env) -> Callable[[], Any] | None:
    """A function that returns the mask of the present state, or None where there are no masks.

    That is the method `action_masks` of the environment or of a wrapper around it; for Gymnasium's
    Taxi, which has no such method, its mask of the present state.
    """
    if env.has_wrapper_attr(METHOD):
        method: Callable[[], Any] = env.get_wrapper_attr(METHOD)
        return method
    base = env.unwrapped
    if isinstance(base, TaxiEnv):
        return lambda: base.action_mask(int(base.s))
    return None


def has_masks(env: Env) -> bool:
    """Whether the environment has action masks, in either form; may call its `reset`."""
    return mask_source(env) is not None or INFO_KEY in env.reset()[1]


def action_masks(env: Env) -> Bools | None:
    """The allowed actions now, bool of shape (n_actions,), or None where there are no masks.

    An environment that gives masks by ``info["action_mask"]`` alone needs the wrapper
    `envs.wrappers.ActionMasks`.
    """
    source = mask_source(env)
    return None if source is None else np.asarray(source(), dtype=np.bool_)


class ActionMasks(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Gives action masks in both forms: by `action_masks()` and by ``info["action_mask"]``.

    The first is sb3-contrib's convention and can be called at any time. The second comes with each
    step, so that it also masks the state in which an episode is truncated.

    Args:
        env: an environment with masks in one of the two forms, or Gymnasium's Taxi.

    Raises:
        ValueError: if it has masks in neither.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        self._told: Any = None
        if not has_masks(env):
            name = env.unwrapped if env.spec is None else env.spec.id
            raise ValueError(
                f"{name} has no action masks: neither a method action_masks() nor "
                f"info[{INFO_KEY!r}]"
            )

    def action_masks(self) -> Bools:
        """The allowed actions now, bool of shape (n_actions,)."""
        source = mask_source(self.env)
        return np.asarray(self._told if source is None else source(), dtype=np.bool_)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """As the environment, with the mask in ``info``."""
        obs, info = self.env.reset(**kwargs)
        return obs, self._with_mask(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As the environment, with the mask in ``info`` unless the episode has terminated."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if not terminated:
            info = self._with_mask(info)
        return obs, reward, terminated, truncated, info

    def _with_mask(self, info: dict[str, Any]) -> dict[str, Any]:
        self._told = info.get(INFO_KEY)
        return {**info, INFO_KEY: self.action_masks().astype(np.int8)}


class IdleActionMasks(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Masks actions that change nothing, by the model that the environment holds.

    An action that surely leaves the state as it is, without ending the episode, is masked; in a
    state that no action changes, none is. For FrozenLake and CliffWalking, which have no masks.

    Args:
        env: an environment that holds ``P`` and its state ``s`` as Gymnasium's toy_text does.

    Attributes:
        masks: the masks of all states, bool of shape (S, A).

    Raises:
        ValueError: if it holds no ``P``.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        P = getattr(env.unwrapped, "P", None)  # noqa: N806 (Gymnasium's own name)
        if P is None:
            raise ValueError(f"IdleActionMasks needs an environment that holds P, not {env}")
        self.masks = np.zeros((len(P), len(P[0])), np.bool_)
        for state, action in np.ndindex(self.masks.shape):
            self.masks[state, action] = any(
                prob > 0 and (ends or after != state) for prob, after, _, ends in P[state][action]
            )
        self.masks |= ~self.masks.any(axis=1, keepdims=True)

    def action_masks(self) -> Bools:
        """The allowed actions now, bool of shape (A,)."""
        base: Any = self.env.unwrapped
        return np.array(self.masks[base.s])


class ScaleReward(gym.RewardWrapper[Any, Any], RecordConstructorArgs):
    """Multiplies every reward.

    Args:
        env: any environment.
        scale: the factor.

    Raises:
        ValueError: if the factor is zero or not a finite number.
    """

    def __init__(self, env: gym.Env[Any, Any], scale: float) -> None:
        RecordConstructorArgs.__init__(self, scale=scale)
        gym.RewardWrapper.__init__(self, env)
        self.scale = check_number("scale", scale)
        if self.scale == 0:
            raise ValueError("scale must not be 0: every reward would be the same")

    def reward(self, reward: SupportsFloat) -> float:
        """The scaled reward."""
        return float(reward) * self.scale


class TerminationReward(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Replaces the last reward of an episode.

    Args:
        env: any environment. Truncation by wrappers outside this one, such as a further time limit,
            does not count.
        reward: the reward of the step that terminates the episode.
        on_truncation: replace the reward of a truncated episode as well.

    Raises:
        ValueError: if the reward is not a finite number.
    """

    def __init__(self, env: gym.Env[Any, Any], reward: float, on_truncation: bool = False) -> None:
        RecordConstructorArgs.__init__(self, reward=reward, on_truncation=on_truncation)
        gym.Wrapper.__init__(self, env)
        self.last_reward = check_number("reward", reward)
        self.on_truncation = check_flag("on_truncation", on_truncation)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if terminated or (truncated and self.on_truncation):
            reward = self.last_reward
        return obs, reward, terminated, truncated, info


class WithoutEpisodeInfo(gym.Wrapper[Any, Any, Any, Any]):
    """Leaves out ``info["episode"]`` until an episode ends, where the Monitor within sets it."""

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if not (terminated or truncated):
            info = {key: value for key, value in info.items() if key != "episode"}
        return obs, reward, terminated, truncated, info


class FlattenToDiscrete(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Turns observations and actions of finite spaces into one number each, from 0 on.

    The last number of an observation counts fastest (see `envs.finite_spaces`). Spaces that are not
    finite stay as they are.

    Args:
        env: an environment whose observations or actions are MultiDiscrete, a Tuple or Dict,
            MultiBinary, a Box of whole numbers, or Discrete.
        observations: classes of observations that stay as they are if they count from 0.
        actions: classes of actions, likewise.

    Attributes:
        changes_actions: whether actions have other numbers than in the environment.
        original_spaces: the spaces inside, which only a wrapper made by `numbered` has.

    Raises:
        ValueError: if no space of the environment can be numbered.
    """

    original_spaces: tuple[spaces.Space[Any], spaces.Space[Any]]

    def __init__(
        self,
        env: gym.Env[Any, Any],
        observations: Sequence[str] = ("Discrete",),
        actions: Sequence[str] = ("Discrete",),
    ) -> None:
        RecordConstructorArgs.__init__(self, observations=observations, actions=actions)
        gym.ObservationWrapper.__init__(self, env)
        observed: Any = env.observation_space
        self._seen = bijection_of(observed, observations)
        self._done = bijection_of(env.action_space, actions)
        stays = type(observed).__name__ in observations
        if self._seen is None and self._done is None and not stays:
            raise ValueError(
                "FlattenToDiscrete needs MultiDiscrete, a Tuple or Dict, MultiBinary, Discrete or "
                f"a Box of whole numbers, of at most {MOST_MEMBERS:,} members, not {observed}"
            )
        if self._seen is not None:
            self.observation_space = self._seen.numbers_space
        if self._done is not None:
            self.action_space = self._done.numbers_space
        self.changes_actions = self._done is not None

    def observation(self, observation: Any) -> Any:
        """The number of one observation."""
        return observation if self._seen is None else self._seen.number(observation)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """As the environment, with the action of a number."""
        return super().step(action if self._done is None else self._done.member(int(action)))

    def map_observations(self, batch: Any) -> Any:
        """The numbers of many observations, shape (n,).

        Args:
            batch: whole numbers, the first axis counting the observations; for a Tuple, its parts
                side by side in shape (n, parts).
        """
        return np.asarray(batch) if self._seen is None else self._seen.numbers(batch)


def numbered(env: Env, observations: Sequence[str], actions: Sequence[str]) -> Env:
    """The environment in `FlattenToDiscrete`, where this changes a space, for an agent on tables.

    The agent's file keeps the spaces inside, and its `predict` takes observations of these.
    """
    inside = env.observation_space, env.action_space
    if bijection_of(inside[0], observations) is None and bijection_of(inside[1], actions) is None:
        return env
    wrapped = FlattenToDiscrete(env, observations, actions)
    wrapped.original_spaces = inside
    return wrapped


class OneHotObservation(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Turns a number into a vector that is 1 at its place and 0 elsewhere.

    Args:
        env: an environment whose observations are Discrete.

    Raises:
        ValueError: if they are not.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        space: Any = env.observation_space
        if not isinstance(space, spaces.Discrete):
            raise ValueError(f"OneHotObservation needs Discrete observations, not {space}")
        self._first = int(space.start)
        self._n = int(space.n)
        self.observation_space = spaces.Box(0, 1, (self._n,), np.float32)

    def observation(self, observation: int) -> NDArray[np.float32]:
        """The vector of one number."""
        return self.map_observations(np.array([observation])).ravel()

    def map_observations(self, batch: AnyInts) -> NDArray[np.float32]:
        """The vectors of many numbers of shape (n,), shape (n, number of values)."""
        hot = np.zeros((len(batch), self._n), np.float32)
        hot[np.arange(len(batch)), np.asarray(batch) - self._first] = 1
        return hot


class DiscretizeObservation(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Turns a vector into one number by cutting each of its dimensions into bins of equal width.

    The bin of a value is ``floor((value - low) / (high - low) * bins)``, computed in float64 and
    clipped to the first and the last bin. The observation is the index of the box that the vector
    lies in, the last dimension counting fastest.

    Args:
        env: an environment whose observations are a Box of one axis.
        bins: number of bins, one for all dimensions or one for each that counts.
        low: where the first bin begins, likewise; by default the bounds of the space.
        high: where the last bin ends, likewise.
        dims: indices of the dimensions that count; by default all.

    Raises:
        ValueError: if the observations are not such a Box, a dimension does not exist, the numbers
            of arguments disagree, there are no bins, or bounds are infinite or out of order.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        bins: int | Sequence[int],
        low: float | Sequence[float] | None = None,
        high: float | Sequence[float] | None = None,
        dims: Sequence[int] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, bins=bins, low=low, high=high, dims=dims)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"DiscretizeObservation needs a Box of one axis, not {space}")
        n = space.shape[0]
        chosen = range(n) if dims is None else dims
        self.dims = [check_whole_number("dims", dim, 0, n - 1) for dim in chosen]
        counts = _per_dim("bins", bins, self.dims)
        self.bins = counts.astype(np.int64)
        if np.any(self.bins != counts) or np.any(self.bins < 1):
            raise ValueError(f"bins must be whole numbers from 1 on, not {bins}")
        self.low = _per_dim("low", space.low[self.dims] if low is None else low, self.dims)
        self.high = _per_dim("high", space.high[self.dims] if high is None else high, self.dims)
        ordered = np.isfinite(self.low) & np.isfinite(self.high) & (self.low < self.high)
        if not ordered.all():
            dim = int(np.argmin(ordered))
            raise ValueError(
                f"dimension {self.dims[dim]} of the observation has the bounds {self.low[dim]} and "
                f"{self.high[dim]}: give finite low and high, low below high, or choose other dims"
            )
        self.observation_space = spaces.Discrete(math.prod(self.bins.tolist()))
        self._cuts = list(
            zip(self.dims, *(a.tolist() for a in (self.low, self.high, self.bins)), strict=True)
        )

    def observation(self, observation: NDArray[Any]) -> int:
        """The index of the box that one vector lies in."""
        index = 0
        for dim, low, high, bins in self._cuts:
            place = (float(observation[dim]) - low) / (high - low) * bins
            index = index * bins + int(min(max(place, 0), bins - 1))
        return index

    def map_observations(self, batch: NDArray[Any]) -> Ints:
        """The indices of many vectors of shape (n, dimensions), shape (n,)."""
        places = (batch[:, self.dims].astype(np.float64) - self.low) / (self.high - self.low)
        places = np.clip(np.floor(places * self.bins), 0, self.bins - 1).astype(np.int64)
        indices: Ints = np.ravel_multi_index(tuple(places.T), tuple(self.bins))
        return indices


def _per_dim(name: str, values: ArrayLike, dims: list[int]) -> Floats:
    """One value for each of the dimensions that count."""
    try:
        return np.broadcast_to(np.asarray(values, np.float64), (len(dims),)).copy()
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must be one number, or one for each of the dimensions {dims}, not {values!r}"
        ) from None


def own_time_limit(
    env: gym.Env[Any, Any], attribute: str, multiple: int, instead_of: int
) -> gym.Env[Any, Any]:
    """Limit the episodes of an environment to a multiple of one of its attributes.

    Args:
        env: the environment as `gymnasium.make` returns it.
        attribute: the name of a number of steps, such as the shortest path of a grid world.
        multiple: how many times as many steps.
        instead_of: the default limit to replace. Another limit, or none, was chosen by the caller
            of `gymnasium.make`, and stays.

    Returns:
        The environment under the limit.
    """
    if not isinstance(env, gym.wrappers.TimeLimit) or env.spec is None:
        return env
    if env.spec.max_episode_steps != instead_of:
        return env
    return gym.wrappers.TimeLimit(env.env, multiple * getattr(env.unwrapped, attribute))
