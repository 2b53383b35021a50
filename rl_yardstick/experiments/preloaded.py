"""The import that `pool` forks its workers from; it changes how a process collects and ends."""

import atexit
import gc
import os

gc.set_threshold(100_000)  # importing the libraries makes many objects that stay
atexit.register(os._exit, 0)  # clearing them would take as long as a short run

from rl_yardstick.experiments import pool  # noqa: E402, F401
from rl_yardstick.machine_code.compiling import load_libraries  # noqa: E402
from rl_yardstick.pipeline import training  # noqa: E402, F401

load_libraries()
gc.freeze()
