"""PPO and A2C on compiled code: rollouts, updates, and the base of these agents."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from rl_yardstick.agents.common.callbacks import Horizon
from rl_yardstick.agents.common.schedules import ScheduleRow, schedule_value
from rl_yardstick.agents.compiled.env_states import AFTER, BEFORE, Numbers, look, observe, show
from rl_yardstick.agents.compiled.learning_algorithm import compiled_schedule
from rl_yardstick.agents.compiled.loop import move_on
from rl_yardstick.agents.compiled.references import (
    Reference,
    address_of,
    call,
    handles_of,
    next_uniform,
)
from rl_yardstick.agents.compiled.worlds import SCHEDULE, NotCompilable
from rl_yardstick.agents.networks.engine import (
    NOWHERE,
    Network,
    NetworkTraining,
    network_of,
    record_of,
)
from rl_yardstick.agents.networks.engine_setting import CompiledNetworks
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
    n_parameters,
)
from rl_yardstick.machine_code.compiling import called, inlined, kernel
from rl_yardstick.mdp.transition_model import Bools, Ints

# The softmax distribution over actions, from a network's outputs (logits).


@inlined
def log_normalizer(logits: Singles) -> float:
    """The logarithm of the sum of exponentials of logits, shape (n,)."""
    top = logits[0]
    for k in range(1, len(logits)):
        top = max(top, logits[k])
    total = 0.0
    for k in range(len(logits)):
        total += math.exp(float(logits[k] - top))
    return float(top) + math.log(total)


@inlined
def draw(logits: Singles, uniform: float) -> int:
    """Sample an action by a uniform number in [0, 1)."""
    normalizer, cumulative = log_normalizer(logits), 0.0
    for k in range(len(logits) - 1):
        cumulative += math.exp(float(logits[k]) - normalizer)
        if uniform < cumulative:
            return k
    return len(logits) - 1


@inlined
def fill_probabilities(logits: Singles, normalizer: float, probabilities: Any) -> float:
    """Fill in all probabilities, shape (n,); return the entropy in nats."""
    entropy = 0.0
    for k in range(len(logits)):
        logarithm = float(logits[k]) - normalizer
        probability = math.exp(logarithm)
        entropy -= probability * logarithm
        probabilities[k] = np.float32(probability)
    return entropy


# The library's rollout buffer, whose arrays are used directly: advantages and minibatches.


class Rollout(NamedTuple):
    """The library's rollout buffer without observations, by its names: T steps, E environments."""

    actions: Ints  # shape (T, E, 1)
    rewards: Singles  # shape (T, E)
    episode_starts: Singles  # 1 where an episode began with the observation, shape (T, E)
    values: Singles  # of the observations, shape (T, E)
    log_probs: Singles  # of the actions, shape (T, E)
    advantages: Singles  # shape (T, E)
    returns: Singles  # targets of the values, shape (T, E)


class RolloutMemory(NamedTuple):
    """The rollout buffer and the minibatch, to pass by reference."""

    observations: Any  # shape (T, E, d); numbers of states have d = 1
    rollout: Rollout  # the rest of the buffer
    order: Ints  # numbers of the rollout's steps, shuffled, shape (T * E,)
    batch: Any  # a `RolloutMinibatch` to be filled
    one_hot: int  # whether observations are numbers of states


@kernel
def estimate_advantages(learner: Any, _: float, __: float) -> int:
    """Generalised advantage estimation (Schulman et al., 2016), from the last step backwards."""
    rollout, rules = learner.rollout, learner.rules[0]
    n_steps, n_envs = rollout.rewards.shape
    gamma = rules.buffer_gamma
    for i in range(n_envs):
        advantage, next_value = 0.0, float(learner.last_values[i])
        goes_on = 1.0 - learner.starts[i]
        for step in range(n_steps - 1, -1, -1):
            value = float(rollout.values[step, i])
            error = rollout.rewards[step, i] + gamma * next_value * goes_on - value
            advantage = error + gamma * rules.gae_lambda * goes_on * advantage
            rollout.advantages[step, i] = np.float32(advantage)
            rollout.returns[step, i] = np.float32(advantage + value)
            next_value, goes_on = value, 1.0 - rollout.episode_starts[step, i]
    return 0


@called
def explained_variance(rollout: Rollout) -> float:
    """1 - Var(returns - values) / Var(returns), as in the library's log; nan for equal returns."""
    n_steps, n_envs = rollout.returns.shape
    n, mean, mean_error = n_steps * n_envs, 0.0, 0.0
    for step in range(n_steps):
        for i in range(n_envs):
            mean += rollout.returns[step, i] / n
            mean_error += (rollout.returns[step, i] - rollout.values[step, i]) / n
    variance = unexplained = 0.0
    for step in range(n_steps):
        for i in range(n_envs):
            error = rollout.returns[step, i] - rollout.values[step, i]
            variance += (rollout.returns[step, i] - mean) ** 2
            unexplained += (error - mean_error) ** 2
    return 1.0 - unexplained / variance if variance > 0 else math.nan


@inlined
def shuffle(numbers: Ints, handle: Any) -> None:
    """Put 0, 1, ... into a random order (Fisher and Yates)."""
    for i in range(len(numbers)):
        numbers[i] = i
    for i in range(len(numbers) - 1, 0, -1):
        j = int(next_uniform(handle) * (i + 1))
        numbers[i], numbers[j] = numbers[j], numbers[i]


@kernel
def pick_steps(memory: Any, begin: float, n: float) -> int:
    """Copy ``n`` steps of the rollout into the minibatch, in ``memory.order`` from ``begin`` on."""
    rollout, batch, first = memory.rollout, memory.batch, int(begin)
    n_envs = rollout.rewards.shape[1]
    for k in range(int(n)):
        number = memory.order[first + k]
        step, i = number // n_envs, number % n_envs
        show(batch.states, k, memory.observations[step, i], memory.one_hot)
        batch.actions[k] = int(rollout.actions[step, i, 0])
        batch.log_probs[k] = rollout.log_probs[step, i]
        batch.advantages[k] = rollout.advantages[step, i]
        batch.returns[k] = rollout.returns[step, i]
        batch.values[k] = rollout.values[step, i]
    return int(n)


# One step of proximal policy optimisation on a minibatch.
#
# A2C is the same with one minibatch of the whole rollout and no clipping (Huang et al., 2022),
# because the ratio of probabilities is 1.
#
# Source: Schulman et al. (2017), in the form of Stable-Baselines3.

# Figures of a minibatch for the library's log.
LOSSES = np.dtype(
    [
        ("policy_gradient", np.float64),
        ("likelihood", np.float64),  # minus the mean of advantage times log-probability
        ("value", np.float64),
        ("entropy", np.float64),
        ("total", np.float64),
        ("kl", np.float64),  # Schulman's estimate
        ("clipped", np.float64),  # share of the ratios
    ],
    align=True,
)


class RolloutMinibatch(NamedTuple):
    """A minibatch of B steps."""

    states: Inputs  # observations, of B rows
    actions: Ints  # shape (B,)
    log_probs: Singles  # of the actions when they were taken, shape (B,)
    advantages: Singles  # shape (B,)
    returns: Singles  # targets of the values, shape (B,)
    values: Singles  # at the time of the rollout, shape (B,)


@kernel
def learn_from_rollout_minibatch(learner: Any, n_rows: float, learning_rate: float) -> int:
    """Take one step of gradient descent on the first ``n_rows`` rows of `learner.batch`.

    Returns 0, without a step, if the policy has moved too far already (``target_kl``); else 1.
    """
    batch, rules, losses = learner.batch, learner.rules[0], learner.losses[0]
    n = int(n_rows)
    if rules.normalize_advantage and n > 1:
        standardize(batch.advantages[:n])
    states = batch.states
    forward(learner.policy, learner.flat, states, n, learner.policy_outputs)
    forward(learner.value, learner.flat, states, n, learner.value_outputs)
    _policy_errors(learner, n, learner.place[0].clip_range)
    _value_errors(learner, n, learner.place[0].clip_range_vf)
    losses.total = (
        losses.policy_gradient + rules.ent_coef * losses.entropy + rules.vf_coef * losses.value
    )
    if losses.kl > 1.5 * rules.target_kl:
        return 0
    for layers, outputs, errors in (
        (learner.policy, learner.policy_outputs, learner.policy_errors),
        (learner.value, learner.value_outputs, learner.value_errors),
    ):
        backward(layers, learner.flat, states, n, outputs, errors, learner.gradient)
    descend(learner.optimizer, learner.flat, learner.gradient, learning_rate, rules.max_grad_norm)
    return 1


@called
def standardize(numbers: Singles) -> None:
    """Scale the numbers to mean 0 and standard deviation 1."""
    n = len(numbers)
    mean = squares = 0.0
    for i in range(n):
        mean += numbers[i]
    mean /= n
    for i in range(n):
        squares += (numbers[i] - mean) ** 2
    scale = 1.0 / (math.sqrt(squares / (n - 1)) + 1e-8)
    for i in range(n):
        numbers[i] = np.float32((numbers[i] - mean) * scale)


@called
def _policy_errors(learner: Any, n: int, clip_range: float) -> None:
    """Write the loss's derivatives by the logits, and record the policy's part of the loss."""
    batch, losses = learner.batch, learner.losses[0]
    logits = last_outputs(learner.policy, learner.policy_outputs, n)
    slopes = last_outputs(learner.policy, learner.policy_errors, n)
    losses.policy_gradient = losses.likelihood = losses.entropy = 0.0
    losses.kl = losses.clipped = 0.0
    by_entropy = -learner.rules[0].ent_coef / n
    for i in range(n):
        row, action, advantage = logits[i], batch.actions[i], float(batch.advantages[i])
        normalizer = log_normalizer(row)
        log_prob = float(row[action]) - normalizer
        log_ratio = log_prob - batch.log_probs[i]
        ratio = math.exp(log_ratio)
        bounded = min(max(ratio, 1 - clip_range), 1 + clip_range)
        gain = min(advantage * ratio, advantage * bounded)
        # A ratio beyond its bound has no gradient, unless the gradient would move it back.
        moves = ratio == bounded or advantage * ratio < advantage * bounded
        by_log = -advantage * ratio / n if moves else 0.0
        entropy = fill_probabilities(row, normalizer, slopes[i])
        for k in range(len(row)):
            surplus = float(row[k]) - normalizer + entropy
            slope = -float(slopes[i, k]) * (by_log + by_entropy * surplus)
            slopes[i, k] = np.float32(slope + by_log if k == action else slope)
        losses.policy_gradient -= gain / n
        losses.likelihood -= advantage * log_prob / n
        losses.entropy -= entropy / n
        losses.kl += (ratio - 1 - log_ratio) / n
        losses.clipped += (1.0 / n) if abs(ratio - 1) > clip_range else 0.0


@called
def _value_errors(learner: Any, n: int, clip_range_vf: float) -> None:
    """Write the loss's derivatives by the values, and record their part of the loss."""
    batch, losses = learner.batch, learner.losses[0]
    values = last_outputs(learner.value, learner.value_outputs, n)
    slopes = last_outputs(learner.value, learner.value_errors, n)
    losses.value = 0.0
    factor = 2 * learner.rules[0].vf_coef / n
    for i in range(n):
        moved = float(values[i, 0]) - batch.values[i]
        predicted = batch.values[i] + min(max(moved, -clip_range_vf), clip_range_vf)
        error = predicted - batch.returns[i]
        slopes[i, 0] = np.float32(factor * error) if abs(moved) <= clip_range_vf else np.float32(0)
        losses.value += error * error / n


# Policy optimisation on the compiled loop, in the order of events of Stable-Baselines3.

# Settings, with the library's names if they exist there.
RULES = np.dtype(
    [
        ("gamma", np.float64),  # for bootstrapping truncated episodes
        ("buffer_gamma", np.float64),  # for advantages, which the library computes in its buffer
        ("gae_lambda", np.float64),
        ("ent_coef", np.float64),
        ("vf_coef", np.float64),
        ("max_grad_norm", np.float64),
        ("target_kl", np.float64),  # infinite for none
        ("normalize_advantage", np.bool_),
        ("n_epochs", np.int64),
        ("clip_range", SCHEDULE),
        ("clip_range_vf", SCHEDULE),
    ],
    align=True,
)

# The progress of the training.
PLACE = np.dtype(
    [
        ("step", np.int64),  # of the rollout
        ("n_rollouts", np.int64),
        ("n_updates", np.int64),  # epochs, as in the library
        ("remaining", np.float64),  # share of the training left at the last rollout
        ("clip_range", np.float64),  # for ratios of probabilities
        ("clip_range_vf", np.float64),  # for changes of values
        ("policy_gradient", np.float64),  # means over the last training
        ("value", np.float64),
        ("entropy", np.float64),
        ("clipped", np.float64),
        ("kl", np.float64),  # over its last epoch
        ("explained", np.float64),  # explained variance of the returns by the values before it
        ("expected", np.float64),  # value of the last evaluated observation
        ("log_probability", np.float64),  # of the last drawn action
    ],
    align=True,
)


class PolicyLearner(NamedTuple):
    """Networks of action probabilities and of values for compiled functions."""

    rules: NDArray[np.void]  # a record of type `RULES`, shape (1,)
    place: NDArray[np.void]  # a record of type `PLACE`, shape (1,)
    losses: NDArray[np.void]  # a record of type `LOSSES`, shape (1,)
    policy: Layers  # the shape of the policy network
    value: Layers  # the shape of the value network
    flat: Singles  # the parameters of both
    gradient: Singles  # scratch, as long
    optimizer: Optimizer  # of the parameters
    rollout: Rollout  # the rollout buffer
    pick: np.uintp  # the address of `pick_steps` for the type of observations
    memory: np.uintp  # the address of the `RolloutMemory`
    starts: Singles  # whether the present observations begin episodes, shape (E,)
    last_values: Singles  # values of the observations after the rollout, shape (E,)
    improve: np.uintp  # the address of `learn_from_rollout_minibatch`
    order: Ints  # numbers of the rollout's steps, to be shuffled, shape (T * E,)
    batch: RolloutMinibatch  # the minibatch
    policy_outputs: Singles  # buffer for outputs of the policy network
    policy_errors: Singles  # buffer for derivatives
    value_outputs: Singles  # as for the policy
    value_errors: Singles  # as for the policy
    single: Inputs  # buffer for one observation
    rng: NDArray[np.void]  # a handle of the agent's generator, shape (1,)


@kernel
def evaluate(learner: Any, _: float, __: float) -> int:
    """Store the value of the observation in ``learner.single`` in ``place.expected``."""
    forward(learner.value, learner.flat, learner.single, 1, learner.value_outputs)
    values = last_outputs(learner.value, learner.value_outputs, 1)
    learner.place[0].expected = float(values[0, 0])
    return 0


@kernel
def choose_randomly(learner: Any, _: float, __: float) -> int:
    """An action for the observation in ``learner.single``; stores value and log-probability."""
    evaluate(learner, 0.0, 0.0)
    forward(learner.policy, learner.flat, learner.single, 1, learner.policy_outputs)
    logits = last_outputs(learner.policy, learner.policy_outputs, 1)[0]
    action = draw(logits, next_uniform(learner.rng[0]))
    learner.place[0].log_probability = float(logits[action]) - log_normalizer(logits)
    return action


@kernel
def train(learner: Any, remaining: float, learning_rate: float) -> int:
    """Learn from the whole rollout in each epoch; return the number of minibatches."""
    place, rules = learner.place[0], learner.rules[0]
    place.step, place.remaining = 0, remaining
    place.n_rollouts += 1
    place.explained = explained_variance(learner.rollout)
    place.clip_range = schedule_value(rules.clip_range, remaining)
    place.clip_range_vf = schedule_value(rules.clip_range_vf, remaining)
    place.policy_gradient = place.value = place.entropy = place.clipped = 0.0
    n_batches, goes_on = 0, True
    for _ in range(rules.n_epochs):
        shuffle(learner.order, learner.rng[0])
        n_in_epoch, goes_on = learn_for_an_epoch(learner, learning_rate)
        n_batches += n_in_epoch
        place.n_updates += 1
        if not goes_on:
            break
    place.policy_gradient /= n_batches
    place.value /= n_batches
    place.entropy /= n_batches
    place.clipped /= n_batches
    return n_batches


@inlined
def learn_for_an_epoch(learner: Any, learning_rate: float) -> tuple[int, bool]:
    """Learn from the rollout once; return the number of minibatches, and False at `target_kl`."""
    place, losses = learner.place[0], learner.losses[0]
    n_steps, size = len(learner.order), len(learner.batch.actions)
    place.kl, n_batches, goes_on = 0.0, 0, True
    for begin in range(0, n_steps, size):
        n = min(size, n_steps - begin)
        call(learner.pick, learner.memory, float(begin), float(n))
        goes_on = call(learner.improve, learner, float(n), learning_rate) == 1
        place.policy_gradient += losses.policy_gradient
        place.value += losses.value
        place.entropy += losses.entropy
        place.clipped += losses.clipped
        place.kl += losses.kl
        n_batches += 1
        if not goes_on:
            break
    place.kl /= n_batches
    return n_batches, goes_on


class PolicyAgent(NamedTuple):
    """The agent for the compiled loop."""

    learner: Any  # a reference to a `PolicyLearner`
    memory: Any  # a reference to its `RolloutMemory`
    seen: Any  # how observations are read, of `agents.compiled.env_states`
    choose: np.uintp  # the address of `choose_randomly`
    evaluate: np.uintp  # the address of `evaluate`
    estimate: np.uintp  # the address of `estimate_advantages`
    train: np.uintp  # the address of `train`

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Draw an action, and store its log-probability and the value."""
        look(self.seen, env, BEFORE, self.learner.single, self.learner.policy.one_hot)
        env.action = call(self.choose, self.learner, 0.0, 0.0)
        env.value = self.learner.place[0].expected
        env.log_probability = self.learner.place[0].log_probability

    @inlined
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Store the step, and train at the end of the rollout."""
        learner = self.learner
        for i in range(len(envs)):
            note_step(self, envs[i], i)
            move_on(self.seen, envs[i])
        learner.place[0].step += 1
        if learner.place[0].step == len(learner.rollout.rewards):
            for i in range(len(envs)):
                learner.last_values[i] = np.float32(value_at(self, envs[i], BEFORE))
            call(self.estimate, learner, 0.0, 0.0)
            call(self.train, learner, progress.remaining, progress.learning_rate)


@inlined
def value_at(agent: PolicyAgent, env: Any, moment: int) -> float:
    """The value of an environment's observation at this moment."""
    learner = agent.learner
    look(agent.seen, env, moment, learner.single, learner.policy.one_hot)
    call(agent.evaluate, learner, 0.0, 0.0)
    return float(learner.place[0].expected)


@inlined
def note_step(agent: PolicyAgent, env: Any, i: int) -> None:
    """Store the step of environment ``i``."""
    learner = agent.learner
    rollout, step = learner.rollout, learner.place[0].step
    observe(agent.seen, env, BEFORE, agent.memory.observations[step, i])
    rollout.actions[step, i, 0] = np.float32(env.action)
    rollout.values[step, i] = np.float32(env.value)
    rollout.log_probs[step, i] = np.float32(env.log_probability)
    rollout.episode_starts[step, i] = learner.starts[i]
    reward = np.float32(env.reward)
    if env.done and not env.terminated:
        # The episode was truncated: add the discounted value of its last state to the reward.
        gamma = np.float32(learner.rules[0].gamma)
        reward += gamma * np.float32(value_at(agent, env, AFTER))
    rollout.rewards[step, i] = reward
    learner.starts[i] = np.float32(env.done)


@kernel
def act_on_rows(learner: Any, shown: Any, actions: Ints) -> None:
    """Choose and store actions, shape (E,), for observations of shape (E, d)."""
    rollout, place = learner.rollout, learner.place[0]
    step = place.step
    for i in range(len(actions)):
        show(learner.single, 0, shown[i], learner.policy.one_hot)
        actions[i] = choose_randomly(learner, 0.0, 0.0)
        rollout.values[step, i] = np.float32(place.expected)
        rollout.log_probs[step, i] = np.float32(place.log_probability)
        rollout.actions[step, i, 0] = np.float32(actions[i])
        rollout.episode_starts[step, i] = learner.starts[i]


@kernel
def evaluate_rows(learner: Any, shown: Any, values: Singles) -> None:
    """Fill in the values, shape (n,), of observations of shape (n, d)."""
    for i in range(len(values)):
        show(learner.single, 0, shown[i], learner.policy.one_hot)
        evaluate(learner, 0.0, 0.0)
        values[i] = np.float32(learner.place[0].expected)


# The clip range for no clipping.
UNBOUNDED = 1e30


class PolicyTraining(NetworkTraining):
    """PPO or A2C in training; the first of its networks gives action probabilities."""

    # It logs by rollouts; as in the library, a budget of episodes does not affect the schedules.
    goes_by_episodes = False
    rollout_counts = ("step", "n_rollouts")

    def __init__(self, agent: Any, seen: Any) -> None:
        super().__init__(agent, seen)
        actor, critic = (network.layers for network in self.networks)
        n_steps = agent.n_steps * agent.n_envs
        size = min(getattr(agent, "batch_size", n_steps), n_steps)
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
            agent,
            buffer_gamma=agent.rollout_buffer.gamma,
            gae_lambda=agent.rollout_buffer.gae_lambda,
            target_kl=np.inf if target_kl is None else target_kl,
            n_epochs=getattr(agent, "n_epochs", 1),
            clip_range=tuple(bound(getattr(agent, "clip_range", None))),
            clip_range_vf=tuple(bound(getattr(agent, "clip_range_vf", None))),
        )

    def _bound_now(self, schedule: Schedule | None) -> ScheduleRow:
        """The present value of a clip range's schedule, as a constant schedule."""
        if schedule is None:
            return _bound(None)
        return _bound(FloatSchedule(schedule(self.agent._current_progress_remaining)))

    def read_settings(self) -> None:
        """Read settings that a callback may have changed."""
        self.read_tensors()
        self.held.rules[:] = self._rules(_bound)

    def _rollout(self) -> Rollout:
        buffer = self.agent.rollout_buffer
        if buffer.generator_ready:
            # The library has flattened the buffer for its own minibatches.
            buffer.reset()
        return Rollout(*(getattr(buffer, name) for name in Rollout._fields))

    def in_loop(self) -> PolicyAgent:
        """The agent for the compiled loop."""
        functions = (choose_randomly, evaluate, estimate_advantages, train)
        addresses = (address_of(function, self.learner) for function in functions)
        return PolicyAgent(self.learner, self.memory, self.seen, *addresses)

    def read(self) -> None:
        """Copy the agent's counters into the compiled record."""
        agent, place = self.agent, self.place
        place["step"] = agent.collected
        place["remaining"] = agent._current_progress_remaining
        place["n_updates"] = agent._n_updates
        self.held.starts[:] = agent._last_episode_starts

    def write(self) -> None:
        """Copy the compiled record's counters to the agent."""
        agent, place = self.agent, self.place[0]
        agent._n_updates = int(place["n_updates"])
        agent.collected = int(place["step"])
        agent._last_episode_starts = self.held.starts.astype(bool)
        buffer = agent.rollout_buffer
        buffer.full = bool(place["n_rollouts"]) and place["step"] == 0
        buffer.pos = len(buffer.rewards) if buffer.full else int(place["step"])

    def until_end(self, left: int) -> int:
        """The steps to the end of the rollout with the last of ``left`` steps."""
        begun, whole = int(self.place["step"][0]), int(self.agent.n_steps)
        return -(-(begun + left) // whole) * whole - begun

    def until_log(self, log_interval: int | None) -> Horizon:
        """The steps until the next log record."""
        if log_interval is None:
            return Horizon()
        in_rollout = self.agent.n_steps - int(self.place["step"][0])
        return Horizon(
            in_rollout + -(int(self.place["n_rollouts"][0]) + 1) % log_interval * self.agent.n_steps
        )

    def train(self) -> None:
        """Learn from the rollout, with environments in Python."""
        agent = self.agent
        self.read_tensors()
        self.place["n_updates"] = agent._n_updates
        self.held.rules[:] = self._rules(self._bound_now)
        remaining = agent._current_progress_remaining
        train(self.learner, remaining, float(agent.lr_schedule(remaining)))
        self.write()
        self.record()

    def record(self) -> None:
        """Record the last training in the agent's logger; ValueError if losses are nan."""
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

    def collect_rollout(self, env: VecEnv, callback: BaseCallback) -> bool:
        """Fill the rollout buffer, after `on_rollout_start`; False once a callback asks to stop."""
        agent, held, buffer = self.agent, self.held, self.agent.rollout_buffer
        agent.collected = 0
        self.read()
        buffer.pos, buffer.full = 0, False
        for step in range(agent.n_steps):
            actions = self._act(step)
            new_obs, rewards, dones, infos = env.step(actions.copy())
            agent.num_timesteps += env.num_envs
            told = {"new_obs": new_obs, "rewards": rewards, "dones": dones, "infos": infos}
            callback.update_locals({**self._said(env, step), "actions": actions, **told})
            if not callback.on_step():
                return False
            agent._update_info_buffer(infos, dones)
            held.rollout.rewards[step] = rewards + self._cut_off(dones, infos)
            agent._last_obs, agent._last_episode_starts, held.starts[:] = new_obs, dones, dones
            buffer.pos = step + 1
        buffer.full = True
        self.trained.take_over()
        self.show(agent._last_obs)
        evaluate_rows(self.learner, self.shown, held.last_values)
        estimate_advantages(self.learner, 0.0, 0.0)
        callback.on_rollout_end()
        return True

    def _act(self, step: int) -> Any:
        """Actions for the present observations, stored in the rollout with their values."""
        actions = np.zeros(self.agent.n_envs, np.int64)
        self.place["step"] = step
        self.read_tensors()
        self.show(self.agent._last_obs)
        act_on_rows(self.learner, self.shown, actions)
        self.memory.held.observations[step] = self.shown
        return actions

    def _said(self, env: VecEnv, step: int) -> dict[str, Any]:
        """The local variables of the library's rollout loop that callbacks read."""
        rollout = self.held.rollout
        return {
            "self": self.agent,
            "env": env,
            "rollout_buffer": self.agent.rollout_buffer,
            "n_rollout_steps": self.agent.n_steps,
            "n_steps": step,
            "values": th.tensor(rollout.values[step, :, np.newaxis]),
            "log_probs": th.tensor(rollout.log_probs[step]),
        }

    def _cut_off(self, dones: Bools, infos: list[dict[str, Any]]) -> Singles:
        """Discounted values of the last states of truncated episodes, else 0, shape (E,)."""
        lost = np.zeros(len(dones), np.float32)
        values = np.zeros(1, np.float32)
        shown = self.shown[:1]
        for i in np.flatnonzero(dones):
            if infos[i].get("TimeLimit.truncated", False):
                shown[:] = np.reshape(infos[i]["terminal_observation"], (1, -1))
                self.check_numbers(shown)
                self.trained.take_over()  # a callback has been called since the agent acted
                evaluate_rows(self.learner, shown, values)
                lost[i] = np.float32(self.agent.gamma) * values[0]
        return lost


def _bound(schedule: Schedule | None) -> ScheduleRow:
    """The schedule of a clip range for compiled code."""
    return compiled_schedule(FloatSchedule(UNBOUNDED) if schedule is None else schedule)


class CompiledPolicyGradient(CompiledNetworks, OnPolicyAlgorithm):
    """The base of PPO and A2C; see `CompiledNetworks` for the argument ``engine``."""

    training_kind = PolicyTraining
    _own = (*CompiledNetworks._own, "collected")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.collected = 0  # steps so far of the current rollout in the compiled loop
        super().__init__(*args, **kwargs)

    def _check_own(self) -> None:
        if type(self.rollout_buffer) is not RolloutBuffer:
            raise NotCompilable("its rollout buffer is of another kind")

    def _parts(self) -> list[list[Any]]:
        """The bodies and heads of the networks of action probabilities and of values."""
        policy: Any = self.policy
        extractor = policy.mlp_extractor
        return [[extractor.policy_net, policy.action_net], [extractor.value_net, policy.value_net]]

    def shared_networks(self, seen: Any) -> tuple[list[Network], list[Network]]:
        one_hot = isinstance(seen, Numbers)
        (body, head), (value_body, value_head) = self._parts()
        actor = network_of([*body, head], 0, one_hot=one_hot)
        start = n_parameters(actor.layers)
        critic = network_of([*value_body, value_head], start, one_hot=one_hot)
        return [actor, critic], []

    def _planned(self, n_steps: float) -> tuple[list[nn.Module], float, float, int]:
        rollout = self.n_steps * self.n_envs
        batch_size = getattr(self, "batch_size", rollout)
        n_rollouts = math.ceil(n_steps / rollout)
        n_updates = n_rollouts * getattr(self, "n_epochs", 1) * math.ceil(rollout / batch_size)
        networks: list[nn.Module] = [nn.ModuleList(parts) for parts in self._parts()]
        return networks, n_rollouts * rollout, n_updates, batch_size

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
        return bool(self._shared_training().collect_rollout(env, callback))

    def train(self) -> None:
        """Learn from the rollout buffer."""
        if self._sharing:
            self._shared_training().train()
        else:
            super().train()
