"""Refuses nan and infinity before an agent learns from them or is evaluated by them.

Infinity is refused like nan, also in an observation space without bounds: the first update of a
network turns infinity into nan, and so does the first difference from a mean that contains it.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np
import torch as th

from rl_yardstick.agents.bandits.tables import BanditPolicy
from rl_yardstick.agents.common.callbacks import BlockCallback
from rl_yardstick.pipeline.errors import UserError

# Log entries of the library's agents. Others may be nan, as the explained variance of constants.
_LOSSES = tuple(
    f"train/{name}" for name in ("loss", "actor_loss", "critic_loss", "ent_coef_loss", "value_loss")
)


def check_numbers(values: Any, what: str, when: str, in_rows: bool = False) -> None:
    """Check that all numbers of an array or a mapping of arrays are finite; None passes.

    With ``in_rows``, there is a row for each environment, shape (n_envs, ...), which is named.
    """
    if isinstance(values, Mapping):
        for name, array in values.items():
            check_numbers(array, f"{what} {name!r}", when, in_rows)
    elif values is not None and not np.isfinite(values).all():
        array = np.asarray(values)
        flat = np.ravel(array)
        place = int(np.argmin(np.isfinite(flat)))
        row = f" of environment {place * len(array) // flat.size}" if in_rows else ""
        raise UserError(f"{what}{row} {when} is {float(np.real(flat[place]))}")


def check_model(model: Any) -> None:
    """Check that an agent's tables or weights are finite."""
    when, policy = f"at step {model.num_timesteps:,}", getattr(model, "policy", None)
    if isinstance(policy, th.nn.Module):
        for name, table in policy.state_dict().items():
            # An infinite score marks an arm that was never pulled.
            is_scores = name == "scores" and isinstance(policy, BanditPolicy)
            tensor = table[policy.get_buffer("counts") > 0] if is_scores else table
            if not th.isfinite(tensor).all():
                values = tensor.detach().cpu().double().numpy()
                check_numbers(values, f"a value in {name} of the agent", when)


class NumberWatch(BlockCallback):
    """Checks the numbers of each step (or of a compiled block's last step) and the losses."""

    takes_blocks = True

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """Keep the training loop's variables without a copy, because this runs at each step."""
        self.locals = locals_

    def _on_training_start(self) -> None:
        when = f"at step {self.model.num_timesteps:,}"
        check_numbers(self.model._last_obs, "observation", when, in_rows=True)

    def _on_rollout_start(self) -> None:
        log = self.model.logger.name_to_value
        for name in _LOSSES:
            if name in log and not isfinite(log[name]):
                raise UserError(f"{name} at step {self.model.num_timesteps:,} is {log[name]}")

    def _on_step(self) -> bool:
        # Algorithms that play whole episodes, such as ARS, pass other variables.
        seen, when = self.locals, f"at step {self.num_timesteps:,}"
        check_numbers(seen.get("rewards"), "reward", when, in_rows=True)
        new_obs = seen.get("new_obs", seen.get("new_observations"))
        check_numbers(new_obs, "observation", when, in_rows=True)
        check_numbers(seen.get("actions"), "action", when, in_rows=True)
        dones = seen.get("dones")
        if dones is None or True not in (ended := dones.tolist()):
            return True
        # Observations before resets, and the returns in Monitor's records.
        for i, info in enumerate(seen["infos"]):
            if ended[i]:
                where = f"of an episode of environment {i} {when}"
                check_numbers(info.get("terminal_observation"), "last observation", where)
                check_numbers(info.get("episode", {}).get("r"), "return", where)
        return True
