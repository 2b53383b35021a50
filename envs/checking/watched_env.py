"""A copy of an environment whose every step is held against the model that it claims to have."""

from __future__ import annotations

import operator
from array import array
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding

from envs.checking.claimed_models import Claim
from mdp.array_types import Ints
from mdp.outcome_classes import Observed, OutcomeClasses

Env = gym.Env[Any, Any]

SEED = 0


class DisagreementError(Exception):
    """An environment did what its model rules out; the message is one line."""


class Steps(NamedTuple):
    """Steps as they are written down; all arrays have shape (n,).

    Attributes:
        row: ``state * A + action``.
        outcome: its class in `OutcomeClasses`.
        time: steps of the episode before it.
        before: the place of the last outcome, counted from 1; 0 at the beginning of an episode.
        action_before: the last action, counted likewise.
        draw: how many uniform numbers had been drawn, if one is for each step and each start.
    """

    row: Ints
    outcome: Ints
    time: Ints
    before: Ints
    action_before: Ints
    draw: Ints


class WatchedEnv:
    """Steps an environment and writes down what it does.

    After an error it is where nobody knows: `reset` it.

    Args:
        env: the environment; it is used up.
        claim: its model.

    Attributes:
        state: where it is.
        over: whether the episode has ended.
        time: steps since it began.
        starts: where episodes began, and the number of draws before that.
    """

    def __init__(self, env: Env, claim: Claim) -> None:
        self.env: Any = env
        self.claim = claim
        self.classes = OutcomeClasses(claim.model)
        self._log, self._rewards = array("q"), array("d")
        self.starts: list[tuple[int, int]] = []
        self.state, self.time, self.over = 0, 0, True
        self._place = self.classes.place.tolist()
        self._initial = claim.model.initial.tolist()
        self._n_actions = claim.model.n_actions
        self._draws = self._before = self._action_before = 0

    def reset(self) -> None:
        """Begin an episode.

        Raises:
            DisagreementError: if it begins where the model rules it out.
        """
        try:
            # Seeded once, as trainings are: what comes later follows from it.
            obs, _ = self.env.reset(seed=None if self.starts else SEED)
        except Exception as error:
            raise DisagreementError(f"reset raised {_error_text(error)}") from error
        self.state = self._state_of(obs, None)
        if self._initial[self.state] <= 0:
            raise DisagreementError(
                f"reset gave state {self.state}, "
                "where initial_state_distrib says that no episode begins"
            )
        self.starts.append((self.state, self._draws))
        self._draws += 1
        self.time = self._before = self._action_before = 0
        self.over = False

    def step(self, action: int) -> None:
        """Take a step and write it down.

        Raises:
            DisagreementError: if the model rules out what comes of it.
        """
        row = self.state * self._n_actions + action
        note = (self.time, self._before, self._action_before, self._draws)
        seen, reward = self._act(row)
        outcome = self.classes.ids.get(seen)
        if outcome is None:
            raise DisagreementError(f"{self._where(row)}: {self._difference(seen)}")
        self._log.extend((row, outcome, *note))
        self._rewards.append(reward)
        self.time += 1
        self._before = self._place[outcome] + 1
        self._action_before = action + 1

    @property
    def steps(self) -> Steps:
        """All steps but those of `try_action`."""
        return Steps(*np.array(self._log).reshape(-1, len(Steps._fields)).T)

    def put(self, state: int) -> bool:
        """Put the environment into a state, if it lets its attribute ``s`` be set."""
        try:
            self.env.s = state
        except Exception:  # noqa: BLE001  # a setter may refuse in any way
            return False
        self.state = state
        return self.states_agree

    def try_action(self, action: int) -> Observed | None:
        """Act without holding what comes of it against the model; None if that cannot be done."""
        try:
            return self._act(self.state * self._n_actions + action)[0]
        except DisagreementError:
            return None

    @property
    def states_agree(self) -> bool:
        """Whether the environment's attribute ``s`` is where it is."""
        try:
            return operator.index(self.env.s) == self.state
        except (AttributeError, TypeError):
            return False

    def draws_as_toy_text(self) -> bool:
        """Whether all that was seen is what toy_text makes of the generator's uniform numbers.

        Of one for each start and each step, by `OutcomeClasses.predicted`.
        """
        generator, _ = seeding.np_random(SEED)
        uniforms = generator.random(self._draws)
        steps = self.steps
        predicted, rewards = self.classes.predicted(steps.row, uniforms[steps.draw])
        starts = np.array(self.starts)
        cumulative = np.cumsum(self.claim.model.initial)
        first = [np.argmax(cumulative > uniform) for uniform in uniforms[starts[:, 1]]]
        return (
            np.array_equal(predicted, steps.outcome)
            and np.array_equal(rewards, np.array(self._rewards))
            and np.array_equal(first, starts[:, 0])
        )

    def _act(self, row: int) -> tuple[Observed, float]:
        try:
            obs, reward, terminated, truncated, _ = self.env.step(row % self._n_actions)
            reward, self.over = float(reward), bool(terminated)
        except Exception as error:
            text = f"{self._where(row)}: step raised {_error_text(error)}"
            raise DisagreementError(text) from error
        self._draws += 1
        self.state = self._state_of(obs, row)
        if truncated:
            raise DisagreementError(
                f"{self._where(row)}: step gave truncated, which no model holds: "
                "leave time limits to max_episode_steps"
            )
        return (row, self.state, float(np.float32(reward)), self.over), reward

    def _state_of(self, obs: Any, row: int | None) -> int:
        """Where the environment is after a row, or a start, by what is observed."""
        by_obs = self.claim.observes_states
        found: Any = obs if by_obs else getattr(self.env, "s", None)
        try:
            state = operator.index(found)
        except TypeError:
            what = "observation" if by_obs else "attribute s"
            text = f"{self._where(row)}: the {what} is {found!r}, not the number of a state"
            raise DisagreementError(" ".join(text.split())) from None
        if not 0 <= state < len(self._initial):
            text = f"P has states 0 to {len(self._initial) - 1}, this led to {state}"
            raise DisagreementError(f"{self._where(row)}: {text}")
        expected = self.claim.observations
        if not (by_obs or expected is None or np.array_equal(expected[state], obs)):
            text = f"{self._where(row)}: state {state} was observed as {obs}, not {expected[state]}"
            raise DisagreementError(" ".join(text.split()))
        return state

    def _where(self, row: int | None) -> str:
        return "reset" if row is None else row_text(row, self._n_actions)

    def _difference(self, seen: Observed) -> str:
        classes = self.classes
        here = [key for key in classes.ids if key[0] == seen[0]]
        said = " or ".join(map(outcome_text, here[:3]))
        more = f" or {len(here) - 3} others" if len(here) > 3 else ""
        return f"P says {said}{more}, step gave {outcome_text(seen)}"


def outcome_text(seen: Observed) -> str:
    """An outcome in words."""
    _, state, reward, terminated = seen
    # The shortest number that is the same in single precision.
    return f"state {state} with reward {np.float32(reward)}{', terminated' if terminated else ''}"


def row_text(row: int, n_actions: int) -> str:
    """A state and an action in words."""
    state, action = divmod(row, n_actions)
    return f"state {state}, action {action}"


def _error_text(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
