"""Limits of time and memory for a run, and checks of its process.

Memory means the resident set, which is checked a few times a second. The system's limit on the
address space would be exact, but networks and compiled code reserve many times the memory that
they use.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rl_yardstick.pipeline.errors import UserError

SECONDS_BETWEEN_LOOKS = 0.25
LONGEST = 10**9  # seconds
LEAST_MEMORY, MOST_MEMORY = 10**6, 10**18  # bytes

_SECONDS = {"": 1, "s": 1, "m": 60, "min": 60, "h": 3600, "d": 86400}
_BYTES = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "tb": 10**12}
_BYTES |= {"kib": 2**10, "mib": 2**20, "gib": 2**30, "tib": 2**40}
_QUANTITY = re.compile(r"([0-9]{1,30}(?:\.[0-9]{1,30})?)\s*([a-zA-Z]*)")


def seconds(text: str) -> float:
    """Parse a time such as ``90``, ``90s``, ``10m``, ``1.5h``, to seconds.

    Raises:
        ValueError: for any other text.
    """
    value = _quantity(text, _SECONDS)
    if not 0 < value <= LONGEST:
        raise ValueError(f"must be a time such as 90s, 10m or 2h, not {text!r}")
    return value


def memory(text: str) -> int:
    """Parse a size such as ``500MB`` (millions of bytes), ``4GB`` or ``4GiB``, to bytes.

    Raises:
        ValueError: for any other text.
    """
    value = _quantity(text, _BYTES)
    if not LEAST_MEMORY <= value <= MOST_MEMORY:
        raise ValueError(f"must be a size of at least 1MB, such as 500MB or 4GB, not {text!r}")
    return int(value)


def _quantity(text: str, units: dict[str, int]) -> float:
    """Parse a number with a unit; nan if it is invalid."""
    match = _QUANTITY.fullmatch(text.strip())
    unit = units.get(match[2].lower()) if match else None
    return math.nan if match is None or unit is None else float(match[1]) * unit


@dataclass(frozen=True)
class RunLimits:
    """The limits of a run.

    Raises:
        UserError: if memory cannot be measured here.
    """

    seconds: float | None = None  # from the start of its process; None for no limit
    memory: int | None = None  # bytes of resident memory; None for no limit
    is_wanted: Callable[[], bool] | None = None  # ends a run that is no longer wanted

    def __post_init__(self) -> None:
        if self.memory is not None and sys.platform == "win32":
            raise UserError("run_memory: what a process takes is not measured on Windows")

    @property
    def pause(self) -> float | None:
        """Seconds between two checks; None if there is nothing to check."""
        return None if self == RunLimits() else SECONDS_BETWEEN_LOOKS

    def exceeded(self, pid: int, elapsed: float) -> str:
        """The limit that a process exceeds after ``elapsed`` seconds, in words; empty for none."""
        if self.is_wanted is not None and not self.is_wanted():
            return "nobody waits for it any more"
        if self.seconds is not None and elapsed > self.seconds:
            return f"took longer than --run-timeout allows, {self.seconds:g} s"
        if self.memory is not None:
            taken = resident_memory(pid)
            if taken > self.memory:
                return (
                    f"took {_size(taken)} of memory after {elapsed:.0f} s; "
                    f"--run-memory allows {_size(self.memory)}"
                )
        return ""


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.3g} GB" if n_bytes >= 10**9 else f"{n_bytes / 1e6:.3g} MB"


def resident_memory(pid: int) -> int:
    """The resident memory of a process in bytes; 0 if it does not exist."""
    status = Path(f"/proc/{pid}/status")
    try:
        if not Path("/proc/self/status").exists():
            command = ["ps", "-o", "rss=", "-p", str(pid)]  # macOS has no /proc
            ps = subprocess.run(command, capture_output=True, check=True)  # noqa: S603  # a number
            return int(ps.stdout) * 1024
        found = re.search(r"^VmRSS:\s*(\d+) kB", status.read_text(encoding="utf-8"), re.MULTILINE)
    except (OSError, ValueError, subprocess.CalledProcessError):
        return 0
    return int(found[1]) * 1024 if found else 0
