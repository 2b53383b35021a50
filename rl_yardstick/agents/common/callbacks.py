"""Callbacks that say how many steps training may run before they act again.

The compiled engine takes many steps in one block. A block ends at the step where a callback may
act, so callbacks act at the same time steps as in a loop that calls them after each step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)

NEVER = 2**62


@dataclass(frozen=True)
class Horizon:
    """The earliest moment at which a callback may act.

    Attributes:
        calls: number of calls of ``on_step`` from now until the callback may act.
        episodes: number of ended episodes from now until the callback may act.
    """

    calls: int = NEVER
    episodes: int = NEVER


class BlockCallback(BaseCallback):
    """A callback that says when it will act, so that the engine need not call it earlier.

    The simple way is ``every_n_steps``: every algorithm and engine then calls `_on_step` at these
    steps only. For other moments, override `horizon`, and check in `_on_step` whether the moment
    has come: `_on_step` is called whenever any callback acts.

    Attributes:
        every_n_steps: environment steps between two calls of `_on_step`, counted over all
            environments since ``num_timesteps`` was 0; if several environments step at once, the
            call comes after the step that reaches or passes a multiple. ``n_calls`` still counts
            all steps. None: `horizon` decides.
        takes_blocks: whether the engine may call ``_on_rollout_start`` and ``_on_rollout_end``
            around each block of compiled networks. If not, and if it has one of these, their
            environment runs in Python, and they are called at each rollout.

    Raises:
        ValueError: at the start of the training, if ``every_n_steps`` is not a number >= 1.
    """

    every_n_steps: int | None = None
    takes_blocks: ClassVar[bool] = False

    def init_callback(self, model: BaseAlgorithm) -> None:
        """Store the model."""
        every: object = self.every_n_steps
        if every is not None and not (isinstance(every, int) and every >= 1):
            name = type(self).__name__
            raise ValueError(f"{name}.every_n_steps must be a number from 1 on, not {every!r}")
        super().init_callback(model)

    def on_step(self) -> bool:
        """Count the step, and call `_on_step` if it is due."""
        if self.every_n_steps is None:
            return super().on_step()
        self.n_calls += 1
        self.num_timesteps = self.model.num_timesteps
        is_due = self.num_timesteps % self.every_n_steps < self.training_env.num_envs
        return self._on_step() if is_due else True

    def horizon(self) -> Horizon:
        """When the callback may act next; without ``every_n_steps`` never."""
        if self.every_n_steps is None:
            return Horizon()
        steps = self.every_n_steps - self.num_timesteps % self.every_n_steps
        return Horizon(calls=-(-steps // self.training_env.num_envs))

    def pass_over(self, n_calls: int, n_episodes: int) -> None:
        """Count ``n_calls`` skipped calls, during which ``n_episodes`` ended."""
        self.n_calls += n_calls

    def wants_position(self) -> bool:
        """Whether the callback reads or changes environments at the start of the next rollout."""
        return False

    def at_safe_moment(self) -> None:
        """Hook between two updates, when no step is running; called inside rollouts too."""


class EpisodeBudget(BlockCallback):
    """End training after ``n_episodes``, counted over all environments.

    Schedules then run by episodes as well: the share of training that remains is the share of
    episodes that remain.
    """

    def __init__(self, n_episodes: int) -> None:
        super().__init__()
        self.n_episodes = n_episodes
        self.episodes_seen = 0

    def horizon(self) -> Horizon:
        return Horizon(episodes=self.n_episodes - self.episodes_seen)

    def pass_over(self, n_calls: int, n_episodes: int) -> None:
        super().pass_over(n_calls, n_episodes)
        self.episodes_seen += n_episodes

    def _on_step(self) -> bool:
        self.episodes_seen += int(np.sum(self.locals["dones"]))
        # Algorithms take their progress from the steps done over the steps to do.
        share_done = max(self.episodes_seen, 1e-9) / self.n_episodes
        self.model._total_timesteps = self.num_timesteps / share_done  # type: ignore[assignment]
        return self.episodes_seen < self.n_episodes


def calls_until_multiple(n_calls: int, frequency: int) -> int:
    """Calls until the count is a multiple of ``frequency``; never if ``frequency`` < 1."""
    return frequency - n_calls % frequency if frequency > 0 else NEVER


def _every_n_timesteps(callback: Any) -> Horizon:
    steps = callback.last_time_trigger + callback.n_steps - callback.num_timesteps
    n_envs = callback.training_env.num_envs
    return Horizon(calls=max(-(-steps // n_envs), 1))


_LIBRARY_HORIZONS: dict[type[BaseCallback], Callable[[Any], Horizon]] = {
    EvalCallback: lambda c: Horizon(calls_until_multiple(c.n_calls, c.eval_freq)),
    CheckpointCallback: lambda c: Horizon(calls_until_multiple(c.n_calls, c.save_freq)),
    EveryNTimesteps: _every_n_timesteps,
    LogEveryNTimesteps: _every_n_timesteps,
    StopTrainingOnMaxEpisodes: lambda c: Horizon(episodes=c._total_max_episodes - c.n_episodes),
    ProgressBarCallback: lambda _: Horizon(),
}


def members(callback: BaseCallback) -> list[BaseCallback]:
    """The callback, or for a callback list all members, nested lists included."""
    if type(callback) is CallbackList:
        return [callback, *(m for child in callback.callbacks for m in members(child))]
    return [callback]


def unknown_callbacks(callback: BaseCallback) -> list[str]:
    """Names of the callbacks that must be called after each step, without repeats."""
    names = (type(member).__name__ for member in members(callback) if not _is_known(member))
    return list(dict.fromkeys(names))


def _is_known(callback: BaseCallback) -> bool:
    if type(callback) is ConvertCallback:
        return callback.callback is None
    known = type(callback) is CallbackList or type(callback) in _LIBRARY_HORIZONS
    return known or hasattr(callback, "pass_over")


def horizon(callback: BaseCallback) -> Horizon:
    """The earliest moment at which one of the callbacks may act."""
    horizons = []
    for member in members(callback):
        ask = getattr(member, "horizon", None)
        if ask is not None:
            horizons.append(ask())
        elif type(member) in _LIBRARY_HORIZONS:
            horizons.append(_LIBRARY_HORIZONS[type(member)](member))
    return Horizon(
        min((h.calls for h in horizons), default=NEVER),
        min((h.episodes for h in horizons), default=NEVER),
    )


def heeds_rollouts(callback: BaseCallback) -> bool:
    """Whether the callback acts at the start or end of a rollout, and cannot take blocks."""
    kind = type(callback)
    if kind is CallbackList or getattr(kind, "takes_blocks", False):
        return False
    names = ("_on_rollout_start", "_on_rollout_end")
    return any(getattr(kind, name) is not getattr(BaseCallback, name) for name in names)


def pass_over(callback: BaseCallback, n_calls: int, n_episodes: int) -> None:
    """Let each callback count skipped calls."""
    for member in members(callback):
        if hasattr(member, "pass_over"):
            member.pass_over(n_calls, n_episodes)
            continue
        member.n_calls += n_calls
        if type(member) is StopTrainingOnMaxEpisodes:
            member.n_episodes += n_episodes
        elif type(member) is ProgressBarCallback:
            member.pbar.update(n_calls * member.training_env.num_envs)
