"""Semi-gradient SARSA."""

from __future__ import annotations

from typing import Any

from agents.linear.semi_gradient import SemiGradientAlgorithm
from agents.linear.weighted_tiles import LinearAgent, choose, look
from agents.networks.observations import AFTER
from machine_code.compiling import called


@called
def commit_to_next_action(agent: LinearAgent, env: Any, progress: Any) -> None:
    """Choose what to do next; nothing where nothing follows."""
    env.next_action = 0
    if not env.terminated:
        look(agent, env, AFTER, agent.room.next_tiles)
        env.next_action = choose(agent, agent.room.next_tiles, progress)


@called
def committed_value(agent: LinearAgent, env: Any, progress: Any) -> float:
    """The value of the next action that the agent has committed to."""
    return float(agent.room.sums[env.next_action])


class SemiGradientSARSA(SemiGradientAlgorithm):
    """Episodic semi-gradient SARSA (Sutton and Barto, section 10.1).

    It commits to its next action before the update that uses it. Where an episode is truncated, it
    chooses an action in the last state for the target alone.
    """

    commit = commit_to_next_action
    next_value = committed_value
