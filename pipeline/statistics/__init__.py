"""What scores over seeds say, and how sure they are: pure functions over arrays.

Runs that failed are given as NaN: they are left out and counted. Every function that draws random
numbers takes a seed, and the same seed gives the same figures. docs/statistics.md says which method
stands behind each figure, and why.
"""

from pipeline.statistics.comparisons import PairComparison, Verdict, compare_pairs
from pipeline.statistics.curves import (
    Band,
    ThresholdSummary,
    area_under_curve,
    best_score,
    curve_band,
    final_score,
    on_grid,
    shared_grid,
    steps_to_threshold,
    summarise_steps,
)
from pipeline.statistics.estimates import Estimate, Statistic, Summary, estimate, summarise
from pipeline.statistics.improvement import probability_of_improvement
from pipeline.statistics.paired import holm, paired_difference, paired_test
from pipeline.statistics.power import seeds_for_equivalence, seeds_needed
from pipeline.statistics.profiles import performance_profile
from pipeline.statistics.scores import gap_to_optimum, optimum_score

__all__ = [
    "Band",
    "Estimate",
    "PairComparison",
    "Statistic",
    "Summary",
    "ThresholdSummary",
    "Verdict",
    "area_under_curve",
    "best_score",
    "compare_pairs",
    "curve_band",
    "estimate",
    "final_score",
    "gap_to_optimum",
    "holm",
    "on_grid",
    "optimum_score",
    "paired_difference",
    "paired_test",
    "performance_profile",
    "probability_of_improvement",
    "seeds_for_equivalence",
    "seeds_needed",
    "shared_grid",
    "steps_to_threshold",
    "summarise",
    "summarise_steps",
]
