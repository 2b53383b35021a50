"""What the policies of hand-written agents share: saved and loaded by themselves."""

from __future__ import annotations

from typing import Any, Self

import torch as th
from stable_baselines3.common.policies import BasePolicy


class TablePolicy(BasePolicy):
    """A policy whose knowledge is in buffers, which live on the CPU."""

    def _sizes(self) -> dict[str, Any]:
        """Arguments of the constructor without which the buffers would have other shapes."""
        return {}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._sizes()}

    @classmethod
    def load(cls, path: str, device: th.device | str = "cpu") -> Self:
        """Load a policy that `save` wrote, which unpickles: load those that you trust.

        Args:
            path: where the file lies.
            device: ignored, as tables live on the CPU.
        """
        return super().load(path, "cpu")
