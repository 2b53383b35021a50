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
    from verdicts.comparisons import PairComparison, Verdict, compare_pairs
    from verdicts.estimates import Estimate, Statistic, Summary, estimate, summarise
    from verdicts.improvement import probability_of_improvement
    from verdicts.learning_curves import (
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
    from verdicts.paired import holm, paired_difference, paired_test
    from verdicts.power import seeds_for_equivalence, seeds_needed
    from verdicts.profiles import performance_profile
    from verdicts.scores import gap_to_optimum, optimum_score

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

_HOMES = {
    "PairComparison": "verdicts.comparisons",
    "Verdict": "verdicts.comparisons",
    "compare_pairs": "verdicts.comparisons",
    "Estimate": "verdicts.estimates",
    "Statistic": "verdicts.estimates",
    "Summary": "verdicts.estimates",
    "estimate": "verdicts.estimates",
    "summarise": "verdicts.estimates",
    "probability_of_improvement": "verdicts.improvement",
    "Band": "verdicts.learning_curves",
    "ThresholdSummary": "verdicts.learning_curves",
    "area_under_curve": "verdicts.learning_curves",
    "best_score": "verdicts.learning_curves",
    "curve_band": "verdicts.learning_curves",
    "final_score": "verdicts.learning_curves",
    "on_grid": "verdicts.learning_curves",
    "shared_grid": "verdicts.learning_curves",
    "steps_to_threshold": "verdicts.learning_curves",
    "summarise_steps": "verdicts.learning_curves",
    "holm": "verdicts.paired",
    "paired_difference": "verdicts.paired",
    "paired_test": "verdicts.paired",
    "seeds_for_equivalence": "verdicts.power",
    "seeds_needed": "verdicts.power",
    "performance_profile": "verdicts.profiles",
    "gap_to_optimum": "verdicts.scores",
    "optimum_score": "verdicts.scores",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'verdicts' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
