"""What planning costs as the warehouse grows, by discount: seconds and memory, to 1000x1000 cells.

    python benchmarks/planning_scale.py

Each line is value iteration on a random warehouse in a fresh process, whose peak of memory is that
of the whole work: interpreter, map, model, plan. Seconds are of processor time with one thread:
several wait for each other, which counts as work. Functions are compiled before the clock starts.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from itertools import product
from typing import Any

SIZES = (100, 300, 1000)
SLIPS = (0.0, 0.1)
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}
DISCOUNTS = (0.9, 0.99, 0.999, 1.0)


def measure(size: int, slip: float, discount: float) -> dict[str, Any]:
    """Make a random warehouse, build its model, plan; seconds of each, and the peak of memory."""
    import envs.warehouse
    from mdp import value_iteration

    make = envs.warehouse.RandomWarehouseEnv
    for size_before in (4, 100):  # the second may ask for linear systems
        value_iteration(make(size=size_before, slip=slip).transition_model(), discount)
    started = time.process_time()
    env = make(size=size, slip=slip)
    made = time.process_time()
    model = env.transition_model()
    modelled = time.process_time()
    before = peak_mib()
    plan = value_iteration(model, discount)
    planned = time.process_time()
    return {
        "make": made - started,
        "model": modelled - made,
        "plan": planned - modelled,
        "before": before,
        "peak": peak_mib(),
        "sweeps": plan.iterations,
        "value": plan.start_value,
        "bound": plan.error_bound,
    }


def peak_mib() -> float:
    """The largest amount of memory that this process has held, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print the table."""
    columns = "     cells  slip  discount  map s  model s  plan s  sweeps  MiB before  MiB peak"
    print(columns + "      optimum  error below")
    for slip, size, discount in product(SLIPS, SIZES, DISCOUNTS):
        command = [sys.executable, __file__, str(size), str(slip), str(discount)]
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=ENVIRONMENT)
        row = json.loads(done.stdout)
        print(
            f"{size:>5}x{size:<5} {slip:4.1f} {discount:9} {row['make']:6.2f} {row['model']:8.3f} "
            f"{row['plan']:7.3f} {row['sweeps']:7} {row['before']:11.0f} {row['peak']:9.0f} "
            f"{row['value']:12.4f} {row['bound']:12.1e}"
        )


if __name__ == "__main__":
    if len(sys.argv) == 4:
        print(json.dumps(measure(int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]))))
    else:
        main()
