"""Runs on many machines, by Dask distributed.

The one function that Dask is told to call stands here: the scheduler has to import it, and so this
imports nothing. What a run is, only workers know.
"""

from __future__ import annotations


def do_order(order: bytes) -> bytes:
    """Do the run of an `experiments.cluster.working.RunOrder`; the answer is of `.answers`."""
    from experiments.cluster.working import answer_to

    return answer_to(order)
