"""Methods on tables that learn from more than one step: returns, several steps, traces."""
