"""What scores over seeds say: one word for each pair of agents, intervals, learning curves.

Pure functions over arrays; nothing is random. Runs without a figure are given as NaN: they are left
out and counted. docs/statistics.md names the method behind each figure, and the reasons for it.
"""

from rl_yardstick.verdicts.curves import (
    Band,
    ThresholdSummary,
    curve_band,
    on_grid,
    performance_profile,
    shared_grid,
    steps_to_threshold,
    summarise_steps,
)
from rl_yardstick.verdicts.estimates import (
    FEW,
    UNBOUNDED,
    Bounds,
    Estimate,
    Summary,
    mean_over_runs,
    summarise,
    unseen_share,
)
from rl_yardstick.verdicts.judging import (
    AgentRuns,
    Best,
    Pair,
    Study,
    Word,
    failure_threshold,
    judge,
)

__all__ = ["FEW", "UNBOUNDED", "AgentRuns", "Band", "Best", "Bounds", "Estimate", "Pair", "Study"]
__all__ += ["Summary", "ThresholdSummary", "Word", "curve_band", "failure_threshold", "judge"]
__all__ += ["mean_over_runs", "on_grid", "performance_profile", "shared_grid", "summarise"]
__all__ += ["steps_to_threshold", "summarise_steps", "unseen_share"]
