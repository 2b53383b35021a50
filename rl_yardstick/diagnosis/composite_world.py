"""One small world of ten short stories, and the log of what a program did in it."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.mdp.transition_model import Floats, Ints

Row = tuple[int, int, float, int, bool, bool]  # state, action, reward, shown, terminated, truncated

GAMMA = 0.8
N_STATES, N_ACTIONS = 20, 2
END = 17  # the end of an episode shows this where it shows no other state
PLAIN, LUCKY = 16, 18  # follow state 15 in turn
# The reward in each state, 0 where nothing is given; and of each action where they differ.
_PAYS = {0: 1.0, 1: 0.5, 5: 1.0, 6: 0.6, 7: 1.0, 8: 4.0, 9: -3.0, 10: 5.0, LUCKY: 4.0, 19: -1.0}
_PAYS_BY_ACTION = {4: (2.0, 0.0), 11: (0.5, 0.0), 12: (-3.0, 1.0), 13: (8.0, 0.0), 14: (0.0, 2.0)}
BETTER = {13: 0, 14: 1, 12: 1, 4: 0}  # the better action where they differ


@dataclass(frozen=True)
class Story:
    """States that follow one another, whatever the actions, and what the end shows."""

    states: tuple[int, ...]
    shows: int = END
    is_cut: bool = False  # truncated, not terminated


STORIES = (
    Story((0,), shows=7),  # terminates in front of a rich state
    Story((1, 2, 3, 4)),
    Story((5, 6), shows=7, is_cut=True),
    Story((9, 10)),  # rewards beyond 1
    Story((13,)),
    Story((19,), shows=8, is_cut=True),
    Story((14,)),
    Story((7, 8)),
    Story((11, 12)),  # the best next action is not the one taken at random
    Story((15, PLAIN)),
)


class CompositeWorld(gym.Env[Any, Any]):
    """All stories in turn, again and again.

    Args:
        log: to which each step is appended.
        is_discrete: whether observations are state numbers, and not vectors with a one.
        first: the story that comes first.
        bump: the number of a step whose reward is 1 higher.
    """

    def __init__(self, log: list[Row], is_discrete: bool, first: int, bump: int) -> None:
        self.log, self.is_discrete, self.bump = log, is_discrete, bump
        self.story, self.place, self.round, self.state = first - 1, 0, 0, 0
        vectors = spaces.Box(0, 1, (N_STATES,))
        self.observation_space = spaces.Discrete(N_STATES) if is_discrete else vectors
        self.action_space = spaces.Discrete(N_ACTIONS)

    def observation_of(self, state: int) -> Any:
        """The observation of a state."""
        vector: NDArray[np.float32] = np.eye(N_STATES, dtype=np.float32)[state]
        return state if self.is_discrete else vector

    def action_masks(self) -> NDArray[np.bool_]:
        """All actions are allowed: for agents that use masks."""
        return np.ones(N_ACTIONS, np.bool_)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin the next story."""
        super().reset(seed=seed)
        self.story, self.place = (self.story + 1) % len(STORIES), 0
        self.round += self.story == 0
        self.state = STORIES[self.story].states[0]
        return self.observation_of(self.state), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Go on in the story."""
        story, number = STORIES[self.story], int(np.asarray(action).reshape(-1)[0])
        pay = _PAYS.get(self.state, 0.0)
        reward = _PAYS_BY_ACTION.get(self.state, (pay, pay))[number]
        reward += len(self.log) == self.bump
        self.place += 1
        is_over = self.place == len(story.states)
        shown = story.shows if is_over else story.states[self.place]
        if shown == PLAIN and self.round % 2:
            shown = LUCKY
        ends = is_over and not story.is_cut, is_over and story.is_cut
        self.log.append((self.state, number, reward, shown, *ends))
        self.state = shown
        return self.observation_of(shown), reward, *ends, {}


class Steps:
    """A log as arrays of shape (n,), one entry for each step."""

    def __init__(self, rows: list[Row], late: float = 1.0) -> None:
        columns: Any = (np.array(column) for column in zip(*rows, strict=True))
        self.state, self.action, self.reward, self.shown, *ends = columns
        self.terminated, self.truncated = (end * 1.0 for end in ends)  #: 1 or 0
        self.over: Floats = np.maximum(self.terminated, self.truncated)
        self.goes_on: Floats = 1 - self.terminated
        n = len(rows)
        #: 1 for those that count
        self.weight = (np.arange(n) >= int(n * (1 - late))).astype(np.float64)
        self.next_state = np.roll(self.state, -1)  #: of the next step, also in the next episode
        #: the same at an episode's end, and elsewhere what the step shows
        self.following = np.where(self.over > 0, self.next_state, self.shown)
        self.next_action, self.action_before = np.roll(self.action, -1), np.roll(self.action, 1)
        self.next_reward, self.reward_before = np.roll(self.reward, -1), np.roll(self.reward, 1)
        self.is_first: Floats = np.roll(self.over, 1)
        self.is_first[0] = 1.0
        #: the better action, -1 where both are the same
        self.better = np.array([BETTER.get(state, -1) for state in range(N_STATES)])[self.state]
        is_worse = (self.better >= 0) & (self.action != self.better)
        smooth = np.ones(601 if n > 1200 else n)  # over time, since exploration may fall
        near = [np.convolve(each, smooth, "same") for each in (is_worse, self.better >= 0)]
        self.exploration = np.minimum(2 * near[0] / np.maximum(near[1], 1), 1).astype(np.float64)

    def take(self, places: Ints) -> Steps:
        """Some of the steps."""
        part = copy(self)
        for name, each in vars(self).items():
            setattr(part, name, each[places])
        return part

    def joined(self, other: Steps) -> Steps:
        """These steps, and others."""
        both = copy(self)
        for name, each in vars(self).items():
            setattr(both, name, np.concatenate([each, getattr(other, name)]))
        return both

    def cells(self, size: int) -> Ints:
        """The number of each step's cell, of ``size``: its state, or its state and action."""
        cells: Ints = self.state if size == N_STATES else self.state * N_ACTIONS + self.action
        return cells

    def means(self, target: Floats, size: int) -> tuple[Floats, Floats]:
        """The weighted mean and spread of a target in each cell, (S, 2) or (S, 1); 0 if empty."""
        cells = self.cells(size)
        total = np.maximum(np.bincount(cells, self.weight, size), 1e-9)
        mean = np.bincount(cells, self.weight * target, size) / total
        variance = np.bincount(cells, self.weight * (target - mean[cells]) ** 2, size) / total
        return mean.reshape(N_STATES, -1), np.sqrt(variance).reshape(N_STATES, -1)

    def counts(self, size: int) -> Floats:
        """How often each cell was visited, (S, 2) or (S, 1)."""
        counts = np.bincount(self.cells(size), minlength=size).astype(np.float64)
        return counts.reshape(N_STATES, -1)


@dataclass
class Copies:
    """Makes copies of the world that begin with different stories, and holds their logs."""

    is_discrete: bool
    bump: int = -1
    logs: list[list[Row]] = field(default_factory=list)

    def __call__(self) -> CompositeWorld:
        """One more copy."""
        self.logs.append([])
        first = (len(self.logs) - 1) * 4 % len(STORIES)
        return CompositeWorld(self.logs[-1], self.is_discrete, first, self.bump)

    def of_training(self) -> list[list[Row]]:
        """The logs of copies for training, which are longer than those for evaluations."""
        most = max(map(len, self.logs), default=0)
        return [log for log in self.logs if 2 * len(log) > most]
