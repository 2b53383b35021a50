"""Records each step of a table's training, for a page that replays it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from rl_yardstick.agents.common.algorithm import true_outcome
from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon
from rl_yardstick.agents.compiled.learning_algorithm import LearningAlgorithm
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation import value_maps
from rl_yardstick.pipeline.spec import TrainSpec

# Limits for a page of three megabytes.
MOST_MOVES = 20_000
MOST_CHANGES = 60_000
MOST_ENTRIES = 100_000

# How a step ended an episode, if it did.
GOES_ON, TERMINATED, TRUNCATED = 0, 1, 2
NO_STATE = -1

# A step of all environments; the learning rate is NaN if it is not from the schedule.
STEP = np.dtype(
    [("timesteps", np.int64), ("exploration", np.float64), ("learning_rate", np.float64)]
)
# One environment's part of a step.
MOVE = np.dtype(
    [
        ("step", np.int64),  # number of the step
        ("env", np.int64),
        ("episode", np.int64),  # of this environment, from 0 on
        ("obs", np.int64),  # `NO_STATE` if observations are not numbers
        ("action", np.int64),
        ("reward", np.float64),
        ("next_obs", np.int64),  # before any reset
        ("end", np.int64),
        ("target", np.float64),  # NaN without an update, or if the agent does not report it
        ("td_error", np.float64),
        ("episode_return", np.float64),  # sum of rewards so far
    ]
)
# A table entry that a step has changed; ``entry`` is its index in the flattened table.
CHANGE = np.dtype(
    [("step", np.int64), ("table", np.int64), ("entry", np.int64), ("after", np.float64)]
)


class TableRecorder(BlockCallback):
    """Records the first steps over all environments: 20,000, or those of ``n_episodes`` if not 0.

    It finds changed entries by comparing the tables before and after an update, for any learning
    rule.
    """

    def __init__(self, n_episodes: int = 0) -> None:
        super().__init__()
        self.n_episodes = n_episodes
        self.steps: list[NDArray[np.void]] = []  # one array of `STEP` and of `MOVE` for each step
        self.moves: list[NDArray[np.void]] = []
        self.changes: list[NDArray[np.void]] = []  # of `CHANGE`
        self.n_changes = 0
        self.is_full = False
        self.is_cut = False  # whether these episodes have more steps than recorded

    def rows(self) -> dict[str, NDArray[np.void]]:
        """All records of steps, moves and changes."""
        return {
            "steps": np.concatenate([np.empty(0, STEP), *self.steps]),
            "moves": np.concatenate([np.empty(0, MOVE), *self.moves]),
            "changes": np.concatenate([np.empty(0, CHANGE), *self.changes]),
        }

    def horizon(self) -> Horizon:
        """After each step, as long as steps are recorded."""
        return Horizon() if self.is_full else Horizon(calls=1)

    def _on_training_start(self) -> None:
        self.initial = {name: table.copy() for name, table in tables_of(self.model).items()}
        # Whether the first table has a number for each state and action.
        self.has_actions = has_actions(self.model, next(iter(self.initial.values())))
        self._tables = [table.copy() for table in self.initial.values()]  # after the last step
        self._returns = np.zeros(self.model.n_envs)
        self._episodes = np.zeros(self.model.n_envs, dtype=np.int64)

    def _on_rollout_start(self) -> None:
        if self.is_full:
            return
        self._obs = np.array(self.model._last_obs)
        told = getattr(self.model, "last_steps", None)
        if told is not None:  # cleared, so that the next step cannot read an old number
            told["target"] = told["td_error"] = np.nan

    def _on_step(self) -> bool:
        if self.is_full:
            return True
        agent: Any = self.model
        told = self.locals
        next_obs, terminated = true_outcome(told["new_obs"], told["dones"], told["infos"])
        self._returns += told["rewards"]
        moves = np.zeros(agent.n_envs, dtype=MOVE)
        moves["step"], moves["env"] = len(self.steps), np.arange(agent.n_envs)
        moves["episode"], moves["episode_return"] = self._episodes, self._returns
        is_number = isinstance(agent.observation_space, spaces.Discrete)
        moves["obs"] = self._obs if is_number else NO_STATE
        moves["next_obs"] = next_obs if is_number else NO_STATE
        moves["action"], moves["reward"] = told["actions"], told["rewards"]
        moves["end"] = np.where(told["dones"], np.where(terminated, TERMINATED, TRUNCATED), GOES_ON)
        moves["target"] = moves["td_error"] = math.nan
        rate = math.nan
        if not agent.averages_samples and agent.learning_rate != 0.0:
            rate = float(agent.lr_schedule(agent._current_progress_remaining))
        self.steps.append(np.array([(self.num_timesteps, agent.exploration_rate, rate)], STEP))
        self.moves.append(moves)
        self._returns[told["dones"]] = 0.0
        self._episodes[told["dones"]] += 1
        return True

    def _on_rollout_end(self) -> None:
        if self.is_full or not len(self.steps):
            return
        agent: Any = self.model
        told = getattr(agent, "last_steps", None)
        if told is not None:
            self.moves[-1]["target"] = told["target"]
            self.moves[-1]["td_error"] = told["td_error"]
        for number, now in enumerate(tables_of(agent).values()):
            before = self._tables[number]
            # nan is unequal to itself, but has not changed.
            moved = np.flatnonzero((before != now) & ~(np.isnan(before) & np.isnan(now)))
            if len(moved):
                changes = np.zeros(len(moved), dtype=CHANGE)
                changes["step"], changes["table"] = len(self.steps) - 1, number
                changes["entry"], changes["after"] = moved, now.reshape(-1)[moved]
                before.reshape(-1)[moved] = changes["after"]
                self.changes.append(changes)
                self.n_changes += len(moved)
        is_done = self.n_episodes > 0 and self._episodes.sum() >= self.n_episodes
        has_room = (len(self.moves) + 1) * agent.n_envs <= MOST_MOVES
        self.is_full = is_done or not has_room or self.n_changes > MOST_CHANGES
        self.is_cut = self.is_full and not is_done


def tables_of(agent: BaseAlgorithm) -> dict[str, Floats]:
    """The agent's tables by name, those with a number for each action first."""
    tables = {
        name: buffer.numpy()
        for name, buffer in agent.policy.named_buffers()
        if buffer.is_floating_point() and buffer.numel() > 0
    }
    return dict(sorted(tables.items(), key=lambda item: not has_actions(agent, item[1])))


def has_actions(agent: BaseAlgorithm, table: Floats) -> bool:
    """Whether a table's rows, one per state or one for all, have a number for each action."""
    states, actions = agent.observation_space, agent.action_space
    if not isinstance(states, spaces.Discrete) or not isinstance(actions, spaces.Discrete):
        return False
    return table.ndim > 1 and table.shape[-1] == actions.n and table.shape[-2] in (states.n, 1)


Watch = TableRecorder | value_maps.ValueMapRecorder


def watch_of(
    spec: TrainSpec, agent: BaseAlgorithm, maps: value_maps.ValueMapRecorder | None
) -> TableRecorder | None:
    """The recorder of an untrained agent with tables; None if none is asked for, and for maps."""
    if spec.watch_learning is None:
        return None
    if isinstance(agent, LearningAlgorithm) and (tables := tables_of(agent)):
        n_entries = sum(table.size for table in tables.values())
        if n_entries > MOST_ENTRIES:
            raise UserError(
                f"--watch-learning shows tables of up to {MOST_ENTRIES:,} entries; those of "
                f"{spec.algo} on {spec.env_id} have {n_entries:,}"
            )
        return TableRecorder(spec.watch_episodes)
    if maps is None or value_maps.best_actions_of(maps.evaluator, agent) is None:
        raise UserError(
            f"--watch-learning shows tables, or an agent's actions in up to 2,500 known states: "
            f"{spec.algo} on {spec.env_id} has neither"
        )
    if spec.watch_episodes or (spec.eval_freq or 1) < 0:
        flag = "--watch-episodes is for agents with tables"
        flag = flag if spec.watch_episodes else "--eval-freq"
        raise UserError(f"{flag}: {spec.algo} is shown at each evaluation")
    return None
