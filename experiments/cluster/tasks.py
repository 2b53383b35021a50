"""The one function that Dask is told to call, on workers alone.

The scheduler has to import it, and so it imports nothing: what a run is, only workers know.
"""

from __future__ import annotations


def do_order(order: bytes) -> bytes:
    """Do the run of an `experiments.cluster.working.RunOrder`; the answer is of `.answers`."""
    from experiments.cluster.working import answer_to

    return answer_to(order)
