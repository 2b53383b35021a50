"""One run: from a specification to a finished run folder, and playing what was trained."""
