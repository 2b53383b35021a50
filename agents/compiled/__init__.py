"""The compiled engine: environments, random streams, the loop, batches of runs."""
