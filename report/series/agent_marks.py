"""One colour and one line style for each agent, the same in every figure of a study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from experiments.study import StudySpec

# Okabe and Ito's colours, told apart by colour-blind readers too. The page's style sheet has them
# as well, with others for a dark theme.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")

Dash = Literal["solid", "dash", "dashdot", "dot"]
# Seven colours and four line styles go round together: neighbours differ in both, so that lines are
# told apart in grey too, and 28 agents have marks of their own.
DASHES: tuple[Dash, ...] = ("solid", "dash", "dashdot", "dot")


@dataclass(frozen=True)
class Mark:
    """How an agent is drawn.

    Attributes:
        label: the agent's.
        colour: the place of its colour in `COLOURS`.
        dash: its line style, as Plotly calls it.
        shape: how often the colours have been gone through before: the page gives the dot beside a
            name another shape each time.
    """

    label: str
    colour: int
    dash: Dash
    shape: int = 0


def agent_marks(study: StudySpec) -> dict[str, Mark]:
    """The marks of the agents by label, in the order of the study."""
    marks = {}
    for place, label in enumerate(agent.label for agent in study.agents):
        dash = DASHES[place % len(DASHES)]
        again, colour = divmod(place, len(COLOURS))
        marks[label] = Mark(label, colour, dash, again % len(DASHES))
    return marks
