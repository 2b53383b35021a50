"""Telling callbacks where rollouts begin and end, which blocks of compiled steps may pass over."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from agents.common.callback_horizons import heeds_rollouts, members


class RolloutEvents:
    """What the callbacks of a training are told of its rollouts.

    Args:
        agent: the agent.
        callback: all of its callbacks.

    Attributes:
        are_heeded: whether one acts on rollouts, so that blocks have to end with them.
    """

    def __init__(self, agent: Any, callback: BaseCallback) -> None:
        self.agent = agent
        asked = [member for member in members(callback) if type(member) is not CallbackList]
        self.of_rollouts = [member for member in asked if heeds_rollouts(member)]
        self.of_blocks = [member for member in asked if not heeds_rollouts(member)]
        self.are_heeded = bool(self.of_rollouts)

    def begin(self) -> None:
        """A block begins, and perhaps a rollout; a run that was cut off goes back to its state."""
        for member in self.of_blocks:
            member.on_rollout_start()
        if not self.agent.is_within_rollout:
            for member in self.of_rollouts:
                member.on_rollout_start()

    def end(self) -> None:
        """A rollout ends, before it is learnt from."""
        for member in self.of_rollouts:
            member.on_rollout_end()

    def end_block(self) -> None:
        """A block ends, and has been learnt from."""
        for member in self.of_blocks:
            member.on_rollout_end()
