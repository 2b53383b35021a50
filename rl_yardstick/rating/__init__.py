"""Rates what people already have: their Q-tables, models and functions, against the optimum."""

from rl_yardstick.rating.ratings import Rating, rate

__all__ = ["Rating", "rate"]
