"""What planning costs as the warehouse grows: seconds and memory, from 10x10 to 1000x1000 cells.

    python benchmarks/planning_scale.py

Each line is undiscounted value iteration on a random warehouse in a fresh process, whose peak of
memory is that of the whole work: interpreter, map, model, plan. Functions are compiled before the
clock starts.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from typing import Any

SIZES = (10, 30, 100, 300, 1000)
SLIPS = (0.0, 0.1)


def measure(size: int, slip: float) -> dict[str, Any]:
    """Make a random warehouse, build its model, plan; seconds of each, and the peak of memory."""
    import envs.warehouse
    from mdp import value_iteration

    make = envs.warehouse.RandomWarehouseEnv
    value_iteration(make(size=4, slip=slip).transition_model(), discount=1.0)
    started = time.perf_counter()
    env = make(size=size, slip=slip)
    made = time.perf_counter()
    model = env.transition_model()
    modelled = time.perf_counter()
    before = peak_mib()
    plan = value_iteration(model, discount=1.0)
    planned = time.perf_counter()
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
    columns = "     cells  slip  map s  model s  plan s  sweeps  MiB before  MiB peak"
    print(columns + "      optimum  error below")
    for slip in SLIPS:
        for size in SIZES:
            command = [sys.executable, __file__, str(size), str(slip)]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            row = json.loads(done.stdout)
            print(
                f"{size:>5}x{size:<5} {slip:4.1f} {row['make']:6.2f} {row['model']:8.3f} "
                f"{row['plan']:7.3f} {row['sweeps']:7} {row['before']:11.0f} {row['peak']:9.0f} "
                f"{row['value']:12.4f} {row['bound']:12.1e}"
            )


if __name__ == "__main__":
    if len(sys.argv) == 3:
        print(json.dumps(measure(int(sys.argv[1]), float(sys.argv[2]))))
    else:
        main()
