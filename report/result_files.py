"""A study as files: comma-separated values, and verdicts for a page or a paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from experiments.analysis import StudyAnalysis
from experiments.results import StudyResults
from pipeline.files import replacing, write_text
from report.latex import LATEX
from report.markdown import MARKDOWN
from report.verdict_table import verdicts_as

# Of the last per cent of its size, the library's own choice is paid with half of the time.
GZIP: Any = {"method": "gzip", "compresslevel": 6}


def write_tables(results: StudyResults) -> list[Path]:
    """Write ``summary.csv``, a row for each run, and ``curves.csv.gz``, all learning curves."""
    summary, curves = results.root / "summary.csv", results.root / "curves.csv.gz"
    with replacing(summary) as file:
        results.summary.to_csv(file, mode="wb", index=False, lineterminator="\n")
    with replacing(curves) as file:
        results.curves.to_csv(
            file,
            mode="wb",
            index=False,
            float_format="%.8g",
            compression=GZIP,
            lineterminator="\n",
        )
    return [summary, curves]


def write_verdicts(analysis: StudyAnalysis, command: str) -> list[Path]:
    """Write ``verdicts.md`` and ``verdicts.tex``: what the study has shown, to be pasted."""
    written = []
    for suffix, markup in ((".md", MARKDOWN), (".tex", LATEX)):
        written.append((analysis.results.root / "verdicts").with_suffix(suffix))
        write_text(written[-1], verdicts_as(markup, analysis, command))
    return written
