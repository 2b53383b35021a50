"""PPO and A2C on compiled code, with environments in compiled code or in Python."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from agents.common.callbacks import NEVER, Horizon
from agents.common.schedules import ScheduleRow
from agents.compiled.generators import handles_of
from agents.compiled.learning_algorithm import compiled_schedule
from agents.compiled.worlds import NotCompilable
from agents.networks.engine import NOWHERE, NetworkTraining, record_of
from agents.networks.engine_setting import CompiledNetworks, Work, work_of
from agents.networks.observations import Numbers
from agents.networks.perceptron import Singles, make_inputs, make_outputs, n_parameters
from agents.networks.policy_learner import (
    LOSSES,
    PLACE,
    RULES,
    PolicyAgent,
    PolicyLearner,
    Rollout,
    RolloutMemory,
    RolloutMinibatch,
    act_on_rows,
    choose_randomly,
    estimate_advantages,
    evaluate,
    evaluate_rows,
    learn_from_rollout_minibatch,
    pick_steps,
    train,
)
from agents.networks.torch_bridge import Network, Reference, address_of, network_of
from mdp.array_types import Bools

# How far a number may move that nothing bounds.
UNBOUNDED = 1e30

# Rollouts that a block may hold where nothing is logged.
_MOST_ROLLOUTS = 10_000


class PolicyTraining(NetworkTraining):
    """PPO or A2C in training; of its networks the first gives action probabilities."""

    # The library's rollouts take what remains from the steps to do.
    heeds_budgets = False

    def __init__(self, agent: Any, seen: Any) -> None:
        super().__init__(agent, seen)
        actor, critic = (network.layers for network in self.networks)
        n_steps = agent.n_steps * agent.n_envs
        size = min(agent.minibatch_size or n_steps, n_steps)
        rows = max(size, agent.n_envs)
        flat = self.trained.vector
        self.recorded, self.place = 0, record_of(PLACE)
        batch = RolloutMinibatch(
            make_inputs(actor, size),
            np.zeros(size, np.int64),
            *(np.zeros(size, np.float32) for _ in range(4)),
        )
        rollout, order = self._rollout(), np.arange(n_steps)
        observations = agent.rollout_buffer.observations
        observations = observations.reshape(*observations.shape[:2], -1)
        self.memory = Reference(RolloutMemory(observations, rollout, order, batch, actor.one_hot))
        learner = PolicyLearner(
            self._rules(self._bound_now),
            self.place,
            record_of(LOSSES),
            actor,
            critic,
            flat,
            np.zeros_like(flat),
            self.optimizer.compiled,
            rollout,
            address_of(pick_steps, self.memory),
            np.uintp(self.memory.address),
            np.zeros(agent.n_envs, np.float32),
            np.zeros(agent.n_envs, np.float32),
            NOWHERE,
            order,
            batch,
            make_outputs(actor, rows),
            make_outputs(actor, size),
            make_outputs(critic, rows),
            make_outputs(critic, size),
            make_inputs(actor, 1),
            handles_of([agent.rng]),
        )
        self.begin(learner, learn_from_rollout_minibatch)

    def _rules(self, bound: Callable[[Schedule | None], ScheduleRow]) -> Any:
        agent = self.agent
        target_kl = getattr(agent, "target_kl", None)
        return record_of(
            RULES,
            gamma=agent.gamma,
            buffer_gamma=agent.rollout_buffer.gamma,
            gae_lambda=agent.rollout_buffer.gae_lambda,
            ent_coef=agent.ent_coef,
            vf_coef=agent.vf_coef,
            max_grad_norm=agent.max_grad_norm,
            target_kl=np.inf if target_kl is None else target_kl,
            normalize_advantage=agent.normalize_advantage,
            n_epochs=getattr(agent, "n_epochs", 1),
            waits=self.waits,
            clip_range=tuple(bound(getattr(agent, "clip_range", None))),
            clip_range_vf=tuple(bound(getattr(agent, "clip_range_vf", None))),
        )

    def _bound_now(self, schedule: Schedule | None) -> ScheduleRow:
        """What any schedule of a bound says at the moment, as one that does not change."""
        if schedule is None:
            return _bound(None)
        return _bound(FloatSchedule(schedule(self.agent._current_progress_remaining)))

    def read_settings(self) -> None:
        """Take over what a callback has changed."""
        self.read_generator()
        self.read_tensors()
        self.held.rules[:] = self._rules(_bound)

    def _rollout(self) -> Rollout:
        buffer = self.agent.rollout_buffer
        if buffer.generator_ready:
            # The library has flattened it for its own minibatches.
            buffer.reset()
        return Rollout(
            buffer.actions,
            buffer.rewards,
            buffer.episode_starts,
            buffer.values,
            buffer.log_probs,
            buffer.advantages,
            buffer.returns,
        )

    def in_loop(self) -> PolicyAgent:
        """What the compiled loop asks."""
        functions = (choose_randomly, evaluate, estimate_advantages, train)
        addresses = (address_of(function, self.learner) for function in functions)
        return PolicyAgent(self.learner, self.memory, self.seen, *addresses)

    def schedules(self) -> dict[str, Schedule]:
        """What compiled code works out after each step, by the names in its record."""
        return {"learning_rate": self.agent.lr_schedule}

    def take_over_progress(self, remaining: float) -> None:
        """Let the agent know how much of the training remained at the end of the last rollout."""
        self.agent._current_progress_remaining = float(self.place["remaining"][0])

    def give_up_rollout(self) -> None:
        """Forget how much was collected since the last training."""
        self.place["step"] = self.place["n_rollouts"] = 0

    def read(self) -> None:
        """Begin where the agent is."""
        agent, place = self.agent, self.place
        place["step"] = agent.collected
        place["remaining"] = agent._current_progress_remaining
        place["n_updates"] = agent._n_updates
        self.held.starts[:] = agent._last_episode_starts

    def write(self) -> None:
        """Let the agent know where compiled code is."""
        agent, place = self.agent, self.place[0]
        agent._n_updates = int(place["n_updates"])
        agent.collected = int(place["step"])
        agent._last_episode_starts = self.held.starts.astype(bool)
        buffer = agent.rollout_buffer
        buffer.full = self.is_rollout_over or (bool(place["n_rollouts"]) and place["step"] == 0)
        buffer.pos = len(buffer.rewards) if buffer.full else int(place["step"])

    def until_end(self, total_timesteps: int) -> int:
        """As everywhere, but to the end of the last rollout."""
        begun, whole = int(self.place["step"][0]), int(self.agent.n_steps)
        return -(-(begun + super().until_end(total_timesteps)) // whole) * whole - begun

    def until_log(self, log_interval: int | None) -> Horizon:
        """When something is logged next."""
        in_rollout = self.agent.n_steps - int(self.place["step"][0])
        if log_interval is None:
            return Horizon(NEVER, NEVER)
        iteration = int(self.place["n_rollouts"][0]) + 1
        # By asking, as a training that was resumed has an interval that counts on.
        for n_more in range(_MOST_ROLLOUTS):
            if (iteration + n_more) % log_interval == 0:
                break
        # What is logged then is of the training before, which has to be told by itself.
        return Horizon(in_rollout + max(n_more - 1, 0) * self.agent.n_steps, NEVER)

    def count_episodes(self, n_episodes: int, log_interval: int | None) -> None:
        """Nothing: it logs by rollouts."""

    @property
    def is_rollout_over(self) -> bool:
        """Whether a rollout waits to be learnt from, be it that nothing is learnt yet."""
        return bool(self.place["step"][0] == self.agent.n_steps)

    def until_rollout_end(self) -> Horizon:
        """When a rollout ends that is to wait."""
        in_rollout = self.agent.n_steps - int(self.place["step"][0])
        return Horizon(in_rollout if self.waits else NEVER, NEVER)

    def learn_from_rollout(self, remaining: float) -> None:
        """Learn from the rollout that waits, with that share of the training left."""
        train(self.learner, remaining, float(self.agent.lr_schedule(remaining)))

    def before_training(self, log_interval: int | None) -> None:
        """Log as the library does, at the end of a rollout and before what is learnt from it."""
        iteration = int(self.place["n_rollouts"][0]) + 1
        ends = self.place["step"][0] >= self.agent.n_steps - 1
        if ends and log_interval is not None and iteration % log_interval == 0:
            self.agent.dump_logs(iteration)

    def train(self) -> None:
        """Learn from the rollout, where environments are Python's."""
        agent = self.agent
        self.read_tensors()
        self.place["n_updates"] = agent._n_updates
        self.held.rules[:] = self._rules(self._bound_now)
        remaining = agent._current_progress_remaining
        train(self.learner, remaining, float(agent.lr_schedule(remaining)))
        self.write()
        self.record()

    def record(self) -> None:
        """Hand what the last training has given to the agent's logger."""
        agent, place = self.agent, self.place[0]
        if place["n_rollouts"] == self.recorded:
            return
        self.recorded = place["n_rollouts"]
        if np.isnan(self.held.losses["total"][0]):
            raise ValueError("training has diverged: its losses are not numbers any more")
        log, remaining = agent.logger, agent._current_progress_remaining
        agent._update_learning_rate(agent.policy.optimizer)
        log.record("train/explained_variance", place["explained"])
        log.record("train/entropy_loss", place["entropy"])
        log.record("train/value_loss", place["value"])
        log.record("train/n_updates", agent._n_updates, exclude="tensorboard")
        losses = self.held.losses[0]
        if not hasattr(agent, "clip_range"):
            log.record("train/policy_loss", losses["likelihood"])
            return
        log.record("train/policy_gradient_loss", place["policy_gradient"])
        log.record("train/approx_kl", place["kl"])
        log.record("train/clip_fraction", place["clipped"])
        log.record("train/loss", losses["total"])
        log.record("train/clip_range", agent.clip_range(remaining))
        if agent.clip_range_vf is not None:
            log.record("train/clip_range_vf", agent.clip_range_vf(remaining))


def _bound(schedule: Schedule | None) -> ScheduleRow:
    """The schedule of a bound as compiled code reads it."""
    return compiled_schedule(FloatSchedule(UNBOUNDED) if schedule is None else schedule)


def collect_rollout(training: PolicyTraining, env: VecEnv, callback: BaseCallback) -> bool:
    """Fill the rollout buffer, once callbacks have been told that it begins."""
    agent, held, buffer = training.agent, training.held, training.agent.rollout_buffer
    agent.collected = 0
    training.read()
    buffer.pos, buffer.full = 0, False
    for step in range(agent.n_steps):
        actions = _act(training, step)
        new_obs, rewards, dones, infos = env.step(actions.copy())
        agent.num_timesteps += env.num_envs
        told = {"new_obs": new_obs, "rewards": rewards, "dones": dones, "infos": infos}
        callback.update_locals({**_said(training, env, step), "actions": actions, **told})
        if not callback.on_step():
            return False
        agent._update_info_buffer(infos, dones)
        held.rollout.rewards[step] = rewards + _cut_off(training, dones, infos)
        agent._last_obs, agent._last_episode_starts, held.starts[:] = new_obs, dones, dones
        buffer.pos = step + 1
    buffer.full = True
    training.show(agent._last_obs)
    evaluate_rows(training.learner, training.shown, held.last_values)
    estimate_advantages(training.learner, 0.0, 0.0)
    callback.on_rollout_end()
    return True


def _act(training: PolicyTraining, step: int) -> Any:
    """Actions for the present observations, written down with what belongs to them."""
    actions = np.zeros(training.agent.n_envs, np.int64)
    training.place["step"] = step
    training.read_generator()
    training.trained.take_over()
    training.show(training.agent._last_obs)
    act_on_rows(training.learner, training.shown, actions)
    training.memory.held.observations[step] = training.shown
    return actions


def _said(training: PolicyTraining, env: VecEnv, step: int) -> dict[str, Any]:
    """What callbacks read under the library's names of where the rollout is."""
    rollout = training.held.rollout
    return {
        "self": training.agent,
        "env": env,
        "rollout_buffer": training.agent.rollout_buffer,
        "n_rollout_steps": training.agent.n_steps,
        "n_steps": step,
        "values": th.tensor(rollout.values[step, :, np.newaxis]),
        "log_probs": th.tensor(rollout.log_probs[step]),
    }


def _cut_off(training: PolicyTraining, dones: Bools, infos: list[dict[str, Any]]) -> Singles:
    """What would have come after episodes that ran out of time, shape (E,)."""
    lost = np.zeros(len(dones), np.float32)
    values = np.zeros(1, np.float32)
    shown = training.shown[:1]
    for i in np.flatnonzero(dones):
        if infos[i].get("TimeLimit.truncated", False):
            shown[:] = np.reshape(infos[i]["terminal_observation"], (1, -1))
            training.check_numbers(shown)
            evaluate_rows(training.learner, shown, values)
            lost[i] = np.float32(training.agent.gamma) * values[0]
    return lost


class CompiledPolicyGradient(CompiledNetworks, OnPolicyAlgorithm):
    """What PPO and A2C share; `CompiledNetworks` says what the argument ``engine`` does."""

    training_kind = PolicyTraining
    _own = (*CompiledNetworks._own, "collected")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.collected = 0  # steps of the rollout that the compiled loop has under way
        super().__init__(*args, **kwargs)

    @property
    def minibatch_size(self) -> int | None:
        """Steps that are learnt from at once; None for all of a rollout."""
        return getattr(self, "batch_size", None)

    @property
    def is_within_rollout(self) -> bool:
        return self.collected > 0

    def _check_own(self) -> None:
        if type(self.rollout_buffer) is not RolloutBuffer:
            raise NotCompilable("its rollout buffer is of another kind")

    def _parts(self) -> list[list[Any]]:
        """The bodies and heads of the networks of action probabilities and of values."""
        policy: Any = self.policy
        extractor = policy.mlp_extractor
        return [
            [extractor.policy_net, policy.action_net],
            [extractor.value_net, policy.value_net],
        ]

    def shared_networks(self, seen: Any) -> tuple[list[Network], list[Network]]:
        one_hot = isinstance(seen, Numbers)
        (body, head), (value_body, value_head) = self._parts()
        actor = network_of([*body, head], 0, one_hot=one_hot)
        start = n_parameters(actor.layers)
        critic = network_of([*value_body, value_head], start, one_hot=one_hot)
        return [actor, critic], []

    def _work_of(self, n_steps: float) -> Work:
        rollout = self.n_steps * self.n_envs
        batch_size = self.minibatch_size or rollout
        n_rollouts = math.ceil(n_steps / rollout)
        n_updates = n_rollouts * getattr(self, "n_epochs", 1) * math.ceil(rollout / batch_size)
        return work_of(
            "policy",
            [nn.ModuleList(parts) for parts in self._parts()],
            self.observation_space,
            n_rollouts * rollout,
            self.n_envs,
            n_updates,
            batch_size,
        )

    def _schedules(self) -> list[Schedule]:
        bounds = [getattr(self, name, None) for name in ("clip_range", "clip_range_vf")]
        return [*super()._schedules(), *(bound for bound in bounds if bound is not None)]

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Fill the rollout buffer; False once a callback asks to stop."""
        if not self._sharing:
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        rollout_buffer.pos, rollout_buffer.full = 0, False
        callback.on_rollout_start()
        return collect_rollout(self._shared_training(), env, callback)

    def train(self) -> None:
        """Learn from the rollout buffer."""
        if self._sharing:
            self._shared_training().train()
        else:
            super().train()
