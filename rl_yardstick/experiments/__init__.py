"""Studies: agents on environments over seeds, from a file or flags to the results."""
