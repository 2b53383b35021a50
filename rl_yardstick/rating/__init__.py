"""Rates what people already have: their Q-tables, models and functions, against the optimum."""
