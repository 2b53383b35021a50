"""Deep Q-learning on compiled code: minibatches, updates, and the base of its agents."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import stable_baselines3
from numpy.typing import NDArray
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import Schedule, TrainFrequencyUnit
from stable_baselines3.common.utils import update_learning_rate
from torch import nn

from rl_yardstick.agents.common.callbacks import Horizon
from rl_yardstick.agents.common.exploration import greedy_action
from rl_yardstick.agents.compiled.env_states import AFTER, BEFORE, Numbers, look, observe, show
from rl_yardstick.agents.compiled.loop import move_on
from rl_yardstick.agents.compiled.references import (
    Reference,
    address_of,
    call,
    handles_of,
    next_uniform,
)
from rl_yardstick.agents.compiled.worlds import NotCompilable
from rl_yardstick.agents.networks.engine import (
    NOWHERE,
    Network,
    NetworkTraining,
    network_of,
    record_of,
)
from rl_yardstick.agents.networks.engine_setting import STEPS_OF_EPISODE, CompiledNetworks
from rl_yardstick.agents.networks.perceptron import (
    Inputs,
    Layers,
    Optimizer,
    Singles,
    backward,
    descend,
    forward,
    last_outputs,
    make_inputs,
    make_outputs,
)
from rl_yardstick.machine_code.compiling import called, inlined, kernel
from rl_yardstick.mdp.transition_model import Floats, Ints

# Minibatches from the library's replay buffer, whose arrays are used directly.
#
# With n-step returns as in `stable_baselines3.common.buffers.NStepReplayBuffer`: rewards are summed
# until the episode ends, or the newest transition is reached. As in the library, the buffer stores
# unnormalised data, and VecNormalize's present statistics normalise a minibatch.


class Replay(NamedTuple):
    """Transitions of E environments in rings of N places."""

    observations: Any  # shape (N, E, d); numbers of states have d = 1
    next_observations: Any  # before any reset, same shape
    actions: Ints  # shape (N, E, 1)
    rewards: Singles  # shape (N, E)
    dones: Singles  # 1 where the episode ended, shape (N, E)
    timeouts: Singles  # 1 where only the time limit ended it, shape (N, E)


class Minibatch(NamedTuple):
    """A minibatch of B transitions."""

    states: Inputs  # observations, of B rows
    next_states: Inputs  # next observations, of B rows
    actions: Ints  # shape (B,)
    rewards: Singles  # discounted sums of the rewards in between, shape (B,)
    discounts: Singles  # factors of the next values, 0 after a termination, shape (B,)


class Memory(NamedTuple):
    """The replay buffer and the minibatch, to pass by reference."""

    replay: Replay  # the transitions
    batch: Minibatch  # to be filled
    place: NDArray[np.void]  # has the index of the next transition, and whether the ring is full
    rules: NDArray[np.void]  # has the discount factor, the steps and VecNormalize's settings
    centre: Floats  # VecNormalize's mean of observations, shape (d,)
    spread: Floats  # VecNormalize's divisor of observations, shape (d,)
    rng: NDArray[np.void]  # a handle of the agent's generator, shape (1,)
    one_hot: int  # whether observations are numbers of states


@inlined
def clipped(number: float, bound: float) -> float:
    """The number clipped to [-bound, bound]; nan stays nan."""
    if number > bound:
        return bound
    return -bound if number < -bound else number


@inlined
def show_normalised(memory: Memory, inputs: Inputs, i: int, row: Any) -> None:
    """As `show`, normalised by VecNormalize's present statistics."""
    rules = memory.rules[0]
    if not rules.normalises_observations:
        show(inputs, i, row, memory.one_hot)
        return
    for j in range(len(row)):
        moved = (row[j] - memory.centre[j]) / memory.spread[j]
        inputs.vectors[i, j] = np.float32(clipped(moved, rules.clip_obs))


@inlined
def reward_of(memory: Memory, at: int, env: int) -> Any:
    """A reward, normalised by VecNormalize's present statistics."""
    reward, rules = memory.replay.rewards[at, env], memory.rules[0]
    if not rules.normalises_rewards:
        return reward
    return np.float32(clipped(reward / rules.reward_spread, rules.clip_reward))


@kernel
def draw_minibatch(memory: Any, _: float, __: float) -> int:
    """Fill the minibatch with transitions drawn with replacement; return their number."""
    replay, batch, place = memory.replay, memory.batch, memory.place[0]
    rules, rng = memory.rules[0], memory.rng[0]
    n_places, n_envs = replay.rewards.shape
    filled = n_places if place.full else place.position
    newest = (place.position - 1) % n_places
    for i in range(len(batch.actions)):
        begin = int(next_uniform(rng) * filled)
        env = int(next_uniform(rng) * n_envs)
        at, discount, total = begin, np.float32(rules.gamma), reward_of(memory, begin, env)
        for _ in range(rules.n_steps - 1):
            if replay.dones[at, env] or replay.timeouts[at, env] or at == newest:
                break
            at = (at + 1) % n_places
            total += discount * reward_of(memory, at, env)
            discount *= np.float32(rules.gamma)
        if replay.dones[at, env] and not replay.timeouts[at, env]:
            discount = np.float32(0)
        show_normalised(memory, batch.states, i, replay.observations[begin, env])
        show_normalised(memory, batch.next_states, i, replay.next_observations[at, env])
        batch.actions[i] = replay.actions[begin, env, 0]
        batch.rewards[i] = total
        batch.discounts[i] = discount
    return len(batch.actions)


# One step of deep Q-learning on a minibatch.
#
# Sources: Mnih et al. (2013 and 2015), van Hasselt, Guez and Silver (2016).

# The source of the next state's value.
TARGET_NETWORK, DOUBLE, ONLINE_NETWORK = range(3)


@kernel
def learn_from_minibatch(learner: Any, learning_rate: float, _: float) -> int:
    """Take one step of gradient descent on `learner.batch`.

    Adds the loss before the step to ``place.losses``: Huber's, or half the squared error.
    """
    layers, batch, rules = learner.layers, learner.batch, learner.rules[0]
    n = len(batch.actions)
    lagging = learner.flat if rules.target_kind == ONLINE_NETWORK else learner.target
    forward(layers, lagging, batch.next_states, n, learner.next_outputs)
    next_values = last_outputs(layers, learner.next_outputs, n)
    preferred = next_values
    if rules.target_kind == DOUBLE:
        # `learner.outputs` is overwritten below, after the choice.
        forward(layers, learner.flat, batch.next_states, n, learner.outputs)
        preferred = last_outputs(layers, learner.outputs, n)
    for i in range(n):
        batch.rewards[i] += batch.discounts[i] * next_values[i, greedy_action(preferred[i], 0.0)]
    forward(layers, learner.flat, batch.states, n, learner.outputs)
    learner.place[0].losses += _errors(learner, n, rules.largest_error)
    backward(
        layers, learner.flat, batch.states, n, learner.outputs, learner.errors, learner.gradient
    )
    descend(learner.optimizer, learner.flat, learner.gradient, learning_rate, rules.max_grad_norm)
    return n


@called
def _errors(learner: Any, n: int, largest: float) -> float:
    """Write the loss's derivatives by the values, given targets in ``batch.rewards``."""
    batch = learner.batch
    values = last_outputs(learner.layers, learner.outputs, n)
    errors = last_outputs(learner.layers, learner.errors, n)
    errors[:] = 0
    loss = 0.0
    for i in range(n):
        error = float(values[i, batch.actions[i]] - batch.rewards[i])
        slope = min(max(error, -largest), largest)
        errors[i, batch.actions[i]] = np.float32(slope / n)
        # Half the square up to the largest slope, linear beyond.
        loss += slope * (error - slope / 2)
    return loss / n


@called
def follow(target: Singles, flat: Singles, tau: float) -> None:
    """Move the target network towards the online network by the share ``tau``."""
    for i in range(len(flat)):
        target[i] = target[i] * np.float32(1 - tau) + np.float32(tau) * flat[i]


# Deep Q-learning on the compiled loop, in the order of events of Stable-Baselines3.

# Settings, with the library's names if they exist there.
RULES = np.dtype(
    [
        ("gamma", np.float64),
        ("tau", np.float64),
        ("max_grad_norm", np.float64),
        ("largest_error", np.float64),  # beyond this error the loss is linear
        ("target_kind", np.int64),
        ("n_steps", np.int64),
        ("handles_timeouts", np.bool_),  # bootstrap after a time limit
        ("learning_starts", np.int64),
        ("train_freq", np.int64),
        ("counts_episodes", np.bool_),  # instead of steps, for train_freq
        ("gradient_steps", np.int64),
        ("target_interval", np.int64),  # in steps of all environments
        ("normalises_observations", np.bool_),  # by VecNormalize
        ("clip_obs", np.float64),
        ("normalises_rewards", np.bool_),
        ("reward_spread", np.float64),
        ("clip_reward", np.float64),
    ],
    align=True,
)

# The progress of the training.
PLACE = np.dtype(
    [
        ("position", np.int64),  # of the next transition in the ring
        ("full", np.bool_),
        ("n_calls", np.int64),
        ("collected", np.int64),  # steps of all environments since the last training
        ("collected_episodes", np.int64),
        ("n_updates", np.int64),
        ("exploration_rate", np.float64),
        ("decided_at", np.int64),  # the time step of `explores`
        ("explores", np.bool_),
        ("losses", np.float64),  # sum over the last training
        ("n_losses", np.int64),
        ("learning_rate", np.float64),  # of the last training
    ],
    align=True,
)


class QLearner(NamedTuple):
    """A network of action values for compiled functions, to pass by reference."""

    rules: NDArray[np.void]  # a record of type `RULES`, shape (1,)
    place: NDArray[np.void]  # a record of type `PLACE`, shape (1,)
    layers: Layers  # the shape of the network
    flat: Singles  # its parameters
    target: Singles  # the parameters of the target network
    gradient: Singles  # scratch, as long
    optimizer: Optimizer  # of the parameters
    draw: np.uintp  # the address of `draw_minibatch` for the type of observations
    memory: np.uintp  # the address of the `Memory`
    improve: np.uintp  # the address of `learn_from_minibatch`
    batch: Minibatch  # the minibatch
    outputs: Singles  # buffer for outputs on the minibatch
    next_outputs: Singles  # buffer for outputs on its next states
    errors: Singles  # buffer for derivatives
    single: Inputs  # buffer for one observation
    single_outputs: Singles  # buffer for its outputs
    rng: NDArray[np.void]  # a handle of the agent's generator, shape (1,)


@kernel
def choose_greedily(learner: Any, _: float, __: float) -> int:
    """The best action for the observation in ``learner.single``."""
    forward(learner.layers, learner.flat, learner.single, 1, learner.single_outputs)
    return greedy_action(last_outputs(learner.layers, learner.single_outputs, 1)[0], 0.0)


@kernel
def train(learner: Any, n_updates: float, learning_rate: float) -> int:
    """Learn from ``n_updates`` minibatches; return their number."""
    place = learner.place[0]
    place.losses, place.n_losses, place.learning_rate = 0.0, int(n_updates), learning_rate
    for _ in range(int(n_updates)):
        call(learner.draw, learner.memory, 0.0, 0.0)
        call(learner.improve, learner, learning_rate, 0.0)
    place.n_updates += int(n_updates)
    return int(n_updates)


class QAgent(NamedTuple):
    """The agent for the compiled loop."""

    learner: Any  # a reference to a `QLearner`
    memory: Any  # a reference to its `Memory`
    seen: Any  # how observations are read, of `agents.compiled.env_states`
    choose: np.uintp  # the address of `choose_greedily`
    train: np.uintp  # the address of `train`

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Choose randomly or greedily; one random number decides for all environments."""
        learner = self.learner
        place = learner.place[0]
        if place.decided_at != progress.num_timesteps:
            place.decided_at = progress.num_timesteps
            place.explores = explores(learner, progress.num_timesteps)
        if place.explores:
            env.action = random_action(learner)
        else:
            look(self.seen, env, BEFORE, learner.single, learner.layers.one_hot)
            env.action = call(self.choose, learner, 0.0, 0.0)

    @inlined
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Store the transitions, and train if it is due."""
        n_done = 0
        for i in range(len(envs)):
            store(self, envs[i], i)
            n_done += envs[i].done
            move_on(self.seen, envs[i])
        count_step(self, progress.exploration, n_done)
        n_updates = updates_due(self.learner, progress.num_timesteps, len(envs))
        if n_updates > 0:
            call(self.train, self.learner, float(n_updates), progress.learning_rate)


@inlined
def explores(learner: Any, num_timesteps: int) -> bool:
    """Whether the next actions are random: always in the warm-up, then by the exploration rate."""
    if num_timesteps < learner.rules[0].learning_starts:
        return True
    return bool(next_uniform(learner.rng[0]) < learner.place[0].exploration_rate)


@inlined
def random_action(learner: Any) -> int:
    """A uniformly random action."""
    return int(next_uniform(learner.rng[0]) * learner.layers.sizes[-1])


@kernel
def act_on_rows(learner: Any, shown: Any, num_timesteps: int, actions: Ints) -> None:
    """Choose actions, shape (n,), for observations of shape (n, d)."""
    random = explores(learner, num_timesteps)
    for i in range(len(actions)):
        if random:
            actions[i] = random_action(learner)
        else:
            show(learner.single, 0, shown[i], learner.layers.one_hot)
            actions[i] = choose_greedily(learner, 0.0, 0.0)


@inlined
def store(agent: QAgent, env: Any, i: int) -> None:
    """Store the step of environment ``i``."""
    replay, position = agent.memory.replay, agent.learner.place[0].position
    observe(agent.seen, env, BEFORE, replay.observations[position, i])
    observe(agent.seen, env, AFTER, replay.next_observations[position, i])
    replay.actions[position, i, 0] = env.action
    replay.rewards[position, i] = np.float32(env.reward)
    replay.dones[position, i] = np.float32(env.done)
    cut_off = env.done and not env.terminated and agent.learner.rules[0].handles_timeouts
    replay.timeouts[position, i] = np.float32(cut_off)


@inlined
def count_step(agent: QAgent, exploration_rate: float, n_done: int) -> None:
    """Count a step of every environment, and update the target network if it is due."""
    learner = agent.learner
    place, rules = learner.place[0], learner.rules[0]
    place.position += 1
    if place.position == len(agent.memory.replay.rewards):
        place.full, place.position = True, 0
    place.n_calls += 1
    if place.n_calls % rules.target_interval == 0:
        follow(learner.target, learner.flat, rules.tau)
    place.exploration_rate = exploration_rate
    place.collected += 1
    place.collected_episodes += n_done


@inlined
def updates_due(learner: Any, num_timesteps: int, n_envs: int) -> int:
    """The number of minibatches to learn from now: 0 unless enough has been collected."""
    place, rules = learner.place[0], learner.rules[0]
    collected = place.collected_episodes if rules.counts_episodes else place.collected
    if collected < rules.train_freq:
        return 0
    n_steps = place.collected * n_envs
    place.collected = place.collected_episodes = 0
    if num_timesteps <= rules.learning_starts:
        return 0
    return int(n_steps if rules.gradient_steps < 0 else rules.gradient_steps)


# By the agents' `target_kind`.
_TARGETS = {"double_q": DOUBLE, "online": ONLINE_NETWORK, "target": TARGET_NETWORK}


class QTraining(NetworkTraining):
    """DQN, double DQN or deep Q-learning in training."""

    goes_by_episodes = True  # in its log; and a budget of episodes affects the schedules
    rollout_counts = ("collected", "collected_episodes")  # since the last training

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
        normalising: dict[str, Any] = {}
        if (env := agent.get_vec_normalize_env()) is not None:
            normalising = {
                "normalises_observations": env.norm_obs,
                "clip_obs": env.clip_obs,
                "normalises_rewards": env.norm_reward,
                "reward_spread": np.sqrt(env.ret_rms.var + env.epsilon),
                "clip_reward": env.clip_reward,
            }
        return record_of(
            RULES,
            agent,
            target_kind=_TARGETS[agent.target_kind],
            n_steps=n_steps,
            handles_timeouts=buffer.handle_timeout_termination,
            train_freq=agent.train_freq.frequency,
            counts_episodes=agent.train_freq.unit == TrainFrequencyUnit.EPISODE,
            target_interval=max(agent.target_update_interval // agent.n_envs, 1),
            **normalising,
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
        """The agent for the compiled loop."""
        learner = self.learner
        choose, learn = (address_of(function, learner) for function in (choose_greedily, train))
        return QAgent(learner, self.memory, self.seen, choose, learn)

    def read_settings(self) -> None:
        """Read settings that a callback may have changed."""
        self.read_tensors()
        self.held.rules[:] = self._rules()
        env = self.agent.get_vec_normalize_env()
        if env is not None and env.norm_obs:
            memory = self.memory.held
            memory.centre[:] = env.obs_rms.mean.ravel()
            memory.spread[:] = np.sqrt(env.obs_rms.var + env.epsilon).ravel()

    def read(self) -> None:
        """Copy the agent's counters into the compiled record."""
        agent, place = self.agent, self.place
        place["position"], place["full"] = agent.replay_buffer.pos, agent.replay_buffer.full
        place["n_calls"], place["n_updates"] = agent._n_calls, agent._n_updates
        place["exploration_rate"] = agent.exploration_rate
        place["collected"], place["collected_episodes"] = agent.collected

    def write(self) -> None:
        """Copy the compiled record's counters to the agent."""
        agent, place = self.agent, self.place[0]
        buffer = agent.replay_buffer
        buffer.pos, buffer.full = int(place["position"]), bool(place["full"])
        agent._n_calls, agent._n_updates = int(place["n_calls"]), int(place["n_updates"])
        agent.exploration_rate = float(place["exploration_rate"])
        agent.collected = (int(place["collected"]), int(place["collected_episodes"]))

    def until_end(self, left: int) -> int:
        """The steps until the first training that is due after ``left`` steps."""
        place, rules = self.place[0], self.held.rules[0]
        begun, whole = int(place["collected"]), int(rules["train_freq"])
        if rules["counts_episodes"]:
            return max(left, min(begun, 1))
        return -(-(begun + left) // whole) * whole - begun

    def until_log(self, log_interval: int | None) -> Horizon:
        """The steps or episodes until the next log record."""
        if log_interval is None:
            return Horizon()
        return Horizon(episodes=log_interval - self.agent._episode_num % log_interval)

    def act(self, learning_starts: int) -> Ints:
        """Actions for the agent's present observations, with environments in Python."""
        self.read()
        self.read_tensors()
        self.held.rules["learning_starts"] = learning_starts
        self.show(self.agent._last_obs)
        actions = np.zeros(len(self.shown), np.int64)
        act_on_rows(self.learner, self.shown, self.agent.num_timesteps, actions)
        return actions

    def train(self, n_updates: int) -> None:
        """Learn from minibatches of the replay buffer, with environments in Python."""
        self.read()
        self.read_settings()
        agent = self.agent
        learning_rate = float(agent.lr_schedule(agent._current_progress_remaining))
        train(self.learner, float(n_updates), learning_rate)
        agent._n_updates += n_updates
        self._record_training()

    def record(self) -> None:
        """Record the last training in the agent's logger."""
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


class CompiledQLearning(CompiledNetworks, stable_baselines3.DQN):
    """The base of DQN and its variants; see `CompiledNetworks` for the argument ``engine``."""

    training_kind = QTraining
    # The source of the next state's value: the target network, the target network at the online
    # network's best action, or the online network.
    target_kind: ClassVar[Literal["target", "double_q", "online"]] = "target"
    largest_error: ClassVar[float] = 1.0  # beyond this error the loss is linear

    _training: QTraining | None
    _own = (*CompiledNetworks._own, "collected")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.collected = (0, 0)  # steps and episodes since the last training
        super().__init__(*args, **kwargs)

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

    def _planned(self, n_steps: float) -> tuple[list[nn.Module], float, float, int]:
        train_freq: Any = self.train_freq
        frequency = float(train_freq.frequency)
        if train_freq.unit == TrainFrequencyUnit.EPISODE:
            frequency *= STEPS_OF_EPISODE
        between = frequency * self.n_envs
        at_once = self.gradient_steps if self.gradient_steps >= 0 else between
        n_updates = max(n_steps - self.learning_starts, 0.0) / between * at_once
        return [self.q_net], n_steps, n_updates, self.batch_size

    def schedules(self) -> dict[str, Schedule]:
        return {**super().schedules(), "exploration": self.exploration_schedule}

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
        """Take ``gradient_steps`` steps on batches of ``batch_size`` from the replay buffer."""
        if self._sharing:
            self._shared_training().train(gradient_steps)
        else:
            self._train_in_python(gradient_steps, batch_size)

    def _train_in_python(self, gradient_steps: int, batch_size: int) -> None:
        """Train with PyTorch, as the library or the agent itself does."""
        super().train(gradient_steps, batch_size)
