"""Where on the map an agent acts well: recorded at evaluations, and drawn."""
