"""One colour and one line style for each agent, the same in every figure of a study."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.study_spec import StudySpec
from report.figures.figure_style import COLOURS, agent_style

# What Plotly calls Matplotlib's line styles.
_DASHES: Mapping[str, str] = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"}


def agent_marks(study: StudySpec) -> list[dict[str, Any]]:
    """The agents in the order of the study, with the number of their colour and their dashes.

    A colour is given by number: the style sheet says which it is, in a light and in a dark theme.
    """
    marks = []
    for agent in study.agents:
        style = agent_style(study, agent.label)
        marks.append(
            {
                "label": agent.label,
                "colour": COLOURS.index(style["color"]),
                "dash": _DASHES[style["linestyle"]],
            }
        )
    return marks
