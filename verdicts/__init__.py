"""What scores over seeds say, and how sure they are: pure functions over arrays.

Runs that failed are given as NaN: they are left out and counted. Every function that draws random
numbers takes a seed, and the same seed gives the same figures. docs/statistics.md says which method
stands behind each figure, and why.

The functions are loaded on first use, since SciPy takes longer to import than a command may take to
answer.
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
        best_score,
        compare_speed,
        curve_band,
        final_score,
        on_grid,
        performance_profile,
        shared_grid,
        steps_to_stay,
        steps_to_threshold,
        summarise_steps,
    )
    from verdicts.error_levels import level_of_look
    from verdicts.failures import FailureCount, count_failures, fail_more_often, failure_threshold
    from verdicts.growth import Growth, grow, look_sizes
    from verdicts.pairs import (
        FEWEST_SEEDS,
        PairComparison,
        Verdict,
        compare_pairs,
        describe_pairs,
        fewest_seeds,
        judge_pairs,
        probability_of_improvement,
        seeds_needed,
    )
    from verdicts.rank_tests import (
        ahead_p_value,
        apart_p_value,
        equivalent_p_value,
        holm,
        paired_difference,
        typical_difference,
    )
    from verdicts.resampling import (
        Estimate,
        Statistic,
        Summary,
        estimate,
        gap_to_optimum,
        optimum_score,
        summarise,
    )

__all__ = [
    "FEWEST_SEEDS",
    "Band",
    "Estimate",
    "FailureCount",
    "Growth",
    "PairComparison",
    "SpeedComparison",
    "Statistic",
    "Summary",
    "ThresholdSummary",
    "Verdict",
    "ahead_p_value",
    "apart_p_value",
    "area_under_curve",
    "best_score",
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
    "final_score",
    "gap_to_optimum",
    "grow",
    "holm",
    "judge_pairs",
    "level_of_look",
    "look_sizes",
    "on_grid",
    "optimum_score",
    "paired_difference",
    "performance_profile",
    "probability_of_improvement",
    "seeds_needed",
    "shared_grid",
    "steps_to_stay",
    "steps_to_threshold",
    "summarise",
    "summarise_steps",
    "typical_difference",
]

_HOMES = {
    "PairComparison": "verdicts.pairs",
    "compare_pairs": "verdicts.pairs",
    "describe_pairs": "verdicts.pairs",
    "level_of_look": "verdicts.error_levels",
    "Estimate": "verdicts.resampling",
    "Statistic": "verdicts.resampling",
    "Summary": "verdicts.resampling",
    "estimate": "verdicts.resampling",
    "summarise": "verdicts.resampling",
    "FailureCount": "verdicts.failures",
    "count_failures": "verdicts.failures",
    "fail_more_often": "verdicts.failures",
    "failure_threshold": "verdicts.failures",
    "Growth": "verdicts.growth",
    "grow": "verdicts.growth",
    "look_sizes": "verdicts.growth",
    "probability_of_improvement": "verdicts.pairs",
    "FEWEST_SEEDS": "verdicts.pairs",
    "Verdict": "verdicts.pairs",
    "judge_pairs": "verdicts.pairs",
    "Band": "verdicts.curves",
    "ThresholdSummary": "verdicts.curves",
    "area_under_curve": "verdicts.curves",
    "best_score": "verdicts.curves",
    "curve_band": "verdicts.curves",
    "final_score": "verdicts.curves",
    "on_grid": "verdicts.curves",
    "shared_grid": "verdicts.curves",
    "steps_to_stay": "verdicts.curves",
    "steps_to_threshold": "verdicts.curves",
    "summarise_steps": "verdicts.curves",
    "holm": "verdicts.rank_tests",
    "paired_difference": "verdicts.rank_tests",
    "fewest_seeds": "verdicts.pairs",
    "seeds_needed": "verdicts.pairs",
    "performance_profile": "verdicts.curves",
    "ahead_p_value": "verdicts.rank_tests",
    "apart_p_value": "verdicts.rank_tests",
    "equivalent_p_value": "verdicts.rank_tests",
    "gap_to_optimum": "verdicts.resampling",
    "optimum_score": "verdicts.resampling",
    "SpeedComparison": "verdicts.curves",
    "compare_speed": "verdicts.curves",
    "typical_difference": "verdicts.rank_tests",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'verdicts' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
