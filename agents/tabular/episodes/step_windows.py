"""The last n steps of each environment, and learning from them together.

Source: Sutton and Barto (2nd edition), chapter 7.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.common.setting_checks import check_whole, settings_of
from agents.compiled.dispatch import CompiledOnlyError, by_type
from agents.compiled.learning_algorithm import StepSize
from agents.tabular.episodes.learning_in_turn import MOST_STEPS, NOTHING_LEARNT, EpisodicAlgorithm
from agents.tabular.temporal_difference import TabularAgent, move_towards, value_ahead
from machine_code.compiling import inlined
from mdp.array_types import Floats, Ints


class Windows(NamedTuple):
    """Steps that have not been learnt from yet, a ring for each environment.

    Attributes:
        states: shape (n_envs, n_steps).
        actions: what was done there, shape (n_envs, n_steps).
        rewards: what that earned, shape (n_envs, n_steps).
        oldest: place of the first step in the ring, shape (n_envs,).
        lengths: number of steps in it, shape (n_envs,).
    """

    states: Ints
    actions: Ints
    rewards: Floats
    oldest: Ints
    lengths: Ints


@by_type
def backed_up(agent: TabularAgent, progress: Any, obs: int, action: int, later: float) -> float:
    """What a state within the window is worth, if the return after its action is ``later``."""
    raise CompiledOnlyError


@inlined
def windowed_return(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """The return of the oldest step in the window, from the newest backwards."""
    windows, n_places = agent.memory, agent.memory.states.shape[1]
    later = 0.0 if env.terminated else value_ahead(agent, env, progress, 0)
    after = windows.lengths[i] - 1
    for k in range(after, -1, -1):
        place = (windows.oldest[i] + k) % n_places
        if k < after:
            next_place = (place + 1) % n_places
            state, action = windows.states[i, next_place], windows.actions[i, next_place]
            later = backed_up(agent, progress, state, action, later)
        later = windows.rewards[i, place] + agent.settings.gamma * later
    return float(later)


@inlined
def learn_oldest(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Learn from the oldest step in the window and drop it; returns its absolute error."""
    windows, place = agent.memory, agent.memory.oldest[i]
    target = windowed_return(agent, env, progress, i)
    state, action = windows.states[i, place], windows.actions[i, place]
    error = move_towards(agent, progress, 0, state, action, target)
    env.target, env.td_error = target, error
    windows.oldest[i] = (place + 1) % windows.states.shape[1]
    windows.lengths[i] -= 1
    return abs(error)


@inlined
def learn_from_window(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Learn from the step n steps ago, and at the end of an episode from all that are left."""
    windows, n_places = agent.memory, agent.memory.states.shape[1]
    place = (windows.oldest[i] + windows.lengths[i]) % n_places
    windows.states[i, place] = env.obs
    windows.actions[i, place] = env.action
    windows.rewards[i, place] = env.reward
    windows.lengths[i] += 1
    if not env.done and windows.lengths[i] < n_places:
        return NOTHING_LEARNT
    error, n_learnt = learn_oldest(agent, env, progress, i), 1
    while env.done and windows.lengths[i] > 0:
        error += learn_oldest(agent, env, progress, i)
        n_learnt += 1
        env.target = env.td_error = math.nan  # there is more than one
    return error / n_learnt


class WindowAlgorithm(EpisodicAlgorithm):
    """Learns from the rewards of ``n_steps`` steps and from the value of what comes after them.

    Where an episode is truncated, the value of the state that it was cut off in counts.

    Args:
        policy: as in `TabularAlgorithm`.
        env: as in `TabularAlgorithm`.
        learning_rate: as in `TabularAlgorithm`.
        n_steps: how many rewards a target has, at least 1.
        kwargs: as in `TabularAlgorithm`.
    """

    learn_in = learn_from_window

    def __init__(
        self,
        policy: str | type[BasePolicy] = "QTablePolicy",
        env: GymEnv | str | None = None,
        learning_rate: StepSize = 0.1,
        n_steps: int = 4,
        **kwargs: Any,
    ) -> None:
        self.n_steps = n_steps
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_whole(1, settings_of(self, "n_steps"), MOST_STEPS // self.n_envs)

    def _make_memory(self) -> Windows:
        shape = (self.n_envs, self.n_steps)
        states, actions = (np.zeros(shape, dtype=np.int64) for _ in range(2))
        oldest, lengths = (np.zeros(self.n_envs, dtype=np.int64) for _ in range(2))
        return Windows(states, actions, np.zeros(shape), oldest, lengths)
