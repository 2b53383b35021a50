"""What the study has shown, in words."""

from __future__ import annotations

from report.page.sections import Report, Section
from report.sentences import environment_sentences, sentences

SHOWN = 5  # sentences on an environment; the others wait behind a button


def section(report: Report) -> Section | None:
    """The sentences, those on one environment together."""
    study = report.analysis.study
    groups = [
        (environment.environment, environment_sentences(study, environment))
        for environment in report.analysis.environments
    ]
    grouped = {sentence for _, group in groups for sentence in group}
    general = [s for s in sentences(report.analysis) if s not in grouped]
    context = {"general": general, "groups": groups, "shown": SHOWN}
    return Section("verdict", "Verdict", context)
