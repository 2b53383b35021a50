"""Base classes and functions that all hand-written agents share."""
