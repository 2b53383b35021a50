"""Compiling with Numba: decorators, a cache of machine code keyed by sources, compile times."""

from __future__ import annotations

import time
from dataclasses import dataclass


@dataclass(frozen=True)
class WorkTime:
    """A duration."""

    seconds: float = 0.0  # wall-clock time
    cpu_seconds: float = 0.0  # CPU time of all threads of this process, without child processes

    @classmethod
    def now(cls) -> WorkTime:
        """The current clock readings; only the difference of two of them has a meaning."""
        return cls(time.monotonic(), time.process_time())

    def __add__(self, other: WorkTime) -> WorkTime:
        return WorkTime(self.seconds + other.seconds, self.cpu_seconds + other.cpu_seconds)

    def __sub__(self, other: WorkTime) -> WorkTime:
        return WorkTime(self.seconds - other.seconds, self.cpu_seconds - other.cpu_seconds)

    def as_data(self) -> dict[str, float]:
        """The fields as in ``run.json``, rounded to milliseconds."""
        return {name: round(value, 3) for name, value in vars(self).items()}
