"""A callback that ends a training at the first number that is none."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

from agents.common.callback_horizons import BlockCallback
from pipeline.finite_numbers import NotFiniteError, check_numbers, check_rows, is_finite

# Under these names the library's agents log what they minimise. Other entries may be nan, such as
# the variance that is explained of nothing.
LOSSES = (
    "train/loss",
    "train/actor_loss",
    "train/critic_loss",
    "train/ent_coef_loss",
    "train/value_loss",
)

_NO_EPISODE: Mapping[str, float] = {"r": 0.0}


class NumberWatch(BlockCallback):
    """Looks at what each step brings: observations, rewards, actions, returns, and losses.

    It comes before all other callbacks, so that nothing is kept of such a step. The compiled loop
    shows it the last step of each block; the rewards that it trains on are those of a model, which
    are finite.
    """

    takes_blocks = True

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """Take what the training loop shows, without a copy: this is called at each step."""
        self.locals = locals_

    def _on_training_start(self) -> None:
        when = f"at step {self.model.num_timesteps:,}"
        if self.model._last_obs is not None:
            check_rows(self.model._last_obs, "observation", when)

    def _on_rollout_start(self) -> None:
        log = self.model.logger.name_to_value
        for name in LOSSES:
            if name in log and not isfinite(log[name]):
                raise NotFiniteError(f"{name} at step {self.model.num_timesteps:,}", log[name])

    def _on_step(self) -> bool:
        seen = self.locals
        # Algorithms that play whole episodes, as ARS does, show another function's names.
        new_obs = seen.get("new_obs", seen.get("new_observations"))
        rewards, actions = seen.get("rewards"), seen.get("actions")
        if not (is_finite(rewards) and is_finite(new_obs) and is_finite(actions)):
            when = f"at step {self.num_timesteps:,}"
            check_rows(rewards, "reward", when)
            check_rows(new_obs, "observation", when)
            check_rows(actions, "action", when)
        dones = seen.get("dones")
        if dones is not None and True in (ended := dones.tolist()):
            self._check_ends(ended, seen["infos"])
        return True

    def _check_ends(self, dones: list[bool], infos: Any) -> None:
        """Look at what was seen before resets, and at the returns that Monitor wrote down."""
        for i, info in enumerate(infos):
            if not dones[i]:
                continue
            last, total = info.get("terminal_observation"), info.get("episode", _NO_EPISODE)["r"]
            if not (is_finite(last) and isfinite(total)):
                where = f"of an episode of environment {i} at step {self.num_timesteps:,}"
                check_numbers(last, "last observation", where)
                check_numbers(total, "return", where)
