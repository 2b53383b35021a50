"""What the study has shown, in words."""

from __future__ import annotations

from report.conclusions import conclusion, places_without_a_run
from report.page.sections import Report, Section
from report.verdict_matrix import PHRASES, SIGNS, says_more, verdict_matrix


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
    return Section("verdict", "Verdict", context)
