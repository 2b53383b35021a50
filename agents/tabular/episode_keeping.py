"""What a tabular agent keeps beside its tables, for the episodes under way or for good."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.compiled.training_records import UNDECIDED
from agents.tabular.mask_keeping import MaskKeeper
from mdp.array_types import Ints


class EpisodeKeeper(MaskKeeper):
    """Remembers between two steps: actions that were committed to, and the algorithm's own memory.

    The memory is a NamedTuple of arrays, which compiled functions are handed as ``agent.memory``
    and work on in place. What belongs to episodes under way has a row for each environment. Neither
    is part of a model file: what is learnt for good belongs into buffers of the policy, which
    `_memory_in_use` may put beside it. States of a training, to resume from, hold all of it.

    Raises:
        ValueError: while learning, if the memory is not of the shapes that the settings ask for.
    """

    _rebuilt = (*MaskKeeper._rebuilt, "_memory", "_next_actions")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._next_actions: Ints = np.empty(0, dtype=np.int64)
        self._memory: tuple[Any, ...] = ()
        super().__init__(*args, **kwargs)

    def _make_memory(self) -> tuple[Any, ...]:
        """A memory of nothing, for ``n_envs`` environments."""
        return ()

    def _memory_in_use(self) -> tuple[Any, ...]:
        """What compiled functions are handed; their algorithm's memory, unless it says more."""
        return self._memory

    def _check_memory(self) -> None:
        """Refuse a memory that compiled code would read beside.

        Raises:
            ValueError: naming the array, and what it must be.
        """
        expected: Any = self._make_memory()
        if type(self._memory) is not type(expected):
            raise ValueError(f"the agent's memory must be a {type(expected).__name__}")
        for name, found, like in zip(
            getattr(expected, "_fields", ()), self._memory, expected, strict=True
        ):
            if (found.dtype, found.shape) != (like.dtype, like.shape):
                raise ValueError(
                    f"the agent's memory was made for other settings: {name} must be of shape "
                    f"{like.shape} and {like.dtype}, not {found.shape} and {found.dtype}"
                )

    def _begin_episodes(self) -> None:
        self._next_actions = np.full(self.n_envs, UNDECIDED)
        self._memory = self._make_memory()

    def hand_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Write what the compiled loop goes on from into its records."""
        envs["next_action"] = self._next_actions

    def take_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Go on from where the compiled loop is."""
        self._next_actions = envs["next_action"].copy()
