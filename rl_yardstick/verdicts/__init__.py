"""What scores over seeds say: one word for each pair of agents, intervals, learning curves.

Pure functions over arrays; nothing is random. Runs without a figure are NaN: left out and counted.
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
    AgentRuns,
    Bounds,
    Estimate,
    Summary,
    failure_threshold,
    mean_over_runs,
    summarise,
    unseen_share,
)
from rl_yardstick.verdicts.judging import Best, Pair, Study, Word, judge

__all__ = ["FEW", "UNBOUNDED", "AgentRuns", "Band", "Best", "Bounds", "Estimate", "Pair", "Study"]
__all__ += ["Summary", "ThresholdSummary", "Word", "curve_band", "failure_threshold", "judge"]
__all__ += ["mean_over_runs", "on_grid", "performance_profile", "shared_grid", "summarise"]
__all__ += ["steps_to_threshold", "summarise_steps", "unseen_share"]
