"""Records that are appended one by one, and lie in one array."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_FIRST_CAPACITY = 256


class GrowingRows:
    """Records of one type, as many as come.

    A list of tuples would hold the same; a state of the training is saved with it now and then, and
    an array is saved at once.

    Args:
        kind: the type of a record.
    """

    def __init__(self, kind: np.dtype[np.void]) -> None:
        self._rows: NDArray[np.void] = np.zeros(_FIRST_CAPACITY, dtype=kind)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    @property
    def rows(self) -> NDArray[np.void]:
        """All that was appended, shape (n,)."""
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
        """Forget all records but the chosen ones; bool of shape (n,)."""
        kept = self.rows[chosen]
        self._rows[: len(kept)] = kept
        self._n = len(kept)
