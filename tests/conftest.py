"""What holds for every test: no window, one thread, unhurried property tests."""

import os

import hypothesis

# Set before anything imports pygame, Matplotlib or PyTorch; child processes inherit them.
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["MPLBACKEND"] = "Agg"
for library in ("OMP", "MKL", "OPENBLAS", "NUMBA"):
    os.environ[f"{library}_NUM_THREADS"] = "1"

# No deadline: the first example of a compiled function pays for its compilation. In CI the examples
# are the same every time, so that a failure there can be repeated.
hypothesis.settings.register_profile("yardstick", deadline=None, derandomize="CI" in os.environ)
hypothesis.settings.load_profile("yardstick")
