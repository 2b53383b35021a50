"""Studies: agents on environments over seeds, from a file or flags to what came out."""
