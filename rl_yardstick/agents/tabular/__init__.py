"""Tabular temporal-difference agents as Stable-Baselines3 algorithms."""
