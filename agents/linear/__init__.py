"""Agents on sums of weights of tiles, a table among them: action values and policy gradients."""
