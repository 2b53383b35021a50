"""A study as files of comma-separated values."""

from __future__ import annotations

from pathlib import Path

from experiments.analysis import StudyAnalysis
from experiments.study_results import StudyResults
from pipeline.files import replacing, write_text
from report.verdict_table import verdicts_as_markdown


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


def write_verdicts(analysis: StudyAnalysis, command: str) -> Path:
    """Write ``verdicts.md``: what the study has shown, to be pasted where it is told of."""
    path = analysis.results.root / "verdicts.md"
    write_text(path, verdicts_as_markdown(analysis, command))
    return path
