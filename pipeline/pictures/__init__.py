"""Pictures of a run: its learning curve, its pulls, its policy on the map."""
