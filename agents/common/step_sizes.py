"""How far an estimate moves towards its target.

Sutton and Barto (2nd edition), section 2.4 (sample averages) and 2.5 (constant step size).
"""

from __future__ import annotations

from machine_code.compiling import inlined

SAMPLE_AVERAGE = "sample_average"


@inlined
def step_size(learning_rate: float, sample_average: bool, visit_count: int) -> float:
    """1/N for the N-th visit where ``sample_average``, else the learning rate.

    Args:
        learning_rate: the constant or scheduled step size.
        sample_average: whether to average all targets seen so far.
        visit_count: number of visits, this one included.
    """
    if sample_average:
        return 1.0 / visit_count
    return learning_rate
