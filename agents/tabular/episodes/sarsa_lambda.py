"""SARSA(lambda)."""

from __future__ import annotations

from agents.tabular.episodes.eligibility_traces import TraceAlgorithm
from agents.tabular.sarsa import commit_to_next_action, committed_value


class SARSALambda(TraceAlgorithm):
    """SARSA(lambda) (Rummery and Niranjan, 1994; Sutton and Barto, section 12.7).

    With dutch traces it is true online SARSA(lambda); with ``trace_decay`` 0 it is SARSA.
    """

    commit = commit_to_next_action
    next_value = committed_value
