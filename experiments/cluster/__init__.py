"""Runs on many machines, on the workers of Dask distributed; `cluster_launcher` is the way in."""
