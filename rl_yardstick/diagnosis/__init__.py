"""Why an agent is not optimal, and whether an algorithm is right."""
