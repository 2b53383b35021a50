"""Figures of a study for a paper."""
