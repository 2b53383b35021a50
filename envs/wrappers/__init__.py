"""Wrappers that fit an environment to an agent: discrete or one-hot observations, other rewards.

Two more say which actions an environment allows.

The observation wrappers also map whole batches of observations (`map_observations`), which exact
evaluation needs: it asks a policy for every state at once.
"""

from envs.wrappers.action_masking import ActionMasks, IdleActionMasks
from envs.wrappers.changed_rewards import ScaleReward, TerminationReward
from envs.wrappers.discretize import DiscretizeObservation
from envs.wrappers.observation_encodings import FlattenToDiscrete, OneHotObservation
from envs.wrappers.time_limit import limit_by_pulls, limit_by_shortest_path

__all__ = [
    "ActionMasks",
    "DiscretizeObservation",
    "FlattenToDiscrete",
    "IdleActionMasks",
    "OneHotObservation",
    "ScaleReward",
    "TerminationReward",
    "limit_by_pulls",
    "limit_by_shortest_path",
]
