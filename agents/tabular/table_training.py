"""How agents on tables act and learn: what both training loops are handed of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback

from agents.common.exploration import STRATEGIES, draws_per_choice
from agents.common.observed_numbers import numbers_in
from agents.common.online import Transitions
from agents.compiled.engine_choice import choose_engine
from agents.compiled.generators import handles_of
from agents.compiled.greedy_play import Explorer, Plan
from agents.tabular.episode_keeping import EpisodeKeeper
from agents.tabular.temporal_difference import (
    TabularAgent,
    act_on_values,
    no_commitment,
    td_learning,
)
from agents.tabular.value_tables import Room
from agents.tabular.workspace import Workspace
from mdp.array_types import Ints


class TableTraining(EpisodeKeeper):
    """Acts and learns on the tables of its policy, interpreted or compiled.

    Attributes:
        engine_in_use: which loop the last training ran in, and why if it is not the compiled one.
        mean_td_error: mean absolute error of the last updates.
        last_steps: a record for each environment, with target and TD error of its last update.
    """

    # What the training loops call; `next_value` is each algorithm's own.
    act = act_on_values
    learn_from_step = td_learning
    commit = no_commitment

    _rebuilt = (*EpisodeKeeper._rebuilt, "_in_use", "last_steps")
    excluded_from_states = ("_in_use", "last_steps")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.engine_in_use = ""
        self.mean_td_error = 0.0
        self._in_use: Workspace | None = None
        self.last_steps: NDArray[np.void] | None = None
        super().__init__(*args, **kwargs)

    def compiled_agent(self, rng: np.random.Generator) -> TabularAgent:
        """The agent as compiled functions see it, its tables in the memory of its policy."""
        values = self.policy.q_tables.numpy()
        self._check_tables()
        self._check_memory()
        n_actions = values.shape[2]
        n_draws = draws_per_choice(self.strategy, n_actions)
        return TabularAgent(
            self.settings()[0],
            self._tables(),
            Room(np.empty(n_actions), np.arange(n_actions), np.empty(n_draws)),
            handles_of([rng])[0],
            self._memory_in_use(),
        )

    def greedy_player(self, seen: Any) -> Plan:
        """What plays as `predict` does on compiled environments, which show numbers."""
        numbers = np.arange(self.policy.q_tables.shape[1])
        return Plan(self.predict(numbers, deterministic=True)[0].astype(np.int64))

    def exploring_player(self, seen: Any) -> Explorer:
        """What plays as `predict` does that explores, and draws from the same generator."""
        return Explorer(self.compiled_agent(self.predict_rng), self.progress())

    def _check_tables(self) -> None:
        super()._check_tables()
        if self.strategy not in STRATEGIES.values():
            raise ValueError(f"unknown exploration strategy {self.strategy}")

    def _run(self, total_timesteps: int, callback: BaseCallback, log_interval: int | None) -> None:
        engine = choose_engine(self, callback, log_interval)
        if engine is not None:
            engine.run(total_timesteps)
            return
        self._in_use = None
        super()._run(total_timesteps, callback, log_interval)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_in_use": None, "last_steps": None}

    def hand_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Write what the compiled loop goes on from into its records."""
        super().hand_over(envs, progress)
        progress["mean_td_error"] = self.mean_td_error

    def take_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Go on from where the compiled loop is."""
        super().take_over(envs, progress)
        self.last_steps = envs
        self.mean_td_error = float(progress["mean_td_error"][0])

    def _present_workspace(self) -> Workspace:
        """The one of the training under way, up to date."""
        workspace: Workspace = self._workspace_for(self.rng, self.n_envs)
        self._note_progress(workspace)
        if self._next_actions is not workspace.next_actions:
            workspace.next_actions[:] = self._next_actions
            self._next_actions = workspace.next_actions
        return workspace

    def _note_progress(self, workspace: Workspace) -> None:
        remaining = self._current_progress_remaining
        exploration, step_size = self.exploration_schedule(remaining), self.lr_schedule(remaining)
        workspace.note_progress(exploration, step_size, self._episode_num)

    def _make_workspace(self, rng: np.random.Generator, n: int) -> Workspace:
        return Workspace(self.compiled_agent(rng), self.policy.masks, rng, n)

    def _choose_actions(self) -> Ints:
        if self.asks_for_masks:
            self._note_present_masks()
        workspace = self._in_use
        if workspace is None or workspace.rng is not self.rng:
            workspace = self._present_workspace()
        else:
            # Brought up to date when the agent learnt last: episodes have been counted since then.
            workspace.episodes[0] = self._episode_num
        return workspace.act(self._last_obs)

    def _learn_from(self, transitions: Transitions) -> None:
        if self.asks_for_masks:
            self._note_next_masks(transitions)
        self._in_use = workspace = self._present_workspace()
        self.last_steps = workspace.envs
        self.mean_td_error = workspace.learn(transitions)
        self._n_updates += self.n_envs

    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The greedy action, or an exploring one unless ``deterministic``, as DQN has it.

        Takes one state index or an array of shape (n,), and returns actions of the same shape and
        ``state``; ``episode_start`` is not used. With ``mask_actions``, ``action_masks`` of shape
        (n, A) count here in place of those that the agent has kept.
        """
        if deterministic and action_masks is None:
            return super().predict(observation, state, episode_start, deterministic)
        obs = numbers_in(self.observation_space, observation)
        with self.policy.told(obs.reshape(-1), action_masks):
            if deterministic:
                return super().predict(obs, state, episode_start, deterministic)
            return self._exploring_actions(obs), state
