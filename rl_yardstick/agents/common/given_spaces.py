"""Agents on numbered spaces whose `predict` speaks the spaces of the environment that was given."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from rl_yardstick.envs.finite_spaces import Bijection

Predict = TypeVar("Predict", bound=Callable[..., Any])

# Of observations and of actions; None for a space that is not numbered.
Translation = tuple[Bijection | None, Bijection | None]


def translation(original: Any, own: tuple[spaces.Space[Any], ...]) -> Translation:
    """The bijections from original spaces to an agent's own; ValueError if there are none."""
    if not (isinstance(original, tuple) and len(original) == len(own)):
        raise ValueError(f"the original spaces are not of observations and actions: {original}")
    pairs = [*zip(original, own, strict=True)]
    seen, done = (None if space == numbers else Bijection(space) for space, numbers in pairs)
    if any(b and b.numbers_space != space for b, space in zip((seen, done), own, strict=True)):
        raise ValueError(f"the agent's spaces {own} do not number those of {original}")
    return seen, done


def in_given_spaces(predict: Predict) -> Predict:
    """Let `predict` take observations and return actions of the environment that was given."""

    @wraps(predict)
    def translated(self: Any, observation: Any, *args: Any, **kwargs: Any) -> Any:
        if self.translation is None:
            return predict(self, observation, *args, **kwargs)
        seen, done = self.translation
        if seen is not None:
            read = seen.numbers if seen.is_batch(observation) else seen.number
            observation = np.asarray(read(observation))
        actions, state = predict(self, observation, *args, **kwargs)
        return (actions if done is None else original_actions(done, actions)), state

    return cast(Predict, translated)


def original_actions(done: Bijection, numbers: Any) -> Any:
    """The action of a number; or of several numbers, in the form that `VecEnv.step` takes."""
    if np.ndim(numbers) == 0:
        return done.member(int(numbers))
    if isinstance(done.space, spaces.Dict | spaces.Tuple):
        return [done.member(int(number)) for number in numbers]
    return done.members(numbers)


class OriginalSpaces(VecEnvWrapper):
    """The environments of an agent with their original observations and actions."""

    def __init__(self, venv: VecEnv, original: Any, translated: Translation) -> None:
        super().__init__(venv, *original)
        self.seen, self.done = translated

    def reset(self) -> Any:
        return self._original(self.venv.reset())

    def step_async(self, actions: Any) -> None:
        if self.done is not None:
            actions = np.array([self.done.number(action) for action in actions])
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        numbers, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if self.seen is not None and "terminal_observation" in info:
                info["terminal_observation"] = self.seen.member(info["terminal_observation"])
        return self._original(numbers), rewards, dones, infos

    def _original(self, numbers: Any) -> Any:
        return numbers if self.seen is None else self.seen.members(numbers)
