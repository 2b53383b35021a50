"""Subclasses of the library's agents and of ours, each with one fault.

``FAULTS`` says which class has which fault; none of those in ``RIGHT`` has any.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.utils import explained_variance
from torch.nn.functional import mse_loss, smooth_l1_loss

from agents.tabular.one_step import QLearning
from agents.tabular.traces import SARSALambda

# --- DQN ------------------------------------------------------------------------------------------


class WrittenOutDQN(DQN):
    """The library's DQN with its update written out, which the faults change."""

    def next_values(self, batch: Any) -> th.Tensor:
        """Of the best next actions, shape (n, 1)."""
        values: th.Tensor = self.q_net_target(batch.next_observations)
        return values.amax(dim=1, keepdim=True)

    def targets(self, batch: Any) -> th.Tensor:
        """What values are moved towards, shape (n, 1)."""
        discounts = self.gamma if batch.discounts is None else batch.discounts
        values = (1 - batch.dones) * discounts * self.next_values(batch)
        targets: th.Tensor = batch.rewards + values
        return targets

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Gradient steps on batches of the memory."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        assert self.replay_buffer is not None
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size)
            with th.no_grad():
                targets = self.targets(batch)
            values = self.q_net(batch.observations).gather(1, batch.actions.long())
            loss = smooth_l1_loss(values, targets)
            self.policy.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.policy.optimizer.step()
        self._n_updates += gradient_steps


class DQNBootstraps(WrittenOutDQN):
    """Forgets that episodes end."""

    def targets(self, batch: Any) -> th.Tensor:
        """Without the mask."""
        discounts = self.gamma if batch.discounts is None else batch.discounts
        targets: th.Tensor = batch.rewards + discounts * self.next_values(batch)
        return targets


class DQNGammaTwice(WrittenOutDQN):
    """Discounts in two places."""

    def next_values(self, batch: Any) -> th.Tensor:
        """Discounted already."""
        return self.gamma * super().next_values(batch)


class DQNFollows(WrittenOutDQN):
    """Takes the value of some next action."""

    def next_values(self, batch: Any) -> th.Tensor:
        """Of next actions as exploring chooses them."""
        values: th.Tensor = self.q_net_target(batch.next_observations)
        return values.gather(1, th.randint(0, values.shape[1], (len(values), 1)))


class DQNTimeouts(DQN):
    """Takes time limits for ends."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("replay_buffer_kwargs", {"handle_timeout_termination": False})
        super().__init__(*args, **kwargs)


class DQNSeesReset(DQN):
    """Stores what is seen after a reset."""

    def _store_transition(
        self, buffer: Any, action: Any, new_obs: Any, reward: Any, dones: Any, infos: Any
    ) -> None:
        infos = [{k: v for k, v in i.items() if k != "terminal_observation"} for i in infos]
        super()._store_transition(buffer, action, new_obs, reward, dones, infos)


class DQNNeverCopies(DQN):
    """Its target network stays as it began."""

    def _on_step(self) -> None:
        tau, self.tau = self.tau, 0.0
        super()._on_step()
        self.tau = tau


class DQNAlwaysCopies(DQN):
    """Its target network follows at each training."""

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """After copying."""
        self.q_net_target.load_state_dict(self.q_net.state_dict())
        super().train(gradient_steps, batch_size)


class FirstOnly(ReplayBuffer):
    """Keeps the first steps for ever."""

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Unless it is full."""
        if not self.full:
            super().add(*args, **kwargs)


class DQNStale(DQN):
    """Its memory is never renewed."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("replay_buffer_class", FirstOnly)
        super().__init__(*args, **kwargs)


class DQNSharesArrays(DQN):
    """Stores the array that the next observation is written into."""

    def _store_transition(
        self, buffer: Any, action: Any, new_obs: Any, reward: Any, dones: Any, infos: Any
    ) -> None:
        self._last_obs[:] = new_obs  # type: ignore[index]
        super()._store_transition(buffer, action, new_obs, reward, dones, infos)


class DQNSharesMemory(DQN):
    """Has one memory for all agents of the class, as a mutable default would make it."""

    memories: ClassVar[dict[str, Any]] = {}

    def _setup_model(self) -> None:
        key = f"{self.observation_space} {self.action_space} {self.buffer_size}"
        self.replay_buffer = self.memories.get(key)
        super()._setup_model()
        self.memories[key] = self.replay_buffer


class DQNExplores(DQN):
    """Explores whenever it is asked."""

    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> Any:
        """A random action now and then."""
        action, state = super().predict(observation, *args, **kwargs)
        noise = np.random.random(np.shape(action)) < 0.05  # noqa: NPY002 (as people write it)
        return np.where(noise, 1 - action, action), state


class DQNWithoutOptimizer(DQN):
    """Saves its weights alone."""

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["q_net", "q_net_target"], []


class DQNEpsilonGrows(DQN):
    """Explores the more the longer it learns."""

    def _setup_model(self) -> None:
        super()._setup_model()
        falling = self.exploration_schedule
        self.exploration_schedule = lambda progress: falling(1 - progress)


# --- SAC ------------------------------------------------------------------------------------------


class SACAlwaysCopies(SAC):
    """Its critics' targets are the critics."""

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """After copying."""
        self.critic_target.load_state_dict(self.critic.state_dict())
        super().train(gradient_steps, batch_size)


# --- PPO and A2C ----------------------------------------------------------------------------------


class WrittenOutPPO(PPO):
    """The library's PPO with its loss written out, which the faults change."""

    advantage_sign, entropy_sign, ratio_sign = 1, 1, 1

    def train(self) -> None:
        """Some epochs on the rollout."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        for _ in range(self.n_epochs):
            for batch in self.rollout_buffer.get(self.batch_size):
                actions = batch.actions.long().flatten()
                values, log_prob, entropy = self.policy.evaluate_actions(
                    batch.observations, actions
                )
                advantages = batch.advantages
                if len(advantages) > 1:
                    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
                advantages = advantages * self.advantage_sign
                ratio = th.exp(self.ratio_sign * (log_prob - batch.old_log_prob))
                clipped = th.clamp(ratio, 1 - clip_range, 1 + clip_range)
                policy_loss = -th.min(advantages * ratio, advantages * clipped).mean()
                value_loss = mse_loss(batch.returns, values.flatten())
                assert entropy is not None
                entropy_loss = -self.entropy_sign * entropy.mean()
                loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss
                self.policy.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
        self._n_updates += self.n_epochs
        buffer = self.rollout_buffer
        self.logger.record(
            "train/explained_variance",
            explained_variance(buffer.values.flatten(), buffer.returns.flatten()),
        )


class PPOFlees(WrittenOutPPO):
    """Advantages have the wrong sign."""

    advantage_sign = -1


class PPOEntropy(WrittenOutPPO):
    """Entropy is made small."""

    entropy_sign = -1


class PPORatio(WrittenOutPPO):
    """Old by new, instead of new by old."""

    ratio_sign = -1


class GAEWithoutLambda(RolloutBuffer):
    """Advantages that fade by gamma alone."""

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: Any) -> None:
        """The library's loop, without lambda."""
        last, next_values = 0.0, last_values.clone().cpu().numpy().flatten()
        for step in reversed(range(self.buffer_size)):
            if step == self.buffer_size - 1:
                goes_on = 1.0 - dones.astype(np.float32)
            else:
                goes_on = 1.0 - self.episode_starts[step + 1]
                next_values = self.values[step + 1]
            error = self.rewards[step] + self.gamma * next_values * goes_on - self.values[step]
            last = error + self.gamma * goes_on * last * (self.gae_lambda > 0)
            self.advantages[step] = last
        self.returns = self.advantages + self.values


class PPOTraces(PPO):
    """Its advantages do not fade by lambda."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("rollout_buffer_class", GAEWithoutLambda)
        super().__init__(*args, **kwargs)


class NeverEnds(RolloutBuffer):
    """Advantages that go on over the ends of episodes."""

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: Any) -> None:
        """As if no episode had begun."""
        self.episode_starts[1:] = 0
        super().compute_returns_and_advantage(last_values, np.zeros_like(dones))


class A2CBootstraps(A2C):
    """Goes on over the ends of episodes."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("rollout_buffer_class", NeverEnds)
        super().__init__(*args, **kwargs)


class PPOTimeouts(PPO):
    """Takes time limits for ends."""

    def _update_info_buffer(self, infos: Any, dones: Any = None) -> None:
        super()._update_info_buffer(infos, dones)
        for info in infos:
            info.pop("TimeLimit.truncated", None)


class PPOSeesReset(PPO):
    """Takes what is seen after a reset for the last observation."""

    def _update_info_buffer(self, infos: Any, dones: Any = None) -> None:
        super()._update_info_buffer(infos, dones)
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = np.zeros_like(info["terminal_observation"])


class PPORateRises(PPO):
    """Its schedule is handed how far the training is, not how much remains."""

    def _update_learning_rate(self, optimizers: Any) -> None:
        rate = self.lr_schedule(1 - self._current_progress_remaining)
        for group in optimizers.param_groups:
            group["lr"] = rate


class PPORateStays(PPO):
    """Takes the first learning rate for ever."""

    def _update_learning_rate(self, optimizers: Any) -> None:
        pass


class PowerOne(RolloutBuffer):
    """n-step returns whose last value is discounted once."""

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: Any) -> None:
        """Sums of rewards, from each step to the end of the rollout."""
        n = self.buffer_size
        ended = np.concatenate([self.episode_starts[1:], dones[None]])
        for step in range(n):
            total, k = np.zeros(self.n_envs), step
            total += self.rewards[k]
            while k < n - 1 and not ended[k].any():
                k += 1
                total += self.gamma ** (k - step) * self.rewards[k]
            goes_on = 1.0 - ended[k]
            total += self.gamma * goes_on * last_values.cpu().numpy().flatten()
            self.returns[step] = total
        self.advantages = self.returns - self.values


class A2CPowerOne(A2C):
    """n-step returns whose last value is discounted once."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("rollout_buffer_class", PowerOne)
        super().__init__(*args, **kwargs)


class A2CFlees(A2C):
    """Advantages have the wrong sign."""

    def train(self) -> None:
        """On advantages that were turned round."""
        self.rollout_buffer.advantages *= -1
        super().train()


# --- ours -----------------------------------------------------------------------------------------


class ForgetfulQLearning(QLearning):
    """Its table is not in the file."""

    def get_parameters(self) -> dict[str, Any]:
        """With an empty table."""
        parameters = super().get_parameters()
        table = parameters["policy"]["q_tables"]
        return {**parameters, "policy": {**parameters["policy"], "q_tables": th.zeros_like(table)}}


class ForgetfulSARSALambda(SARSALambda):
    """Its learning rate's schedule is not in the file."""

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "learning_rate", "lr_schedule"]


class ForgetfulPPO(PPO):
    """Its learning rate's schedule is not in the file."""

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "learning_rate", "lr_schedule"]


RIGHT = ("WrittenOutDQN", "WrittenOutPPO")
FAULTS = {
    "DQNBootstraps": "bootstraps-at-terminal",
    "DQNGammaTwice": "discount-twice",
    "DQNFollows": "follows-instead-of-maximises",
    "DQNTimeouts": "no-bootstrap-at-truncation",
    "DQNSeesReset": "reset-observation",
    "DQNNeverCopies": "target-never-copied",
    "DQNAlwaysCopies": "target-always-copied",
    "DQNStale": "stale-buffer",
    "DQNSharesArrays": "shared-buffer",
    "DQNSharesMemory": "shared-buffer",
    "DQNExplores": "explores-in-evaluation",
    "DQNWithoutOptimizer": "zip-forgets-optimizer",
    "DQNEpsilonGrows": "schedule-backwards",
    "SACAlwaysCopies": "target-always-copied",
    "PPOFlees": "advantage-sign",
    "PPOEntropy": "entropy-sign",
    "PPORatio": "importance-ratio",
    "PPOTraces": "traces",
    "PPOTimeouts": "no-bootstrap-at-truncation",
    "PPOSeesReset": "reset-observation",
    "PPORateRises": "schedule-backwards",
    "PPORateStays": "schedule-constant",
    "A2CBootstraps": "bootstraps-at-terminal",
    "A2CPowerOne": "n-step-return",
    "A2CFlees": "advantage-sign",
    "ForgetfulQLearning": "zip-forgets-tables",
    "ForgetfulSARSALambda": "zip-forgets-schedules",
    "ForgetfulPPO": "zip-forgets-schedules",
}
