"""How large what is read may be, before anything is made of it."""

from __future__ import annotations

import contextlib
import os
import sys

from safe_files.refusals import UnsafeFileError

# A model of a hundred million parameters is larger than any that these algorithms train.
MAX_ARCHIVE_BYTES = 1 << 30
MAX_STATISTICS_BYTES = 64 << 20
MAX_BUFFER_BYTES = 32 << 30
MAX_MEMBERS = 64
MAX_DEPTH = 40
MAX_DIMENSIONS = 32
# Of no use beyond this: counters of steps are far below.
MAX_INTEGER_BITS = 128
# Of a buffer.
MAX_ROWS = 1_000_000_000
# What may be made of a file: so many times its own bytes, and these.
TIMES = 4
FREE_BYTES = 64 << 20
# Of an empty dictionary, with its place in what holds it: no value takes more beside its text.
_BYTES_PER_JSON_VALUE = 100
# Where no system tells; many machines have as much.
MEMORY_IF_UNKNOWN = 16 << 30


class Budget:
    """The memory that one file may take: whoever makes something of it pays before.

    Args:
        n_bytes: size of the file.
    """

    def __init__(self, n_bytes: int) -> None:
        self.n_bytes = n_bytes
        self.left = FREE_BYTES + TIMES * n_bytes

    def charge(self, n_bytes: int) -> None:
        """Take so many bytes."""
        self.left -= n_bytes
        if self.left < 0:
            raise UnsafeFileError(
                f"would take more memory than {TIMES} times its {self.n_bytes:,} bytes and "
                f"{FREE_BYTES >> 20} MB"
            )

    def charge_json(self, text: bytes) -> None:
        """Take what Python makes of a text of JSON; see `charge`."""
        # Of characters that are not of ASCII, one can make all others four bytes wide.
        self.charge(len(text) * (2 if text.isascii() else 8))
        self.charge(sum(map(text.count, (b"[", b"{", b",", b":"))) * _BYTES_PER_JSON_VALUE)


def memory_bytes() -> int:
    """Bytes of memory in this machine."""
    size = MEMORY_IF_UNKNOWN
    if sys.platform != "win32":
        with contextlib.suppress(ValueError, OSError):
            size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return size
