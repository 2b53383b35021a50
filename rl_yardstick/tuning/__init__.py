"""Searches for settings: search spaces, trials over several seeds, and the re-test of the best."""
