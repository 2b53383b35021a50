"""What the study has shown, in words."""

from __future__ import annotations

from report.conclusions import conclusion, places_without_a_run
from report.latex import LATEX
from report.markdown import MARKDOWN
from report.page.sections import Report, Section
from report.verdict_matrix import PHRASES, SIGNS, says_more, verdict_matrix
from report.verdict_table import verdicts_as


def section(report: Report) -> Section | None:
    """For each environment a line, the pairs as a matrix, and folded the rest."""
    study = report.analysis.study
    cards = [
        {
            "environment": environment,
            "conclusion": conclusion(study, environment),
            "matrix": verdict_matrix(environment) if says_more(environment) else None,
        }
        for environment in report.analysis.environments
    ]
    context = {
        "general": places_without_a_run(report.analysis),
        "cards": cards,
        "signs": SIGNS,
        "phrases": PHRASES,
    }
    files = {
        name: verdicts_as(markup, report.analysis, report.command)
        for name, markup in (("md", MARKDOWN), ("tex", LATEX))
    }
    return Section("verdict", "Verdict", context, files)
