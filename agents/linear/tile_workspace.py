"""What compiled functions work on while the interpreted loop steps the environments."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from agents.common.online import Transitions
from agents.compiled.training_records import PROGRESS, UNDECIDED, env_dtype
from agents.linear.tile_settings import vectors_of
from agents.linear.weighted_tiles import HandedVectors, LinearAgent, act_in_all, learn_from_all
from mdp.array_types import Ints

NUMBERED_ENV = env_dtype(("number", np.int64))


class TileWorkspace:
    """Records of n environments, of how far the training is, and of the agent.

    Args:
        agent: whose weights are worked on in place.
        space: what it observes.
        n: number of environments, or of observations.
    """

    def __init__(self, agent: LinearAgent, space: spaces.Space[Any], n: int) -> None:
        self.space = space
        self.envs = np.zeros(n, dtype=NUMBERED_ENV)
        self.envs["number"] = np.arange(n)
        self.envs["next_action"] = UNDECIDED
        self.progress = np.zeros(1, dtype=PROGRESS)
        # Looked up once: finding a field takes longer than filling it.
        names = ("exploration", "learning_rate", "mean_td_error")
        self._exploration, self._learning_rate, self._mean_td_error = (
            self.progress[name] for name in names
        )
        self.fields = {name: self.envs[name] for name in NUMBERED_ENV.names or ()}
        n_dims = len(agent.room.vector)
        self.seen = HandedVectors(np.zeros((n, n_dims)), np.zeros((n, n_dims)))
        self.agent = agent._replace(seen=self.seen)

    def note_progress(self, exploration: float, learning_rate: float, mean_td_error: float) -> None:
        """Set how much to explore, the step size, and what the error was last."""
        self._exploration[0] = exploration
        self._learning_rate[0] = learning_rate
        self._mean_td_error[0] = mean_td_error

    @property
    def next_actions(self) -> Ints:
        """What the agent has committed to in each environment, or `UNDECIDED`; shape (n,)."""
        actions: Ints = self.fields["next_action"]
        return actions

    def act(self, observations: NDArray[Any]) -> Ints:
        """An action for each observation, the one that was committed to where there is one."""
        self.seen.before[:] = vectors_of(self.space, observations)
        act_in_all(self.agent, self.envs, self.progress[0])
        actions: Ints = self.fields["action"].copy()
        return actions

    def learn(self, transitions: Transitions) -> float:
        """Learn from a step of each environment, and return the mean absolute error."""
        fields = self.fields
        self.seen.before[:] = vectors_of(self.space, transitions.obs)
        self.seen.after[:] = vectors_of(self.space, transitions.next_obs)
        fields["action"][:] = transitions.actions
        fields["reward"][:] = transitions.rewards
        fields["terminated"][:] = transitions.terminated
        fields["done"][:] = transitions.dones
        learn_from_all(self.agent, self.envs, self.progress[0])
        return float(self._mean_td_error[0])
