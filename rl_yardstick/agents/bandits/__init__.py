"""Bandit agents: a score for each arm in each context, or a linear model for each arm."""
