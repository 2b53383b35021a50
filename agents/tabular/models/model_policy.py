"""The policy of agents on tables that learn a model: its model file holds that too."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from agents.tabular.models.learnt_models import LearntModel
from agents.tabular.q_table_policy import QTablePolicy
from safe_files.files import MAX_ARCHIVE_BYTES

# What is kept has to fit into a model file that is read again, with a little besides.
MOST_BYTES = MAX_ARCHIVE_BYTES * 15 // 16


class ModelPolicy(QTablePolicy):
    """Greedy in a table, with what was learnt of the environment beside it.

    Args:
        observation_space: `Discrete` with S values.
        action_space: `Discrete` with A values.
        lr_schedule: not used; here because every policy is handed one.
        n_tables: number of tables.
        outcomes_kept: room for outcomes of each pair of state and action, K.
        kwargs: as in `QTablePolicy`.

    Attributes:
        model_type: the NamedTuple of arrays that the model is.
        outcomes_kept: K.
    """

    model_type: ClassVar[Any] = LearntModel

    def __init__(
        self,
        observation_space: spaces.Discrete,
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        n_tables: int = 1,
        outcomes_kept: int = 1,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, lr_schedule, n_tables, **kwargs)
        self.outcomes_kept = 0
        self.keep_outcomes(outcomes_kept)

    def _sizes(self) -> dict[str, Any]:
        return {**super()._sizes(), "outcomes_kept": self.outcomes_kept}

    def keep_outcomes(self, n: int) -> None:
        """Make room for ``n`` outcomes of each pair; where n changes, what was learnt is forgotten.

        Raises:
            ValueError: if they would take too much memory.
        """
        most = self._most_outcomes()
        if n > most:
            raise ValueError(
                f"{n} outcomes of {self.visit_counts[0].numel()} pairs of state and action are too "
                f"many to keep: at most {most} of each"
            )
        if n != self.outcomes_kept:
            self.outcomes_kept = n
            n_states, n_actions = self.visit_counts.shape[1:]
            for name, array in self._nothing_learnt(n_states, n_actions, n).items():
                self.register_buffer(f"model_{name}", th.from_numpy(array))

    def _most_outcomes(self) -> int:
        """How many outcomes of each pair a model file has room for."""
        n_states, n_actions = self.visit_counts.shape[1:]
        with_one, with_two = (
            n_states * sum(a.nbytes for a in self._nothing_learnt(1, n_actions, n).values())
            for n in (1, 2)
        )
        tables = self.q_tables.nbytes + self.visit_counts.nbytes
        return max(1 + int((MOST_BYTES - tables - with_one) // (with_two - with_one)), 0)

    def _nothing_learnt(self, n_states: int, n_actions: int, n: int) -> dict[str, Any]:
        """The arrays of a model, by name, before anything was seen."""
        shape = n_states, n_actions, n
        return {
            "next_obs": np.zeros(shape, dtype=np.int64),
            "rewards": np.zeros(shape),
            "terminated": np.zeros(shape, dtype=np.bool_),
            "counts": np.zeros(shape[:2], dtype=np.int64),
            "pairs": np.zeros(n_states * n_actions, dtype=np.int64),
            "n_pairs": np.zeros(1, dtype=np.int64),
        }

    def _places(self, n_states: int, n_pairs: int) -> Mapping[str, tuple[int, int]]:
        """Which arrays hold numbers of states, of pairs or of places: the least, and the end."""
        return {
            "next_obs": (0, n_states),
            "pairs": (0, n_pairs),
            "n_pairs": (0, n_pairs + 1),
            "counts": (0, 2**62),
        }

    @property
    def model(self) -> Any:
        """What was learnt, as arrays that share the memory of the policy."""
        buffers: Any = self._buffers
        names: tuple[str, ...] = self.model_type._fields
        return self.model_type(*(buffers[f"model_{name}"].numpy() for name in names))

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Take over a table and a model.

        Raises:
            ValueError: if it is no model of these observations and actions, or holds another
                number of outcomes.
        """
        held = state_dict.get("model_next_obs")
        if getattr(held, "ndim", 0) == 3 and held.shape[2] != self.outcomes_kept:
            raise ValueError(
                f"holds a model with room for {held.shape[2]} outcomes of each pair of state and "
                f"action, and the settings ask for {self.outcomes_kept}: leave them as they were"
            )
        result = super().load_state_dict(state_dict, strict, assign)
        self.check_places()
        return result

    def check_shapes(self) -> None:
        """Refuse arrays of other shapes, which compiled code would read beside.

        Raises:
            ValueError: naming the first.
        """
        n_states, n_actions = self.visit_counts.shape[1:]
        expected = self._nothing_learnt(n_states, n_actions, self.outcomes_kept)
        for name, like in expected.items():
            found = getattr(self.model, name)
            if (found.dtype, found.shape) != (like.dtype, like.shape):
                raise ValueError(
                    f"model_{name} must be of shape {like.shape} and {like.dtype}, not "
                    f"{found.shape} and {found.dtype}"
                )

    def check_places(self) -> None:
        """Refuse a model that points beside its tables.

        Raises:
            ValueError: naming the array.
        """
        n_states, n_actions = self.visit_counts.shape[1:]
        for name, (least, end) in self._places(n_states, n_states * n_actions).items():
            numbers = getattr(self.model, name)
            if not ((numbers >= least) & (numbers < end)).all():
                raise ValueError(f"holds no model for these observations and actions: model_{name}")
