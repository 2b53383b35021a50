"""The base of agents on tables and on tiles, which learn from records of their environments.

Compiled functions read and write these records. In the interpreted loop a `Workspace` has them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.utils import is_vectorized_observation

from rl_yardstick.agents.common.algorithm import Transitions
from rl_yardstick.agents.compiled.learning_algorithm import LearningAlgorithm
from rl_yardstick.agents.compiled.worlds import ENV, PROGRESS, UNDECIDED, env_records
from rl_yardstick.mdp.transition_model import Ints


class Workspace:
    """Records of n environments and of the training's progress, for the interpreted loop."""

    def __init__(self, n: int, kind: np.dtype[np.void] = ENV) -> None:
        self.envs = env_records(n, kind)
        self.envs["next_action"] = UNDECIDED
        self.progress = np.zeros(1, dtype=PROGRESS)
        # Looked up once, because finding a field takes longer than filling it.
        self.fields = {name: self.envs[name] for name in kind.names or ()}
        # The action committed to in each environment, or `UNDECIDED`, shape (n,).
        self.next_actions: Ints = self.fields["next_action"]
        names = ("exploration", "learning_rate", "episodes", "mean_td_error")
        self.exploration, self.learning_rate, self.episodes, self.mean_td_error = (
            self.progress[name] for name in names
        )

    def note_progress(
        self, exploration: float, learning_rate: float, episodes: int, mean_td_error: float = 0.0
    ) -> None:
        """Set the exploration rate, the step size, the episodes so far, and the last error."""
        self.exploration[0] = exploration
        self.learning_rate[0] = learning_rate
        self.episodes[0] = episodes
        self.mean_td_error[0] = mean_td_error

    def take_outcomes(self, transitions: Transitions) -> None:
        """Write rewards and ends of the environments' step into their records."""
        fields = self.fields
        fields["reward"][:] = transitions.rewards
        fields["terminated"][:] = transitions.terminated
        fields["done"][:] = transitions.dones


class WorkspaceAlgorithm(LearningAlgorithm):
    """Acts and learns in a workspace, interpreted, or on the records of the compiled loop.

    Attributes:
        engine_in_use: the loop of the last training, with the reason if it was not compiled.
        mean_td_error: mean absolute TD error of the last updates.
    """

    _rebuilt = (*LearningAlgorithm._rebuilt, "_next_actions", "_in_use")
    excluded_from_states = ("_in_use",)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.engine_in_use = ""
        self.mean_td_error = 0.0
        self._next_actions: Ints = np.empty(0, dtype=np.int64)
        self._in_use: Any = None  # the workspace of the last learning
        super().__init__(*args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_in_use": None}

    def _begin_episodes(self) -> None:
        self._next_actions = np.full(self.n_envs, UNDECIDED)

    def hand_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Write the agent's state into the records of the compiled loop."""
        envs["next_action"] = self._next_actions
        progress["mean_td_error"] = self.mean_td_error

    def take_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Read the agent's state from the records of the compiled loop."""
        self._next_actions = envs["next_action"].copy()
        self.mean_td_error = float(progress["mean_td_error"][0])

    def _present_workspace(self) -> Any:
        """The workspace of the current training, brought up to date."""
        workspace = self._workspace_for(self.rng, self.n_envs)
        self._note_progress(workspace)
        if self._next_actions is not workspace.next_actions:
            workspace.next_actions[:] = self._next_actions
            self._next_actions = workspace.next_actions
        return workspace

    def _note_progress(self, workspace: Workspace) -> None:
        remaining = self._current_progress_remaining
        exploration, step_size = self.exploration_schedule(remaining), self.lr_schedule(remaining)
        workspace.note_progress(exploration, step_size, self._episode_num, self.mean_td_error)

    def _choose_actions(self) -> Ints:
        actions: Ints = self._present_workspace().act(self._last_obs)
        return actions

    def _learn_from(self, transitions: Transitions) -> None:
        self._in_use = self._present_workspace()
        self.mean_td_error = self._in_use.learn(transitions)
        self._n_updates += self.n_envs

    def _exploring_actions(self, observation: Any) -> Ints:
        """An exploring action for one observation, or n actions for n observations.

        Raises:
            ValueError: for an observation of another shape.
        """
        obs = np.asarray(observation)
        many = is_vectorized_observation(obs, self.observation_space)
        workspace = self._workspace_for(self.predict_rng, len(obs) if many else 1)
        self._note_progress(workspace)
        workspace.next_actions[:] = UNDECIDED
        actions: Ints = workspace.act(obs if many else obs[None])
        return actions.reshape(len(obs) if many else ())

    def _record_training(self) -> None:
        self.logger.record("train/mean_absolute_td_error", self.mean_td_error)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if not self.averages_samples:
            rate = self.lr_schedule(self._current_progress_remaining)
            self.logger.record("train/learning_rate", rate)
