"""Does runs on many machines, by Dask distributed.

This module has the only function that Dask calls. The scheduler has to import the module too, so it
imports nothing at the top. Only workers import the code of runs.
"""

from __future__ import annotations


def do_order(order: bytes) -> bytes:
    """Do the run of an `experiments.cluster.working.RunOrder`; returns a packed `Answer`."""
    from rl_yardstick.experiments.cluster.working import answer_to

    return answer_to(order)
