"""Stable-Baselines3's PPO and A2C, which can train on compiled code."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, ClassVar

import stable_baselines3
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from agents.common.signatures import full_signature
from agents.networks.coverage import check_policy_agent
from agents.networks.engine_costs import Work, work_of
from agents.networks.engine_setting import CompiledNetworks
from agents.networks.library_networks import Network, check_optimizer
from agents.networks.policy_training import PolicyTraining, policy_networks, policy_training
from agents.networks.python_rollouts import collect_rollout


class CompiledPolicyGradient(CompiledNetworks, OnPolicyAlgorithm):
    """What PPO and A2C share: `CompiledNetworks` says what the argument ``engine`` does.

    Attributes:
        collected: steps of the rollout that the compiled loop has under way.
    """

    _training: PolicyTraining | None
    _shared_training: Callable[[], PolicyTraining]
    _own = (*CompiledNetworks._own, "collected")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.collected = 0
        super().__init__(*args, **kwargs)

    @property
    def minibatch_size(self) -> int | None:
        """Steps that are learnt from at once; None for all of a rollout."""
        return getattr(self, "batch_size", None)

    @property
    def is_within_rollout(self) -> bool:
        return self.collected > 0

    def _check_compilable(self) -> None:
        check_policy_agent(self)
        check_optimizer(self.policy.optimizer)
        policy_networks(self.policy, self._seen_in_python())

    def _work_of(self, n_steps: float) -> Work:
        rollout = self.n_steps * self.n_envs
        batch_size = self.minibatch_size or rollout
        n_rollouts = math.ceil(n_steps / rollout)
        n_updates = n_rollouts * getattr(self, "n_epochs", 1) * math.ceil(rollout / batch_size)
        policy: Any = self.policy
        extractor = policy.mlp_extractor
        actor = nn.ModuleList([extractor.policy_net, policy.action_net])
        critic = nn.ModuleList([extractor.value_net, policy.value_net])
        return work_of(
            "policy",
            [actor, critic],
            self.observation_space,
            n_rollouts * rollout,
            self.n_envs,
            n_updates,
            batch_size,
        )

    def _schedules(self) -> list[Schedule]:
        bounds = [getattr(self, name, None) for name in ("clip_range", "clip_range_vf")]
        return [*super()._schedules(), *(bound for bound in bounds if bound is not None)]

    def _compiled_training(self, seen: Any) -> AbstractContextManager[PolicyTraining]:
        return policy_training(self, seen)

    def _acting_network(self, seen: Any) -> Network:
        return policy_networks(self.policy, seen)[0]

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fill the rollout buffer; False once a callback asks to stop."""
        if self._sharing is None:
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        rollout_buffer.pos, rollout_buffer.full = 0, False
        callback.on_rollout_start()
        return collect_rollout(self._shared_training(), env, callback)

    def train(self) -> None:
        """Learn from the rollout buffer."""
        if self._sharing is None:
            super().train()
        else:
            self._shared_training().train()


class PPO(CompiledPolicyGradient, stable_baselines3.PPO):
    """Stable-Baselines3's PPO (Schulman et al., 2017), with the argument ``engine``."""

    __signature__: ClassVar[inspect.Signature]


class A2C(CompiledPolicyGradient, stable_baselines3.A2C):
    """Stable-Baselines3's A2C (Mnih et al., 2016), with the argument ``engine``."""

    __signature__: ClassVar[inspect.Signature]


for _algorithm in (PPO, A2C):
    _algorithm.__signature__ = full_signature(_algorithm)
