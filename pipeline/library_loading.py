"""Libraries imported without looking for garbage among what they make, which all stays."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading_libraries() -> Iterator[None]:
    """Do without the garbage collector, and let it pass over what is there at the end.

    It would go through all that libraries consist of, again and again: a fifth of what importing
    them takes, and some of each training after it.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.freeze()
            gc.enable()
