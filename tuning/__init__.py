"""Settings searched for: spaces of them, trials over several seeds, and the re-test of what won."""
