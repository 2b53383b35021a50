"""Tiny worlds whose values are known exactly, which the probes of `diagnosis.audit` train on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from rl_yardstick.mdp.transition_model import Floats

SpaceKind = Literal["discrete", "box"]  # of observations, or of actions

N_ACTIONS = 2


@dataclass(frozen=True)
class World:
    """A chain of states 0, 1, ...: actions change the rewards, and not the next state.

    There is one more observation than states: that of the end, where no action is taken.
    """

    pays: tuple[tuple[float, float], ...]  # reward of each state and action
    ends: bool = True  # the last state ends the episode; else it leads to itself
    cut: int = 0  # steps after which an episode is truncated, 0 for never
    end_shows: int | None = None  # state whose observation the end has; None for one of its own
    quits: float = 0.0  # probability that the first state ends the episode, with a reward of 0
    noise: float = 0.0  # added to or subtracted from each reward, with equal probability
    pays_after: int = 0  # number of first steps of training that have a reward of 0

    @property
    def n_states(self) -> int:
        """The number of states in which actions are taken."""
        return len(self.pays)

    def following(self, state: int) -> tuple[int, bool]:
        """The observation that follows a state, and whether the episode has terminated."""
        if state < self.n_states - 1:
            return state + 1, False
        if not self.ends:
            return state, False
        return self.n_states if self.end_shows is None else self.end_shows, True


@dataclass
class Record:
    """States and actions of a training in a world, over all copies of its environment."""

    n_states: int
    states: list[int] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)

    def clear(self) -> None:
        """Forget all."""
        self.states.clear()
        self.actions.clear()

    def counts(self) -> NDArray[np.int64]:
        """How often each action was taken in each state, shape (S, 2)."""
        counts = np.zeros((self.n_states, N_ACTIONS), np.int64)
        np.add.at(counts, (self.states, self.actions), 1)
        return counts


class ProbeEnv(gym.Env[Any, Any]):
    """A `World` as a Gymnasium environment.

    Observations are state indices or one-hot vectors; actions are 0 and 1, or a number in [-1, 1]
    that counts as 1 above zero.
    """

    def __init__(
        self, world: World, record: Record, observations: SpaceKind, actions: SpaceKind
    ) -> None:
        self.world, self.record = world, record
        self.n_observations = world.n_states + 1
        self.is_discrete = observations == "discrete"
        n, numbers = self.n_observations, spaces.Box(-1, 1, (1,), np.float32)
        vectors = spaces.Box(0, 1, (n,), np.float32)
        self.observation_space = spaces.Discrete(n) if self.is_discrete else vectors
        self.action_space = spaces.Discrete(N_ACTIONS) if actions == "discrete" else numbers
        self.state = 0

    def observation_of(self, state: int) -> Any:
        """The observation of a state: its index, or a one-hot vector."""
        if self.is_discrete:
            return state
        vector: NDArray[np.float32] = np.eye(self.n_observations, dtype=np.float32)[state]
        return vector

    def action_masks(self) -> NDArray[np.bool_]:
        """All actions are allowed: for agents that use masks."""
        return np.ones(N_ACTIONS, np.bool_)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin in state 0."""
        super().reset(seed=seed)
        self.state = 0
        return self.observation_of(0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Go to the next state, and record the step."""
        action = action_number(action, self.action_space)
        reward = self.world.pays[self.state][action]
        following, terminated = self.world.following(self.state)
        if self.state == 0 and self.world.quits and self.np_random.random() < self.world.quits:
            reward, following, terminated = 0.0, self.world.n_states, True
        if self.world.noise:
            reward += self.world.noise * (1 if self.np_random.random() < 0.5 else -1)
        if len(self.record.actions) < self.world.pays_after:
            reward = 0.0
        self.record.states.append(self.state)
        self.record.actions.append(action)
        self.state = following
        return self.observation_of(following), reward, terminated, False, {}


class ModelledProbeEnv(ProbeEnv):
    """A `ProbeEnv` with its model as in Gymnasium's toy_text, so that training can be compiled."""

    @property
    def initial_state_distrib(self) -> Floats:
        """All episodes begin in state 0."""
        return np.asarray(np.eye(self.n_observations)[0])

    @property
    def P(self) -> dict[int, dict[int, list[Any]]]:  # noqa: N802 (Gymnasium's name)
        """Lists of (probability, next observation, reward, terminated)."""
        n = self.world.n_states
        outcomes = {n: {action: [(1.0, n, 0.0, True)] for action in range(N_ACTIONS)}}
        for state, pays in enumerate(self.world.pays):
            following, terminated = self.world.following(state)
            quits = self.world.quits if state == 0 else 0.0
            early = [(quits, n, 0.0, True)] if quits else []
            outcomes[state] = {
                action: [(1 - quits, following, pay, terminated), *early]
                for action, pay in enumerate(pays)
            }
        return outcomes


def action_number(action: Any, space: spaces.Space[Any]) -> int:
    """0 or 1: the action itself, or which half of [-1, 1] it lies in."""
    number = np.asarray(action).reshape(-1)[0]
    return int(number) if isinstance(space, spaces.Discrete) else int(number > 0)


def make_env(
    world: World, record: Record, observations: SpaceKind, actions: SpaceKind
) -> gym.Env[Any, Any]:
    """An environment of this world; its steps are appended to the record."""
    is_modelled = observations == actions == "discrete" and not (world.noise or world.pays_after)
    kind = ModelledProbeEnv if is_modelled else ProbeEnv
    env: gym.Env[Any, Any] = kind(world, record, observations, actions)
    return TimeLimit(env, world.cut) if world.cut else env


CHAIN = World(((0, 0), (1, 1)))
SAFE_FORK = World(((0, 0), (1, 0)))
ARM_0 = World(((1, 0),))
