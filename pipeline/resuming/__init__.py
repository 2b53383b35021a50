"""A training that was cut off, gone on with to the result that it would have had undisturbed."""
