"""A study as files of comma-separated values."""

from __future__ import annotations

from pathlib import Path

from experiments.study_results import StudyResults
from pipeline.files import replacing


def write_tables(results: StudyResults) -> list[Path]:
    """Write ``summary.csv``, a row for each run, and ``curves.csv.gz``, all learning curves."""
    summary, curves = results.root / "summary.csv", results.root / "curves.csv.gz"
    with replacing(summary) as draft:
        results.summary.to_csv(draft, index=False, lineterminator="\n")
    with replacing(curves) as draft:
        results.curves.to_csv(
            draft, index=False, float_format="%.8g", compression="gzip", lineterminator="\n"
        )
    return [summary, curves]
