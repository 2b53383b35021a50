"""What an agent makes of the actions before it: its values, or how probable it finds them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.policies import ActorCriticPolicy

from agents.linear.algorithm import TileAlgorithm
from agents.linear.policy_gradients import SoftmaxAlgorithm
from mdp.array_types import Floats


class ActionFigures(NamedTuple):
    """A number for each action."""

    word: str  # what the numbers are: "value", "score" or "probability"
    numbers: Floats  # shape (A,)


def action_figures(agent: BaseAlgorithm, observations: Any) -> ActionFigures | None:
    """What an agent knows about its actions at the observation of one environment, or None."""
    policy: Any = agent.policy
    if not isinstance(agent.action_space, spaces.Discrete):
        return None
    for word, name in (("value", "q_table"), ("score", "scores")):
        table = getattr(policy, name, None)
        if table is not None and isinstance(agent.observation_space, spaces.Discrete):
            row = int(np.asarray(observations).reshape(-1)[0])
            return ActionFigures(word, np.asarray(table)[row if len(table) > 1 else 0])
    if isinstance(agent, SoftmaxAlgorithm):
        return ActionFigures("probability", agent.action_probabilities(observations)[0])
    if isinstance(agent, TileAlgorithm):
        return ActionFigures("value", agent.policy.sums(observations)[0])
    with th.no_grad():
        return _of_network(policy, observations)


def _of_network(policy: Any, observations: Any) -> ActionFigures | None:
    if getattr(policy, "q_net", None) is not None:
        tensor, _ = policy.obs_to_tensor(observations)
        return ActionFigures("value", policy.q_net(tensor)[0].cpu().numpy())
    if getattr(policy, "quantile_net", None) is not None:
        tensor, _ = policy.obs_to_tensor(observations)
        return ActionFigures("value", policy.quantile_net(tensor)[0].mean(dim=0).cpu().numpy())
    # A policy with a memory would have to be told what it remembers.
    if isinstance(policy, ActorCriticPolicy) and not hasattr(policy, "lstm_actor"):
        tensor, _ = policy.obs_to_tensor(observations)
        distribution = policy.get_distribution(tensor)
        if isinstance(distribution, CategoricalDistribution):
            probabilities = distribution.distribution.probs[0]
            return ActionFigures("probability", probabilities.cpu().numpy())
    return None
