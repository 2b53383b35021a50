"""Preloads slow imports into the fork server, so that runs need not repeat them.

Imports take two seconds, and loading compiled loops half a second: a short training does both. If
nothing is compiled yet, this module compiles it.
"""

from __future__ import annotations

import contextlib
import os

from rl_yardstick.experiments.child_processes import OUR_OWN, WARM_UPS, leave_signals_to_supervisor
from rl_yardstick.pipeline import loading_libraries


def _warm_up() -> None:
    from rl_yardstick.experiments.run_in_child import take_steps, train_aside
    from rl_yardstick.pipeline.settings.hyperparams import split
    from rl_yardstick.pipeline.train_spec import TrainSpec

    raw = {"n_timesteps": 100}
    # If this fails, for example without disk space, each run compiles for itself.
    with contextlib.suppress(Exception):
        train_aside(TrainSpec("qlearning", "Warehouse-v0", split(raw), raw, 0, eval_freq=50))
    take_steps(os.environ.pop(WARM_UPS, "[]"))


leave_signals_to_supervisor()
if os.environ.get("PYTHONSAFEPATH") == OUR_OWN:
    del os.environ["PYTHONSAFEPATH"]  # programs that a run starts search modules as usual
with loading_libraries():
    _warm_up()
