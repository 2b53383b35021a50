"""What the policies of hand-written agents share: saved and loaded by themselves."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import torch as th
from stable_baselines3.common.policies import BasePolicy

from agents.common.serialization import decode, encode
from safe_files.files import MAX_ARCHIVE_BYTES, Budget, UnsafeFileError, read_file
from safe_files.known_objects import check_values, load_tensors
from safe_files.models import charged_tensors


class TablePolicy(BasePolicy):
    """A policy whose knowledge is in buffers, which live on the CPU."""

    def _sizes(self) -> dict[str, Any]:
        """Arguments of the constructor without which the buffers would have other shapes."""
        return {}

    @classmethod
    def _remade(cls, arguments: Mapping[str, Any]) -> Self:
        """A new policy from its spaces and what `_sizes` said."""
        return cls(**arguments)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._sizes()}

    def save(self, path: str) -> None:
        """Write tensors, and what else the policy is made of as JSON: no pickle that is run.

        Args:
            path: where to.
        """
        data = {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            **self._sizes(),
        }
        text = json.dumps({name: encode(value) for name, value in data.items()})
        th.save({"state_dict": self.state_dict(), "data": text}, path)

    @classmethod
    def load(cls, path: str, device: th.device | str = "cpu") -> Self:
        """Load a policy that `save` wrote; nothing in the file is run.

        Args:
            path: where the file lies.
            device: ignored, as tables live on the CPU.

        Raises:
            ValueError: if the file holds anything else.
        """
        content = read_file(Path(path), MAX_ARCHIVE_BYTES)
        budget = Budget(len(content))
        saved = load_tensors(content, budget)
        if not (isinstance(saved, dict) and isinstance(saved.get("data"), str)):
            raise UnsafeFileError(f"{path} holds no policy of this kind")
        check_values({"the policy": saved.get("state_dict")})
        budget.charge_json(saved["data"].encode())
        try:
            data = {name: decode(value) for name, value in json.loads(saved["data"]).items()}
            with charged_tensors(budget):
                policy = cls._remade(data)
            policy.load_state_dict(saved["state_dict"])
        except (TypeError, LookupError, AttributeError, RuntimeError, AssertionError) as error:
            raise UnsafeFileError(f"{path} holds no {cls.__name__}: {error}") from error
        policy.set_training_mode(False)
        return policy
