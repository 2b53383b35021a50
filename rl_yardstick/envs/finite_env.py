"""Environments that sample from the arrays of their own model, as Gymnasium's toy_text do."""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_right
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces

from rl_yardstick.envs.drawing import ShownEnv
from rl_yardstick.mdp.transition_model import Bools, Floats, TransitionModel

Outcome = tuple[float, int, float, bool]


class FiniteEnv(ShownEnv):
    """An environment with numbered states and actions, whose steps sample from its model.

    The model is there as arrays, `transition_model`, and as ``P`` and ``initial_state_distrib``.
    A subclass defines the dynamics in `transition_model`, and how a state is rendered. `reset` and
    `step` draw one uniform number each, even where nothing is random, and choose by cumulative sum
    in the order of the arrays. Where the model's rewards have a variance, a step then draws a
    standard normal number. A subclass may sample otherwise, see `_draw`, with the same
    probabilities, means and variances.

    Args:
        n_states: observations are the states, `Discrete(n_states)`, unless a subclass says
            otherwise by `observation_of` and a space of its own.
        n_actions: actions are `Discrete(n_actions)`.
        render_mode: see `ShownEnv`.

    Attributes:
        s: the state; may be set to continue from another one.
        last_action: the latest action, None before the first.
    """

    def __init__(self, n_states: int, n_actions: int, render_mode: str | None) -> None:
        super().__init__(render_mode)
        self.observation_space = spaces.Discrete(n_states)
        self.action_space = spaces.Discrete(n_actions)
        self.n_actions = n_actions
        self.s = 0
        self.last_action: int | None = None

    @abstractmethod
    def transition_model(self) -> TransitionModel:
        """The exact dynamics as arrays.

        Called at each step: a subclass returns a model that is cached outside of the environment,
        so that copies and saved states do not contain it.
        """

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; ``options`` are not used."""
        super().reset(seed=seed)
        self.s = self._draw_start()
        self.last_action = None
        if self.render_mode == "human":
            self.render()
        return self._observe(), self._info()

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take an action; the class describes the results."""
        action = int(action)
        if not 0 <= action < self.n_actions:
            raise ValueError(
                f"action {action} does not exist: they are numbered 0 to {self.n_actions - 1}"
            )
        state, reward, terminated = self._draw(action)
        self.s, self.last_action = state, action
        if self.render_mode == "human":
            self.render()
        return self._observe(), reward, terminated, False, self._info()

    def observation_of(self, states: Any) -> Any:
        """The observations of many states, shape (n,): by default their numbers."""
        return states

    def _observe(self) -> Any:
        return int(self.observation_of(self.s))

    def _info(self) -> dict[str, Any]:
        """What `reset` and `step` give besides, at the end of each."""
        return {}

    def _draw_start(self) -> int:
        return first_above(self.transition_model().initial.cumsum(), self.np_random.random())

    def _draw(self, action: int) -> tuple[int, float, bool]:
        """Sample the outcome: next state, reward, and whether the episode terminates."""
        model = self.transition_model()
        drawn = first_above(model.prob[self.s, action].cumsum(), self.np_random.random())
        outcome = self.s, action, drawn
        reward = float(model.reward[outcome])
        if model.reward_variance is not None and model.reward_variance[outcome] > 0:
            std = float(np.sqrt(model.reward_variance[outcome]))
            reward += std * float(self.np_random.standard_normal())
        return int(model.next_state[outcome]), reward, bool(model.terminated[outcome])

    @property
    def initial_state_distrib(self) -> Floats:
        """Probabilities of the starting states, shape (S,)."""
        return self.transition_model().initial

    @cached_property
    def P(self) -> dict[int, dict[int, list[Outcome]]]:  # noqa: N802 (the name toy_text gave it)
        """The dynamics as Gymnasium's toy_text environments hold them.

        ``P[state][action]`` is a list of (probability, next state, reward, terminated). Built on
        first access. Random rewards are given by their means.
        """
        model = self.transition_model()
        columns = model.prob, model.next_state, model.reward, model.terminated
        states = zip(*(column.tolist() for column in columns), strict=True)
        return {
            state: {
                action: list(zip(*outcomes, strict=True))
                for action, outcomes in enumerate(zip(*actions, strict=True))
            }
            for state, actions in enumerate(states)
        }


class MaskedFiniteEnv(FiniteEnv):
    """A finite environment whose allowed actions depend on the state.

    Other actions have an effect too, which the class describes: agents that know nothing of masks
    may choose them.
    """

    @abstractmethod
    def masks_of_states(self) -> Bools:
        """The allowed actions of each state, bool of shape (S, A), at least one each."""

    def action_masks(self) -> Bools:
        """The allowed actions now, bool of shape (A,): sb3-contrib's convention."""
        mask: Bools = self.masks_of_states()[self.s]
        return mask.copy()


def first_above(cumulative: Sequence[float] | Floats, uniform: float) -> int:
    """The first index whose sum exceeds the number; 0 where rounding leaves none, as toy_text."""
    place = bisect_right(cumulative, uniform)
    return place if place < len(cumulative) else 0


def summing_to_one(probabilities: Floats) -> Floats:
    """Probabilities whose running sum, over the last axis, ends at exactly one.

    Otherwise a uniform number above the sum would choose the first, as `categorical_sample` does.
    The rounding error is added to the last probability that is not zero.
    """
    before = np.zeros_like(probabilities)
    before[..., 1:] = probabilities.cumsum(axis=-1)[..., :-1]
    n = probabilities.shape[-1]
    last = n - 1 - (probabilities[..., ::-1] > 0).argmax(axis=-1)
    is_last = np.arange(n) == last[..., None]
    return np.where(is_last, 1 - before, probabilities)
