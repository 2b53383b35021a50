"""Libraries imported without the garbage collector; apart since commands need it at once."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def loading_libraries() -> Iterator[None]:
    """Do without the garbage collector, and let it pass over what is there at the end.

    It takes a fifth of what importing libraries takes, and some of each training after it.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.freeze()
            gc.enable()


def load_for_optimizer(model: Any) -> None:
    """Import what PyTorch's optimizers import at their first step: its compiler, which stays idle.

    That takes more than a second; nothing is imported for an agent that may do without such steps.
    """
    has_optimizer = getattr(getattr(model, "policy", None), "optimizer", None) is not None
    if has_optimizer and getattr(model, "engine", "library") == "library":
        with loading_libraries():
            import torch._dynamo  # noqa: F401
