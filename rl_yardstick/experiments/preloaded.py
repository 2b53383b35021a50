"""What the workers of `pool` are forked from: a process that imports this has all libraries.

Importing it changes how the process collects garbage, and how it ends, so that it is a module of
its own.
"""

import atexit
import gc
import os

gc.set_threshold(100_000)  # importing the libraries makes many objects that stay
atexit.register(os._exit, 0)  # clearing them at the end would take as long as a short run

from rl_yardstick.experiments import pool  # noqa: E402, F401
from rl_yardstick.machine_code.compiling import load_libraries  # noqa: E402
from rl_yardstick.pipeline import training  # noqa: E402, F401

load_libraries()
gc.freeze()
