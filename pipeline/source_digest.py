"""Which sources something was made by: what other ones make of it may be something else."""

from __future__ import annotations

from functools import cache

from machine_code.sources import content_lines, digest_of, source_paths

# What the objects of a training, and what is recorded of them, are made by.
OF_TRAINING = ("safe_files", "machine_code", "mdp", "envs", "agents", "pipeline")


@cache
def source_digest(*more: str) -> str:
    """Of the packages `OF_TRAINING` and ``more``, as they are when it is first asked for."""
    return digest_of(content_lines(source_paths({*OF_TRAINING, *more})))
