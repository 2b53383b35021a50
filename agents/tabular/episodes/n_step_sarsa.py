"""n-step SARSA."""

from __future__ import annotations

from typing import Any

from agents.tabular.episodes.step_windows import WindowAlgorithm
from agents.tabular.sarsa import commit_to_next_action, committed_value
from agents.tabular.temporal_difference import TabularAgent
from machine_code.compiling import inlined


@inlined
def sampled_return(
    agent: TabularAgent, progress: Any, obs: int, action: int, later: float
) -> float:
    """What came after the action that was taken."""
    return later


class NStepSARSA(WindowAlgorithm):
    """n-step SARSA (Sutton and Barto, section 7.2); with one step it is SARSA."""

    commit = commit_to_next_action
    next_value = committed_value
    backed_up = sampled_return
