"""MABWiser's bandits behind the interface of the others."""
