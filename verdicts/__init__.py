"""Statistics of scores over seeds, with intervals and verdicts: pure functions over arrays.

Failed runs are given as NaN: they are left out and counted. Every function that draws random
numbers takes a seed, and the same seed gives the same figures. docs/statistics.md names the method
behind each figure, and the reasons for it.

The functions are imported on first use: importing SciPy takes longer than some commands.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from verdicts.curves import (
        Band,
        SpeedComparison,
        ThresholdSummary,
        area_under_curve,
        compare_speed,
        curve_band,
        on_grid,
        performance_profile,
        shared_grid,
        steps_to_stay,
        steps_to_threshold,
        summarise_steps,
    )
    from verdicts.error_levels import level_of_claim, level_of_environment, level_of_look
    from verdicts.failures import FailureCount, count_failures, fail_more_often, failure_threshold
    from verdicts.growth import Growth, grow, look_sizes
    from verdicts.means import (
        FEWEST_SEEDS,
        MeanDifference,
        MeanVerdict,
        Verdict,
        ahead_on_average,
        compare_means,
        judge_means,
        mean_interval,
        rank_by_mean,
        seeds_needed,
    )
    from verdicts.pairs import (
        Ends,
        Judgement,
        PairComparison,
        compare_pairs,
        describe_pairs,
        fewest_seeds,
        judge_pairs,
        probability_of_improvement,
    )
    from verdicts.rank_tests import (
        ahead_p_value,
        apart_p_value,
        equivalent_p_value,
        holm,
        paired_difference,
    )
    from verdicts.resampling import (
        Estimate,
        Statistic,
        Summary,
        estimate,
        optimum_score,
        summarise,
    )

__all__ = [
    "FEWEST_SEEDS",
    "Band",
    "Ends",
    "Estimate",
    "FailureCount",
    "Growth",
    "Judgement",
    "MeanDifference",
    "MeanVerdict",
    "PairComparison",
    "SpeedComparison",
    "Statistic",
    "Summary",
    "ThresholdSummary",
    "Verdict",
    "ahead_on_average",
    "ahead_p_value",
    "apart_p_value",
    "area_under_curve",
    "compare_means",
    "compare_pairs",
    "compare_speed",
    "count_failures",
    "curve_band",
    "describe_pairs",
    "equivalent_p_value",
    "estimate",
    "fail_more_often",
    "failure_threshold",
    "fewest_seeds",
    "grow",
    "holm",
    "judge_means",
    "judge_pairs",
    "level_of_claim",
    "level_of_environment",
    "level_of_look",
    "look_sizes",
    "mean_interval",
    "on_grid",
    "optimum_score",
    "paired_difference",
    "performance_profile",
    "probability_of_improvement",
    "rank_by_mean",
    "seeds_needed",
    "shared_grid",
    "steps_to_stay",
    "steps_to_threshold",
    "summarise",
    "summarise_steps",
]

# Cheap imports come first: a command may need one of their names before it has time for SciPy.
_MODULES = (
    *("error_levels", "resampling", "rank_tests", "means"),
    *("pairs", "failures", "curves", "growth"),
)


def __getattr__(name: str) -> object:
    for module in _MODULES if name in __all__ else ():
        found = importlib.import_module(f"verdicts.{module}")
        if hasattr(found, name):
            return getattr(found, name)
    raise AttributeError(f"module 'verdicts' has no attribute {name!r}")
