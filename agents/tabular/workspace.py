"""What compiled functions work on while the interpreted loop steps the environments."""

from __future__ import annotations

from typing import Any

import numpy as np

from agents.common.online import Transitions
from agents.compiled.generators import handles_of
from agents.compiled.training_records import ENV, PROGRESS, UNDECIDED, env_records
from agents.tabular.temporal_difference import TabularAgent, act_in_all, learn_from_all
from mdp.array_types import Bools, Ints


class Workspace:
    """Records of n environments, of how far the training is, and of the agent.

    Args:
        agent: whose settings and tables are worked on in place.
        masks: what the environment allows at each observation, or of no rows for everything.
        rng: its generator, or another one to choose by.
        n: number of environments, or of observations.
    """

    def __init__(self, agent: TabularAgent, masks: Bools, rng: np.random.Generator, n: int) -> None:
        self.rng = rng  # the handle does not keep it alive
        self.envs = env_records(n, ENV)
        self.envs["next_action"] = UNDECIDED
        self.progress = np.zeros(1, dtype=PROGRESS)
        # In the order that `act_in_all` and `learn_from_all` take them in.
        self.arrays = (
            np.array([agent.settings]),
            self.envs,
            self.progress,
            *agent.tables[:2],
            masks,
            *agent.room,
            handles_of([rng]),
            agent.memory,
        )
        # Looked up once: finding a field takes longer than filling it.
        self.fields = {name: self.envs[name] for name in ENV.names or ()}
        names = ("exploration", "learning_rate", "episodes")
        self.exploration, self.learning_rate, self.episodes = (self.progress[n] for n in names)
        self._chosen: Ints | None = None

    @property
    def next_actions(self) -> Ints:
        """What the agent has committed to in each environment, or `UNDECIDED`; shape (n,)."""
        actions: Ints = self.fields["next_action"]
        return actions

    def note_progress(self, exploration: float, learning_rate: float, episodes: int) -> None:
        """Set how much to explore, the step size, and how many episodes have ended."""
        self.exploration[0] = exploration
        self.learning_rate[0] = learning_rate
        self.episodes[0] = episodes

    def _check(self, field: str, outside: int) -> None:
        """Refuse an observation that the tables have no row for, which compiled code would not see.

        Raises:
            ValueError: naming the observation and what it may be.
        """
        if outside >= 0:
            n_states = self.arrays[3].shape[1]
            obs = self.fields[field][outside]
            raise ValueError(f"observation {obs} is not in Discrete({n_states}), the agent's space")

    def act(self, obs: Any) -> Ints:
        """An action for each observation, the one that was committed to where there is one.

        Args:
            obs: observations, shape (n,).
        """
        fields = self.fields
        fields["obs"][:] = obs
        self._check("obs", act_in_all(*self.arrays))
        actions: Ints = fields["action"].copy()
        self._chosen = actions
        return actions

    def learn(self, transitions: Transitions) -> float:
        """Learn from a step of each environment, and return the mean absolute TD error."""
        fields = self.fields
        if transitions.actions is not self._chosen:
            # Not what `act` has just chosen, whose observations and actions are there already.
            fields["obs"][:] = transitions.obs
            fields["action"][:] = transitions.actions
        fields["reward"][:] = transitions.rewards
        fields["terminated"][:] = transitions.terminated
        fields["done"][:] = transitions.dones
        fields["next_obs"][:] = transitions.next_obs
        self._check("next_obs", learn_from_all(*self.arrays))
        return float(self.progress["mean_td_error"][0])
