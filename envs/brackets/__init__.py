"""Between which returns the optimum lies where states are continuous, and how that was found."""
