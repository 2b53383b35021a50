"""Finds, inspects, loads, continues and saves models on disk."""
