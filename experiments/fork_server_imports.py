"""Imported by the server that runs are forked from, so that what takes long is done once.

Imports alone take two seconds, and loading the compiled loops half a second: a short training does
both. Where nothing is compiled yet, it is done here too.
"""

from __future__ import annotations

import contextlib
import os

from experiments.child_processes import OUR_OWN, WARM_UPS, leave_signals_to_supervisor
from pipeline import loading_libraries


def _warm_up() -> None:
    from experiments.run_in_child import take_steps, train_aside
    from pipeline.settings.hyperparams import split
    from pipeline.train_spec import TrainSpec

    raw = {"n_timesteps": 100}
    # Where it fails, as without room for temporary files, runs compile for themselves.
    with contextlib.suppress(Exception):
        train_aside(TrainSpec("qlearning", "Warehouse-v0", split(raw), raw, 0, eval_freq=50))
    take_steps(os.environ.pop(WARM_UPS, "[]"))


leave_signals_to_supervisor()
if os.environ.get("PYTHONSAFEPATH") == OUR_OWN:
    del os.environ["PYTHONSAFEPATH"]  # what a run starts is to find its modules as usual
with loading_libraries():
    _warm_up()
