"""DQN and its kin on compiled code."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
import stable_baselines3
from numpy.typing import NDArray
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import Schedule, TrainFrequencyUnit
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.common.vec_env import VecNormalize

from agents.common.callbacks import NEVER, Horizon
from agents.compiled.generators import handles_of
from agents.compiled.worlds import NotCompilable
from agents.networks.engine import NOWHERE, NetworkTraining, record_of
from agents.networks.engine_setting import STEPS_OF_EPISODE, CompiledNetworks, Work, work_of
from agents.networks.observations import Numbers
from agents.networks.perceptron import make_inputs, make_outputs
from agents.networks.q_learner import (
    DOUBLE,
    ONLINE_NETWORK,
    PLACE,
    RULES,
    TARGET_NETWORK,
    Memory,
    Minibatch,
    QAgent,
    QLearner,
    Replay,
    act_on_rows,
    choose_greedily,
    draw_minibatch,
    learn_from_minibatch,
    train,
)
from agents.networks.torch_bridge import Network, Reference, address_of, network_of
from mdp.array_types import Ints

_TARGETS = {"double_q": DOUBLE, "online": ONLINE_NETWORK, "target": TARGET_NETWORK}


class QTraining(NetworkTraining):
    """DQN, double DQN or deep Q-learning in training."""

    heeds_budgets = True  # a number of episodes to train for moves the schedules

    def __init__(self, agent: Any, seen: Any) -> None:
        super().__init__(agent, seen)
        self.recorded = agent._n_updates
        layers, n = self.networks[0].layers, agent.batch_size
        rules, self.place = self._rules(), record_of(PLACE, decided_at=-1)
        batch = Minibatch(
            make_inputs(layers, n),
            make_inputs(layers, n),
            np.zeros(n, np.int64),
            np.zeros(n, np.float32),
            np.zeros(n, np.float32),
        )
        rng = handles_of([agent.rng])
        centre, spread = np.zeros(layers.sizes[0]), np.ones(layers.sizes[0])
        self.memory = Reference(
            Memory(self._replay(), batch, self.place, rules, centre, spread, rng, layers.one_hot)
        )
        flat = self.trained.vector
        learner = QLearner(
            rules,
            self.place,
            layers,
            flat,
            self.lagging.vector,
            np.zeros_like(flat),
            self.optimizer.compiled,
            address_of(draw_minibatch, self.memory),
            np.uintp(self.memory.address),
            NOWHERE,
            batch,
            make_outputs(layers, n),
            make_outputs(layers, n),
            make_outputs(layers, n),
            make_inputs(layers, 1),
            make_outputs(layers, 1),
            rng,
        )
        self.begin(learner, learn_from_minibatch)

    def _rules(self) -> Any:
        agent = self.agent
        buffer = agent.replay_buffer
        n_steps = buffer.n_steps if type(buffer) is NStepReplayBuffer else 1
        return record_of(
            RULES,
            gamma=agent.gamma,
            tau=agent.tau,
            max_grad_norm=agent.max_grad_norm,
            largest_error=agent.largest_error,
            target_kind=_TARGETS[agent.target_kind],
            n_steps=n_steps,
            handles_timeouts=buffer.handle_timeout_termination,
            learning_starts=agent.learning_starts,
            train_freq=agent.train_freq.frequency,
            counts_episodes=agent.train_freq.unit == TrainFrequencyUnit.EPISODE,
            waits=self.waits,
            gradient_steps=agent.gradient_steps,
            target_interval=max(agent.target_update_interval // agent.n_envs, 1),
            **normalising_rules(agent.get_vec_normalize_env()),
        )

    def _replay(self) -> Replay:
        buffer = self.agent.replay_buffer
        n_places, n_envs = buffer.rewards.shape
        return Replay(
            buffer.observations.reshape(n_places, n_envs, -1),
            buffer.next_observations.reshape(n_places, n_envs, -1),
            buffer.actions,
            buffer.rewards,
            buffer.dones,
            buffer.timeouts,
        )

    def in_loop(self) -> QAgent:
        """What the compiled loop asks."""
        learner = self.learner
        choose, learn = (address_of(function, learner) for function in (choose_greedily, train))
        return QAgent(learner, self.memory, self.seen, choose, learn)

    def schedules(self) -> dict[str, Schedule]:
        """What compiled code works out after each step, by the names in its record."""
        return {
            "exploration": self.agent.exploration_schedule,
            "learning_rate": self.agent.lr_schedule,
        }

    def read_settings(self) -> None:
        """Take over what a callback has changed."""
        self.read_generator()
        self.read_tensors()
        self.held.rules[:] = self._rules()
        env = self.agent.get_vec_normalize_env()
        if env is not None and env.norm_obs:
            memory = self.memory.held
            memory.centre[:] = env.obs_rms.mean.ravel()
            memory.spread[:] = np.sqrt(env.obs_rms.var + env.epsilon).ravel()

    def take_over_progress(self, remaining: float) -> None:
        """Let the agent know how much of the training remains, after each step."""
        self.agent._current_progress_remaining = remaining

    def give_up_rollout(self) -> None:
        """Forget how much was collected since the last training."""
        self.place["collected"] = self.place["collected_episodes"] = 0

    def read(self) -> None:
        """Begin where the agent is."""
        agent, place = self.agent, self.place
        place["position"], place["full"] = agent.replay_buffer.pos, agent.replay_buffer.full
        place["n_calls"], place["n_updates"] = agent._n_calls, agent._n_updates
        place["exploration_rate"] = agent.exploration_rate
        place["collected"], place["collected_episodes"] = agent.collected

    def write(self) -> None:
        """Let the agent know where compiled code is."""
        agent, place = self.agent, self.place[0]
        buffer = agent.replay_buffer
        buffer.pos, buffer.full = int(place["position"]), bool(place["full"])
        agent._n_calls, agent._n_updates = int(place["n_calls"]), int(place["n_updates"])
        agent.exploration_rate = float(place["exploration_rate"])
        agent.collected = (int(place["collected"]), int(place["collected_episodes"]))

    def until_end(self, total_timesteps: int) -> int:
        """As everywhere, but until it would be time to train."""
        left, place, rules = super().until_end(total_timesteps), self.place[0], self.held.rules[0]
        begun, whole = int(place["collected"]), int(rules["train_freq"])
        if rules["counts_episodes"]:
            return max(left, min(begun, 1))
        return -(-(begun + left) // whole) * whole - begun

    def until_log(self, log_interval: int | None) -> Horizon:
        """When something is logged next."""
        if log_interval is None:
            return Horizon(NEVER, NEVER)
        return Horizon(NEVER, log_interval - self.agent._episode_num % log_interval)

    def count_episodes(self, n_episodes: int, log_interval: int | None) -> None:
        """Let the agent know of episodes that have ended, and log where it is time to."""
        agent = self.agent
        agent.logger.record("rollout/exploration_rate", agent.exploration_rate)
        for _ in range(n_episodes):
            agent._episode_num += 1
            if log_interval is not None and agent._episode_num % log_interval == 0:
                agent.dump_logs()

    def act(self, learning_starts: int) -> Ints:
        """Actions for the agent's present observations, where environments are Python's."""
        self.read()
        self.read_generator()
        self.trained.take_over()
        self.held.rules["learning_starts"] = learning_starts
        self.show(self.agent._last_obs)
        actions = np.zeros(len(self.shown), np.int64)
        act_on_rows(self.learner, self.shown, self.agent.num_timesteps, actions)
        return actions

    def train(self, n_updates: int) -> None:
        """Learn from minibatches of the replay buffer, where environments are Python's."""
        self.read()
        self.read_settings()
        agent = self.agent
        learning_rate = float(agent.lr_schedule(agent._current_progress_remaining))
        train(self.learner, float(n_updates), learning_rate)
        agent._n_updates += n_updates
        self._record_training()

    def before_training(self, log_interval: int | None) -> None:
        """Nothing: it logs by episodes."""

    @property
    def is_rollout_over(self) -> bool:
        """Whether a rollout waits to be learnt from, be it that nothing is learnt yet."""
        return bool(self.place["is_over"][0])

    def until_rollout_end(self) -> Horizon:
        """When a rollout ends that is to wait."""
        place, rules = self.place[0], self.held.rules[0]
        if not self.waits:
            return Horizon(NEVER, NEVER)
        if rules["counts_episodes"]:
            return Horizon(NEVER, int(rules["train_freq"] - place["collected_episodes"]))
        return Horizon(int(rules["train_freq"] - place["collected"]), NEVER)

    def learn_from_rollout(self, remaining: float) -> None:
        """Learn from the rollout that waits, with that share of the training left."""
        n_due, self.place["is_over"] = int(self.place["n_due"][0]), False
        if n_due:
            train(self.learner, float(n_due), float(self.agent.lr_schedule(remaining)))

    def record(self) -> None:
        """Hand what the last training has given to the agent's logger."""
        self.agent.logger.record("rollout/exploration_rate", self.agent.exploration_rate)
        self._record_training()

    def _record_training(self) -> None:
        agent, place = self.agent, self.place[0]
        if agent._n_updates == self.recorded:
            return
        self.recorded = agent._n_updates
        agent.logger.record("train/n_updates", agent._n_updates, exclude="tensorboard")
        agent.logger.record("train/loss", place["losses"] / place["n_losses"])
        agent.logger.record("train/learning_rate", float(place["learning_rate"]))
        update_learning_rate(agent.policy.optimizer, float(place["learning_rate"]))


def normalising_rules(env: VecNormalize | None) -> dict[str, Any]:
    """What VecNormalize does to observations and rewards, as settings in a record of `RULES`."""
    if env is None:
        return {}
    return {
        "normalises_observations": env.norm_obs,
        "clip_obs": env.clip_obs,
        "normalises_rewards": env.norm_reward,
        "reward_spread": np.sqrt(env.ret_rms.var + env.epsilon),
        "clip_reward": env.clip_reward,
    }


class CompiledQLearning(CompiledNetworks, stable_baselines3.DQN):
    """What DQN and its kin share; `CompiledNetworks` says what the argument ``engine`` does."""

    training_kind = QTraining
    # Where the value of the next state is taken from: the lagging copy, the same for the action
    # that the online network prefers, or the online network.
    target_kind: ClassVar[Literal["target", "double_q", "online"]] = "target"
    largest_error: ClassVar[float] = 1.0  # from where on the loss is no longer a square

    _training: QTraining | None
    _own = (*CompiledNetworks._own, "collected")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.collected = (0, 0)  # steps and episodes since the last training
        super().__init__(*args, **kwargs)

    @property
    def is_within_rollout(self) -> bool:
        return self.collected != (0, 0)

    def _check_own(self) -> None:
        if getattr(self, "mask_actions", False):
            raise NotCompilable("it masks actions")
        buffer = self.replay_buffer
        known = type(buffer) in {ReplayBuffer, NStepReplayBuffer}
        if not known or buffer.optimize_memory_usage:  # type: ignore[union-attr]
            raise NotCompilable("its replay buffer is of another kind")
        train_freq: Any = self.train_freq
        if self.n_envs > 1 and train_freq.unit == TrainFrequencyUnit.EPISODE:
            raise NotCompilable("train_freq counts the episodes of several environments")

    def shared_networks(self, seen: Any) -> tuple[list[Network], list[Network]]:
        one_hot = isinstance(seen, Numbers)
        ours, lagging = (
            network_of(network.q_net, 0, one_hot=one_hot)
            for network in (self.q_net, self.q_net_target)
        )
        return [ours], [lagging]

    def _work_of(self, n_steps: float) -> Work:
        train_freq: Any = self.train_freq
        frequency = float(train_freq.frequency)
        if train_freq.unit == TrainFrequencyUnit.EPISODE:
            frequency *= STEPS_OF_EPISODE
        between = frequency * self.n_envs
        at_once = self.gradient_steps if self.gradient_steps >= 0 else between
        n_updates = max(n_steps - self.learning_starts, 0.0) / between * at_once
        seen = self.observation_space
        return work_of("q", [self.q_net], seen, n_steps, self.n_envs, n_updates, self.batch_size)

    def _schedules(self) -> list[Schedule]:
        return [*super()._schedules(), self.exploration_schedule]

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        if not self._sharing:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        actions = self._shared_training().act(learning_starts)
        return actions, actions

    def _store_transition(self, replay_buffer: ReplayBuffer, *step: Any) -> None:
        super()._store_transition(replay_buffer, *step)
        if self._training is not None:
            self._training.check_numbers(replay_buffer.next_observations[replay_buffer.pos - 1])

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Take ``gradient_steps`` on batches of ``batch_size`` from the replay buffer."""
        if self._sharing:
            self._shared_training().train(gradient_steps)
        else:
            self._train_in_python(gradient_steps, batch_size)

    def _train_in_python(self, gradient_steps: int, batch_size: int) -> None:
        """The same in the library's way, or the agent's own."""
        super().train(gradient_steps, batch_size)
