"""Tabular, bandit and deep reinforcement learning, measured against the exact optimum."""
