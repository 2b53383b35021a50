"""Whether the model that an environment brings is what it does."""
