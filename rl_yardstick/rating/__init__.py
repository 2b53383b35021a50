"""Rates what people already have: their Q-tables, models and functions, against the optimum."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rl_yardstick.rating.ratings import Rating, rate

__all__ = ["Rating", "rate"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'rl_yardstick.rating' has no attribute {name!r}")
    from rl_yardstick.rating import ratings

    return getattr(ratings, name)
