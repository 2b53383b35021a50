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
    from verdicts.comparisons import PairComparison, compare_pairs, describe_pairs
    from verdicts.error_levels import level_of_look
    from verdicts.estimates import Estimate, Statistic, Summary, estimate, summarise
    from verdicts.failures import FailureCount, count_failures, fail_more_often, failure_threshold
    from verdicts.growth import Growth, grow, look_sizes
    from verdicts.improvement import probability_of_improvement
    from verdicts.judgement import FEWEST_SEEDS, Verdict, judge_pairs
    from verdicts.learning_curves import (
        Band,
        ThresholdSummary,
        area_under_curve,
        best_score,
        curve_band,
        final_score,
        on_grid,
        shared_grid,
        steps_to_stay,
        steps_to_threshold,
        summarise_steps,
    )
    from verdicts.paired import holm, paired_difference
    from verdicts.power import fewest_seeds, seeds_needed
    from verdicts.profiles import performance_profile
    from verdicts.rank_tests import ahead_p_value, apart_p_value, equivalent_p_value
    from verdicts.scores import gap_to_optimum, optimum_score
    from verdicts.speed import SpeedComparison, compare_speed
    from verdicts.typical import typical_difference

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
    "PairComparison": "verdicts.comparisons",
    "compare_pairs": "verdicts.comparisons",
    "describe_pairs": "verdicts.comparisons",
    "level_of_look": "verdicts.error_levels",
    "Estimate": "verdicts.estimates",
    "Statistic": "verdicts.estimates",
    "Summary": "verdicts.estimates",
    "estimate": "verdicts.estimates",
    "summarise": "verdicts.estimates",
    "FailureCount": "verdicts.failures",
    "count_failures": "verdicts.failures",
    "fail_more_often": "verdicts.failures",
    "failure_threshold": "verdicts.failures",
    "Growth": "verdicts.growth",
    "grow": "verdicts.growth",
    "look_sizes": "verdicts.growth",
    "probability_of_improvement": "verdicts.improvement",
    "FEWEST_SEEDS": "verdicts.judgement",
    "Verdict": "verdicts.judgement",
    "judge_pairs": "verdicts.judgement",
    "Band": "verdicts.learning_curves",
    "ThresholdSummary": "verdicts.learning_curves",
    "area_under_curve": "verdicts.learning_curves",
    "best_score": "verdicts.learning_curves",
    "curve_band": "verdicts.learning_curves",
    "final_score": "verdicts.learning_curves",
    "on_grid": "verdicts.learning_curves",
    "shared_grid": "verdicts.learning_curves",
    "steps_to_stay": "verdicts.learning_curves",
    "steps_to_threshold": "verdicts.learning_curves",
    "summarise_steps": "verdicts.learning_curves",
    "holm": "verdicts.paired",
    "paired_difference": "verdicts.paired",
    "fewest_seeds": "verdicts.power",
    "seeds_needed": "verdicts.power",
    "performance_profile": "verdicts.profiles",
    "ahead_p_value": "verdicts.rank_tests",
    "apart_p_value": "verdicts.rank_tests",
    "equivalent_p_value": "verdicts.rank_tests",
    "gap_to_optimum": "verdicts.scores",
    "optimum_score": "verdicts.scores",
    "SpeedComparison": "verdicts.speed",
    "compare_speed": "verdicts.speed",
    "typical_difference": "verdicts.typical",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'verdicts' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
