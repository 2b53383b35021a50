"""How large what is read may be, before anything is made of it."""

from __future__ import annotations

import contextlib
import os
import sys

# A model of a hundred million parameters is larger than any that these algorithms train.
MAX_ARCHIVE_BYTES = 1 << 30
MAX_MEMBERS = 64
MAX_TENSOR_RECORDS = 10_000
# The text of a model's settings, pickles included: genuine ones take some ten kilobytes, but for
# the last observations of many environments.
MAX_SETTINGS_BYTES = 64 << 20
# Instructions of a pickle, and values that it stands for with what is shared counted each time.
MAX_INSTRUCTIONS = 5_000_000
MAX_VALUES = 5_000_000
MAX_DEPTH = 40
# Of no use beyond this: counters of steps are far below.
MAX_INTEGER_BITS = 128
# A layer as wide as this is let through however few weights the file holds.
MAX_WIDTH = 1024
# Of a buffer.
MAX_ROWS = 1_000_000_000
MAX_STATISTICS_BYTES = 64 << 20
MAX_BUFFER_BYTES = 32 << 30
# Where no system tells; many machines have as much.
MEMORY_IF_UNKNOWN = 16 << 30


def memory_bytes() -> int:
    """Bytes of memory in this machine."""
    size = MEMORY_IF_UNKNOWN
    if sys.platform != "win32":
        with contextlib.suppress(ValueError, OSError):
            size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return size
