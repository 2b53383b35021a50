"""Compiling with Numba: decorators, a cache of machine code keyed by sources, and its timing.

The package knows no other one of this project. A package whose machine code is to be kept on disk
says so with `machine_code.sources.keep_machine_code`, and names the sources that decide about it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass


@dataclass(frozen=True)
class WorkTime:
    """A duration."""

    seconds: float = 0.0  # by the clock
    # That the processor spent on this process, all threads together, its children left out; on a
    # busy machine less than ``seconds``, with several threads maybe more.
    cpu_seconds: float = 0.0

    @classmethod
    def now(cls) -> WorkTime:
        """A moment to count from; only the difference of two has a meaning."""
        return cls(time.monotonic(), time.process_time())

    def __add__(self, other: WorkTime) -> WorkTime:
        return WorkTime(self.seconds + other.seconds, self.cpu_seconds + other.cpu_seconds)

    def __sub__(self, other: WorkTime) -> WorkTime:
        return WorkTime(self.seconds - other.seconds, self.cpu_seconds - other.cpu_seconds)

    def as_data(self) -> dict[str, float]:
        """As ``run.json`` has it, in milliseconds' precision."""
        return {name: round(value, 3) for name, value in vars(self).items()}
