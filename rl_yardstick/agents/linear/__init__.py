"""Linear agents on tile coding or tables: action values and policy gradients."""
