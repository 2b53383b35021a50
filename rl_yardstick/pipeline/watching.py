"""Records a training while it runs, for a page that replays it.

For agents with tables it records each step; for all others, maps of the greedy policy.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from rl_yardstick.agents.common.algorithm import true_outcome
from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon
from rl_yardstick.agents.compiled.learning_algorithm import LearningAlgorithm
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.evaluation.value_maps import MAX_STATES, best_actions_of
from rl_yardstick.pipeline.finite_numbers import NotFiniteError, check_model
from rl_yardstick.pipeline.spec import TrainSpec


class GrowingRows:
    """An array of records that grows by doubling; fast to save with the training."""

    def __init__(self, kind: np.dtype[np.void]) -> None:
        self._rows: NDArray[np.void] = np.zeros(256, dtype=kind)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def rows(self) -> NDArray[np.void]:
        """All appended records, shape (n,)."""
        return self._rows[: self._n]

    def append(self, *fields: Any) -> None:
        """Append one record."""
        self.extend(np.array([fields], dtype=self._rows.dtype))

    def extend(self, records: NDArray[np.void]) -> None:
        """Append records, shape (n,)."""
        end = self._n + len(records)
        if end > len(self._rows):
            larger = np.zeros(2 * end, dtype=self._rows.dtype)
            larger[: self._n] = self.rows
            self._rows = larger
        self._rows[self._n : end] = records
        self._n = end

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Remove all records except the chosen ones; bool of shape (n,)."""
        kept = self.rows[chosen]
        self._rows[: len(kept)] = kept
        self._n = len(kept)


# --- maps -----------------------------------------------------------------------------------------

# If a page has no room for more maps, every second one is kept, then every fourth, and so on.
MOST_MAPS = 1000
MOST_FIGURES = 200_000  # numbers in all maps together
FEWEST_MAPS = 2  # the first and the last

# Log entries of the library's agents, by their names on the page.
LOGGED = {
    "loss": "train/loss",
    "policy_loss": "train/policy_loss",
    "value_loss": "train/value_loss",
    "entropy_loss": "train/entropy_loss",
}


class MapRecorder(BaseCallback):
    """Records the greedy policy and its state values at many moments."""

    unit: ClassVar[str]  # a map follows each unit

    def __init__(self, evaluator: ExactEvaluator) -> None:
        super().__init__()
        n_states = evaluator.model.n_states
        self.evaluator = evaluator
        self.moments = GrowingRows(_moment_type(n_states))
        self.most = min(max(MOST_FIGURES // (2 * n_states), FEWEST_MAPS), MOST_MAPS)
        self.stride = 1  # every ``stride``-th map is kept
        self.n_units = 0

    @property
    def has_begun(self) -> bool:
        """Whether anything was recorded."""
        return len(self.moments) > 0

    def _on_training_start(self) -> None:
        if not self.has_begun:
            self._append()

    def finish(self) -> None:
        """Record the map at the end, unless it exists already or is not finite."""
        with suppress(NotFiniteError):
            check_model(self.model)
            self._keep_end()

    def _keep_end(self) -> None:
        last = self.moments.rows[["number", "timesteps"]][-1:].tolist()
        if last != [(self.n_units, self.model.num_timesteps)]:
            self._append()

    def _count(self) -> None:
        """Count a unit, and record its map if its number is a multiple of the stride."""
        self.n_units += 1
        if self.n_units % self.stride:
            return
        self._append()
        if len(self.moments) > self.most:
            self.stride *= 2
            self.moments.keep(self.moments.rows["number"] % self.stride == 0)

    def _append(self) -> None:
        policy = best_actions_of(self.evaluator, self.model)
        if policy is None:
            return
        agent: Any = self.model
        # From the schedule, because the agent's own rate is set only at the first step.
        schedule = getattr(agent, "exploration_schedule", lambda progress: math.nan)
        log = agent.logger.name_to_value if self.n_units else {}
        returns = [episode["r"] for episode in agent.ep_info_buffer or ()]
        self.moments.append(
            self.n_units,
            agent.num_timesteps,
            float(schedule(agent._current_progress_remaining)),
            *(log.get(name, math.nan) for name in LOGGED.values()),
            float(np.mean(returns)) if returns else math.nan,
            self.evaluator.values(policy),
            policy[0],
        )


class EvaluationMaps(MapRecorder):
    """Records a map after every evaluation."""

    unit = "evaluation"

    def _on_step(self) -> bool:
        self._count()
        return True


class UpdateMaps(MapRecorder, BlockCallback):
    """Records a map after every update, at the start of rollouts, which can stay compiled."""

    unit = "update"

    def __init__(self, evaluator: ExactEvaluator) -> None:
        super().__init__(evaluator)
        self._seen = 0  # updates in the agent's count: several per training phase

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._seen = self._n_updates()

    def _on_rollout_start(self) -> None:
        if (seen := self._n_updates()) != self._seen:
            self._seen = seen
            self._count()

    def _n_updates(self) -> int:
        agent: Any = self.model
        return int(agent._n_updates)

    def _on_step(self) -> bool:
        return True

    def _keep_end(self) -> None:
        self._on_rollout_start()  # the last training phase follows the last rollout
        super()._keep_end()


def _moment_type(n_states: int) -> np.dtype[np.void]:
    return np.dtype(
        [
            ("number", np.int64),  # of the unit that it follows; 0 before the training
            ("timesteps", np.int64),
            ("exploration", np.float64),  # nan if the agent has no such rate
            *((name, np.float64) for name in LOGGED),  # of the last training; nan for none
            ("training_return", np.float64),  # mean of the last episodes, nan for none
            ("values", np.float64, (n_states,)),
            ("actions", np.int64, (n_states,)),
        ]
    )


# --- steps ----------------------------------------------------------------------------------------

# Limits for a page of three megabytes; MOVES_UNASKED applies without ``--watch-episodes``.
MOST_MOVES = 20_000
MOST_CHANGES = 60_000
MOVES_UNASKED = 5_000
MOST_ENTRIES = 100_000
# Limits of the search for the rise of the return, and steps between evaluations of the policy.
MOVES_SEARCHED = 50_000
CHANGES_SEARCHED = 1_000_000
STEPS_BETWEEN_RETURNS = 100
# The return has risen once it has covered this share of the way to its maximum.
FIRST_OF_RISE, LAST_OF_RISE = 0.1, 0.9
STEPS_AROUND = 500  # steps kept before and after the rise

# How a step ended an episode, if it did.
GOES_ON, TERMINATED, TRUNCATED = 0, 1, 2
NO_STATE = -1

# A step of all environments.
STEP = np.dtype(
    [
        ("timesteps", np.int64),  # after it, over all environments
        ("exploration", np.float64),
        ("learning_rate", np.float64),  # nan if it is not from the schedule
    ]
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
        ("target", np.float64),  # nan without an update, or if the agent does not report it
        ("td_error", np.float64),
        ("episode_return", np.float64),  # sum of rewards so far
    ]
)
# A table entry that a step has changed.
CHANGE = np.dtype(
    [
        ("step", np.int64),
        ("table", np.int64),
        ("entry", np.int64),  # index in the flattened table
        ("after", np.float64),
    ]
)


class TableRecorder(BlockCallback):
    """Records the steps of the first ``n_episodes``, over all environments.

    For 0 episodes, it records the steps in which the greedy policy's return rises, computed by
    ``exact``, or the first 5000 steps without ``exact``. It finds changed entries by comparing the
    tables before and after an update, for any learning rule.
    """

    def __init__(self, n_episodes: int, exact: ExactEvaluator | None = None) -> None:
        super().__init__()
        self.n_episodes = n_episodes
        self.exact = None if n_episodes else exact
        self._greedy_returns: list[float] = []  # one after each `STEPS_BETWEEN_RETURNS` steps
        self.names: list[str] = []  # of the tables
        self.has_actions = False  # whether the first table has a number for each state and action
        self.initial: dict[str, Floats] = {}  # the tables before the first step
        self.steps = GrowingRows(STEP)
        self.moves = GrowingRows(MOVE)
        self.changes = GrowingRows(CHANGE)
        self.is_full = False
        self.is_cut = False  # whether these episodes have more steps than recorded
        self._tables: list[Floats] = []  # after the previous step
        self._obs: Any = None
        self._returns = np.zeros(0)
        self._episodes = np.zeros(0, dtype=np.int64)

    @property
    def has_begun(self) -> bool:
        """Whether anything was recorded."""
        return len(self.steps) > 0

    def horizon(self) -> Horizon:
        """After each step, as long as steps are recorded."""
        return Horizon() if self.is_full else Horizon(calls=1)

    def _on_rollout_start(self) -> None:
        if self.is_full:
            return
        if not self.initial:
            self.initial = {name: table.copy() for name, table in tables_of(self.model).items()}
            self.names = [*self.initial]
            self.has_actions = has_actions(self.model, self.initial[self.names[0]])
            self._tables = [table.copy() for table in self.initial.values()]
            self._returns = np.zeros(self.model.n_envs)
            self._episodes = np.zeros(self.model.n_envs, dtype=np.int64)
            self._note_return()
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
        moves["obs"], moves["next_obs"] = self._numbers(self._obs), self._numbers(next_obs)
        moves["action"], moves["reward"] = told["actions"], told["rewards"]
        moves["end"] = np.where(told["dones"], np.where(terminated, TERMINATED, TRUNCATED), GOES_ON)
        moves["target"] = moves["td_error"] = np.nan
        learning_rate = math.nan
        if not agent.averages_samples and agent.learning_rate != 0.0:
            learning_rate = float(agent.lr_schedule(agent._current_progress_remaining))
        self.steps.append(self.num_timesteps, agent.exploration_rate, learning_rate)
        self.moves.extend(moves)
        self._returns[told["dones"]] = 0.0
        self._episodes[told["dones"]] += 1
        return True

    def _on_rollout_end(self) -> None:
        if self.is_full or not len(self.steps):
            return
        agent: Any = self.model
        told = getattr(agent, "last_steps", None)
        if told is not None:
            last = self.moves.rows[-agent.n_envs :]
            last["target"], last["td_error"] = told["target"], told["td_error"]
        for number, now in enumerate(tables_of(agent).values()):
            before = self._tables[number]
            # nan is unequal to itself, but has not changed.
            moved = np.flatnonzero((before != now) & ~(np.isnan(before) & np.isnan(now)))
            if len(moved):
                changes = np.zeros(len(moved), dtype=CHANGE)
                changes["step"], changes["table"] = len(self.steps) - 1, number
                changes["entry"], changes["after"] = moved, now.reshape(-1)[moved]
                self.changes.extend(changes)
                before.reshape(-1)[moved] = changes["after"]
        if len(self.steps) % STEPS_BETWEEN_RETURNS == 0:
            self._note_return()
        self._look_whether_full()

    def _look_whether_full(self) -> None:
        if self.n_episodes and self._episodes.sum() >= self.n_episodes:
            self.is_full = True
            return
        if self.exact is not None:
            self.is_full = self._has_risen() or len(self.moves) > MOVES_SEARCHED
            self.is_full |= len(self.changes) > CHANGES_SEARCHED
            self.is_cut = self.is_full
            return
        most = MOST_MOVES if self.n_episodes else MOVES_UNASKED
        has_room = len(self.moves) + self.model.n_envs <= most
        self.is_full = not has_room or len(self.changes) > MOST_CHANGES
        self.is_cut = self.is_full

    def _note_return(self) -> None:
        if self.exact is not None:
            self._greedy_returns.append(self.exact(self.model).mean_return)

    def _has_risen(self) -> bool:
        """Whether enough steps follow the first near-optimal policy."""
        assert self.exact is not None
        first, best = self._greedy_returns[0], self.exact.yardstick.optimum
        near = first + LAST_OF_RISE * (best - first)
        risen = next((i for i, one in enumerate(self._greedy_returns) if one >= near), None)
        if risen is None or len(self.moves) < MOVES_UNASKED:
            return False
        return len(self.steps) >= STEPS_BETWEEN_RETURNS * risen + STEPS_AROUND

    def window(self) -> tuple[int, int]:
        """The steps to show, [first, end): whole episodes around the rise of the greedy return."""
        n, n_envs = len(self.steps), self.model.n_envs
        returns = np.array(self._greedy_returns)
        if self.exact is None or not len(returns):
            return 0, n
        fewest, most = MOVES_UNASKED // n_envs, MOST_MOVES // n_envs
        way = float(returns.max() - returns[0])
        if way <= 0:
            return 0, min(n, fewest)
        behind = (returns - returns[0]) / way
        last = int(np.argmax(behind >= LAST_OF_RISE))
        first = int(np.flatnonzero(behind[:last] <= FIRST_OF_RISE)[-1])
        end = min(n, max(STEPS_BETWEEN_RETURNS * last + STEPS_AROUND, fewest))
        begin = min(STEPS_BETWEEN_RETURNS * first - STEPS_AROUND, end - fewest)
        moves = self.moves.rows
        of_first = moves[moves["env"] == 0]
        episodes = np.append(0, of_first["step"][of_first["end"] != GOES_ON] + 1)
        before = int(episodes[episodes <= max(begin, 0)][-1])
        if end - before > most:
            later = episodes[(episodes >= end - most) & (episodes < end)]
            before = int(later[0]) if len(later) else end - most
        return before, end

    def _numbers(self, observations: Any) -> Any:
        is_number = isinstance(self.model.observation_space, spaces.Discrete)
        return observations if is_number else NO_STATE


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


Watch = TableRecorder | MapRecorder


def watch_of(spec: TrainSpec, agent: BaseAlgorithm, exact: ExactEvaluator | None) -> Watch | None:
    """Make the recorder for an untrained agent; None without ``--watch-learning``."""
    if spec.watch_learning is None:
        return None
    can_be_mapped = exact is not None and exact.model.n_states <= MAX_STATES
    if isinstance(agent, LearningAlgorithm) and (tables := tables_of(agent)):
        n_entries = sum(table.size for table in tables.values())
        if n_entries > MOST_ENTRIES:
            raise UserError(
                f"--watch-learning shows tables of up to {MOST_ENTRIES:,} entries; those of "
                f"{spec.algo} on {spec.env_id} have {n_entries:,}"
            )
        return TableRecorder(spec.watch_episodes, exact if can_be_mapped else None)
    if exact is None or not can_be_mapped or best_actions_of(exact, agent) is None:
        raise UserError(
            f"--watch-learning shows tables, or an agent's actions in up to 2,500 known states: "
            f"{spec.algo} on {spec.env_id} has neither"
        )
    tells_updates = isinstance(agent, OnPolicyAlgorithm | OffPolicyAlgorithm)
    if spec.watch_episodes:
        raise UserError(
            f"--watch-episodes is for agents with tables: {spec.algo} is shown at each "
            f"{'update' if tells_updates else 'evaluation'}"
        )
    return UpdateMaps(exact) if tells_updates else EvaluationMaps(exact)
