"""Which trainings of the library's agents have a compiled counterpart."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.dqn.policies import DQNPolicy

from agents.compiled.compile_envs import NotCompilable


def check_agent(agent: Any) -> None:
    """Make sure that compiled functions do all that an agent of the library does.

    Raises:
        NotCompilable: naming what they do not.
    """
    if not type(agent).__module__.startswith("agents."):
        raise NotCompilable(f"{type(agent).__name__} may do things in Python of its own")
    _check_spaces(agent)
    if agent.device.type != "cpu":
        raise NotCompilable(f"its networks live on {agent.device}")
    kind = type(agent.policy)
    if kind not in {ActorCriticPolicy, DQNPolicy}:
        raise NotCompilable(f"its policy is {kind.__name__}, not a multilayer perceptron")
    extractor = agent.policy.features_extractor_class
    if extractor is not FlattenExtractor:
        raise NotCompilable(f"observations go through {extractor.__name__}")


def _check_spaces(agent: Any) -> None:
    actions, observations = agent.action_space, agent.observation_space
    if not isinstance(actions, spaces.Discrete):
        raise NotCompilable(f"actions are {type(actions).__name__}, not Discrete")
    for space in (actions, observations):
        if isinstance(space, spaces.Discrete) and space.start != 0:
            raise NotCompilable(f"{space} does not begin with 0")
    if isinstance(observations, spaces.Discrete):
        return
    if not isinstance(observations, spaces.Box):
        raise NotCompilable(f"observations are {type(observations).__name__}, not Box or Discrete")
    if is_image_space(observations) or observations.dtype not in (np.float32, np.float64):
        raise NotCompilable(f"observations are of {observations.dtype}")


def check_q_agent(agent: Any) -> None:
    """As `check_agent`, for DQN and its kin.

    Raises:
        NotCompilable: naming what has no compiled counterpart.
    """
    check_agent(agent)
    if getattr(agent, "mask_actions", False):
        raise NotCompilable("it masks actions")
    buffer = agent.replay_buffer
    if type(buffer) not in {ReplayBuffer, NStepReplayBuffer} or buffer.optimize_memory_usage:
        raise NotCompilable("its replay buffer is of another kind")
    if agent.n_envs > 1 and agent.train_freq.unit == TrainFrequencyUnit.EPISODE:
        raise NotCompilable("train_freq counts the episodes of several environments")


def check_policy_agent(agent: Any) -> None:
    """As `check_agent`, for PPO and A2C.

    Raises:
        NotCompilable: naming what has no compiled counterpart.
    """
    check_agent(agent)
    if agent.use_sde:
        raise NotCompilable("it explores by the state (use_sde)")
    if type(agent.rollout_buffer) is not RolloutBuffer:
        raise NotCompilable("its rollout buffer is of another kind")
