"""From a specification to a finished run folder."""
