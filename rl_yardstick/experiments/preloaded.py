"""The import that `pool` forks its workers from; it changes how a process collects and ends."""

import atexit
import gc
import os

gc.set_threshold(100_000)  # importing the libraries makes many objects that stay
atexit.register(os._exit, 0)  # clearing them would take as long as a short run

from numba.core.registry import cpu_target  # noqa: E402

from rl_yardstick.experiments import pool  # noqa: E402, F401
from rl_yardstick.pipeline import training  # noqa: E402, F401

cpu_target.target_context.refresh()  # what Numba needs for any function
gc.freeze()
