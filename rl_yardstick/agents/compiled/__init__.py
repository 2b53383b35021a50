"""The compiled engine: environments, random streams, the training loop, batches of runs."""
