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
from rl_yardstick.pipeline.evaluation.value_maps import MAX_STATES, MapSeries, best_actions_of
from rl_yardstick.pipeline.finite_numbers import NotFiniteError, check_model
from rl_yardstick.pipeline.spec import TrainSpec

# --- maps -----------------------------------------------------------------------------------------

MOST_MAPS = 1000
MOST_FIGURES = 200_000  # numbers in all maps together
FEWEST_MAPS = 2  # the first and the last

# Log entries of the library's agents, by their names on the page.
LOGGED = {name: f"train/{name}" for name in ("loss", "policy_loss", "value_loss", "entropy_loss")}


class MapRecorder(MapSeries, BaseCallback):
    """Records the greedy policy and its state values before the training and after many units."""

    unit: ClassVar[str]

    def __init__(self, evaluator: ExactEvaluator) -> None:
        BaseCallback.__init__(self)
        most = min(max(MOST_FIGURES // (2 * evaluator.model.n_states), FEWEST_MAPS), MOST_MAPS)
        MapSeries.__init__(self, evaluator, most)

    @property
    def rows(self) -> NDArray[np.void]:
        """The records; figures are NaN where the agent has none."""
        states = (self.evaluator.model.n_states,)
        maps = ("values", np.float64, states), ("actions", np.int64, states)
        figures = [(name, np.float64) for name in ("exploration", *LOGGED, "training_return")]
        kind = [("number", np.int64), ("timesteps", np.int64), *maps, *figures]
        return np.array(self.moments, dtype=kind)

    def figures(self, agent: Any) -> tuple[float, ...]:
        """The rate of exploration, the losses of the last update, the mean of last episodes."""
        # From the schedule, because the agent's own rate is set only at the first step.
        schedule = getattr(agent, "exploration_schedule", lambda progress: math.nan)
        log = agent.logger.name_to_value if self.n_units else {}
        returns = [episode["r"] for episode in agent.ep_info_buffer or ()]
        return (
            float(schedule(agent._current_progress_remaining)),
            *(log.get(name, math.nan) for name in LOGGED.values()),
            float(np.mean(returns)) if returns else math.nan,
        )

    def _on_training_start(self) -> None:
        if not self.moments:
            self.append(self.model)

    def _on_step(self) -> bool:
        return True

    def finish(self) -> None:
        """Record the map at the end, unless it is not finite."""
        with suppress(NotFiniteError):
            check_model(self.model)
            self._on_rollout_start()  # the last update follows the last rollout
            self.append(self.model)


class EvaluationMaps(MapRecorder):
    """Records a map after every evaluation."""

    unit = "evaluation"

    def _on_step(self) -> bool:
        self.count(self.model)
        return True


class UpdateMaps(MapRecorder, BlockCallback):
    """Records a map after every update, at the start of rollouts, which can stay compiled."""

    unit = "update"

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._seen = self._n_updates()

    def _n_updates(self) -> int:  # several in a phase of training
        return int(self.model._n_updates)  # type: ignore[attr-defined]

    def _on_rollout_start(self) -> None:
        if (seen := self._n_updates()) != self._seen:
            self._seen = seen
            self.count(self.model)


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
RISEN = 0.9
STEPS_BEHIND = 500  # steps kept after the rise

# How a step ended an episode, if it did.
GOES_ON, TERMINATED, TRUNCATED = 0, 1, 2
NO_STATE = -1

# A step of all environments; the learning rate is NaN if it is not from the schedule.
STEP = [("timesteps", np.int64), ("exploration", np.float64), ("learning_rate", np.float64)]
# One environment's part of a step.
MOVE = [
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
# A table entry that a step has changed; ``entry`` is its index in the flattened table.
CHANGE = [("step", np.int64), ("table", np.int64), ("entry", np.int64), ("after", np.float64)]


class GrowingRows:
    """An array of records that grows by doubling; fast to save with the training."""

    def __init__(self, kind: list[tuple[str, Any]]) -> None:
        self._rows: NDArray[np.void] = np.zeros(256, dtype=kind)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def rows(self) -> NDArray[np.void]:
        """All appended records, shape (n,)."""
        return self._rows[: self._n]

    def extend(self, n: int, **columns: Any) -> None:
        """Append ``n`` records; each column has n numbers, or one for all."""
        end = self._n + n
        if end > len(self._rows):
            larger = np.zeros(2 * end, dtype=self._rows.dtype)
            larger[: self._n] = self.rows
            self._rows = larger
        for name, values in columns.items():
            self._rows[name][self._n : end] = values
        self._n = end


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
        ends = np.where(terminated, TERMINATED, TRUNCATED)
        has_states = isinstance(agent.observation_space, spaces.Discrete)
        self.moves.extend(
            agent.n_envs,
            step=len(self.steps),
            env=np.arange(agent.n_envs),
            episode=self._episodes,
            obs=self._obs if has_states else NO_STATE,
            action=told["actions"],
            reward=told["rewards"],
            next_obs=next_obs if has_states else NO_STATE,
            end=np.where(told["dones"], ends, GOES_ON),
            target=math.nan,
            td_error=math.nan,
            episode_return=self._returns,
        )
        rate = math.nan
        if not agent.averages_samples and agent.learning_rate != 0.0:
            rate = float(agent.lr_schedule(agent._current_progress_remaining))
        now, exploration = self.num_timesteps, agent.exploration_rate
        self.steps.extend(1, timesteps=now, exploration=exploration, learning_rate=rate)
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
                step, after = len(self.steps) - 1, now.reshape(-1)[moved]
                self.changes.extend(len(moved), step=step, table=number, entry=moved, after=after)
                before.reshape(-1)[moved] = after
        if len(self.steps) % STEPS_BETWEEN_RETURNS == 0:
            self._note_return()
        self._look_whether_full()

    def _look_whether_full(self) -> None:
        n_moves, n_changes = len(self.moves), len(self.changes)
        if self.exact is not None:
            has_risen = len(self.steps) >= self._end_of_rise(self.exact.yardstick.optimum)
            self.is_cut = has_risen and n_moves >= MOVES_UNASKED
            self.is_cut |= n_moves > MOVES_SEARCHED or n_changes > CHANGES_SEARCHED
        else:
            most = MOST_MOVES if self.n_episodes else MOVES_UNASKED
            self.is_cut = n_moves + self.model.n_envs > most or n_changes > MOST_CHANGES
        is_done = self.n_episodes > 0 and self._episodes.sum() >= self.n_episodes
        self.is_cut &= not is_done
        self.is_full = self.is_cut or is_done

    def _note_return(self) -> None:
        if self.exact is not None:
            self._greedy_returns.append(self.exact(self.model).mean_return)

    def _end_of_rise(self, best: float) -> float:
        """The step with enough steps behind the rise of the return to ``best``; else infinity."""
        first = self._greedy_returns[0]
        near = np.array(self._greedy_returns) >= first + RISEN * (best - first)
        return STEPS_BETWEEN_RETURNS * near.argmax() + STEPS_BEHIND if near.any() else math.inf

    def window(self) -> tuple[int, int]:
        """The steps to show, [first, end): whole episodes up to the rise of the greedy return."""
        n, n_envs, moves = len(self.steps), self.model.n_envs, self.moves.rows
        if not self._greedy_returns:
            return 0, n
        end = max(self._end_of_rise(max(self._greedy_returns)), MOVES_UNASKED // n_envs)
        end = min(n, int(end))
        ends = moves["step"][(moves["env"] == 0) & (moves["end"] != GOES_ON)] + 1
        begins = np.append(0, ends[ends < end])
        return int(begins[begins >= min(end - MOST_MOVES // n_envs, begins[-1])][0]), end


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
