"""What libraries raise where the machine has no memory, process or thread left to give."""

from __future__ import annotations

from pipeline.errors import one_line

# PyTorch's allocator, the dynamic linker, and Python's threads have no exception of their own.
_SIGNS = {
    "can't allocate memory": "memory",
    "cannot allocate memory": "memory",
    "failed to map segment": "memory",
    "out of memory": "memory",
    "can't start new thread": "threads or processes",
}


def exhaustion(error: BaseException) -> str | None:
    """Say in one line what the machine has run out of; None where that was not it."""
    text = one_line(error)
    if isinstance(error, MemoryError):
        detail = "" if text == type(error).__name__ else f": {text}"
        return f"this machine gives no more memory{detail}"
    for sign, what in _SIGNS.items():
        if sign in text.lower():
            return f"this machine gives no more {what}: {text}"
    return None
