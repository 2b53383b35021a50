"""Evaluates policies: by sampled episodes, exactly, and for each cell of a map."""
