"""What scores over seeds say: one word for each pair of agents, intervals, learning curves.

Pure functions over arrays; nothing is random. Runs without a figure are given as NaN: they are left
out and counted. docs/statistics.md names the method behind each figure, and the reasons for it.
Functions are imported on first use: SciPy would delay commands that do not need them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from verdicts.curves import (
        Band,
        ThresholdSummary,
        area_under_curve,
        curve_band,
        on_grid,
        performance_profile,
        shared_grid,
        steps_to_threshold,
        summarise_steps,
    )
    from verdicts.estimates import (
        FEW,
        UNBOUNDED,
        Bounds,
        Estimate,
        Summary,
        mean_over_runs,
        summarise,
        unseen_share,
    )
    from verdicts.judging import (
        AgentRuns,
        Best,
        Pair,
        Study,
        Word,
        failure_threshold,
        judge,
        look_sizes,
    )

__all__ = ["FEW", "UNBOUNDED", "AgentRuns", "Band", "Best", "Bounds", "Estimate", "Pair", "Study"]
__all__ += ["Summary", "ThresholdSummary", "Word", "area_under_curve", "curve_band"]
__all__ += ["failure_threshold", "judge", "look_sizes", "mean_over_runs", "on_grid"]
__all__ += ["performance_profile", "shared_grid", "steps_to_threshold", "summarise"]
__all__ += ["summarise_steps", "unseen_share"]


def __getattr__(name: str) -> object:
    for module in ("estimates", "judging", "curves") if name in __all__ else ():
        found = importlib.import_module(f"verdicts.{module}")
        if hasattr(found, name):
            return getattr(found, name)
    raise AttributeError(f"module 'verdicts' has no attribute {name!r}")
