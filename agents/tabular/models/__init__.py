"""Methods on tables that learn a model of the environment, and plan on it."""
