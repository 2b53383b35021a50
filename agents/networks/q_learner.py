"""Deep Q-learning as the compiled loop runs it: minibatches, updates, order of events."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.compiled.generators import next_uniform
from agents.networks.observations import AFTER, BEFORE, look, move_on, observe, show
from agents.networks.perceptron import (
    Inputs,
    Layers,
    Optimizer,
    Singles,
    backward,
    descend,
    forward,
    last_outputs,
)
from agents.networks.torch_bridge import call
from machine_code.compiling import called, inlined, kernel
from mdp.array_types import Floats, Ints

# Minibatches out of the library's replay buffer, in whose own arrays transitions lie.
#
# With n-step returns as in `stable_baselines3.common.buffers.NStepReplayBuffer`: rewards are summed
# until the episode ends, or the newest transition is reached. What VecNormalize shows otherwise
# lies
# there as it was, and is shown by the statistics of the moment, as in the library.


class Replay(NamedTuple):
    """Transitions of E environments in rings of N places."""

    observations: Any  # shape (N, E, d); numbers of states have d = 1
    next_observations: Any  # what followed, before any reset, likewise
    actions: Ints  # shape (N, E, 1)
    rewards: Singles  # shape (N, E)
    dones: Singles  # 1 where the episode ended, shape (N, E)
    timeouts: Singles  # 1 where it ended by its time limit alone, shape (N, E)


class Minibatch(NamedTuple):
    """Transitions that are learnt from at once."""

    states: Inputs  # observations, of B rows
    next_states: Inputs  # what followed
    actions: Ints  # shape (B,)
    rewards: Singles  # discounted sums of the rewards in between, shape (B,)
    discounts: Singles  # factor of the value of what followed, 0 where nothing does, shape (B,)


class Memory(NamedTuple):
    """What minibatches are drawn from, by reference."""

    replay: Replay  # the transitions
    batch: Minibatch  # what is filled
    place: NDArray[np.void]  # says where the next transition will lie, and whether the ring is full
    # with the discount factor, the number of steps and what VecNormalize does
    rules: NDArray[np.void]
    centre: Floats  # what it takes from observations, shape (d,)
    spread: Floats  # what it divides them by, shape (d,)
    rng: NDArray[np.void]  # a handle of the agent's generator, alone in an array
    one_hot: int  # whether observations are numbers of states


@inlined
def clipped(number: float, bound: float) -> float:
    """As it is within the bound; what is not a number stays that."""
    if number > bound:
        return bound
    return -bound if number < -bound else number


@inlined
def show_normalised(memory: Memory, inputs: Inputs, i: int, row: Any) -> None:
    """As `show`, the way VecNormalize shows it now."""
    rules = memory.rules[0]
    if not rules.normalises_observations:
        show(inputs, i, row, memory.one_hot)
        return
    for j in range(len(row)):
        moved = (row[j] - memory.centre[j]) / memory.spread[j]
        inputs.vectors[i, j] = np.float32(clipped(moved, rules.clip_obs))


@inlined
def reward_of(memory: Memory, at: int, env: int) -> Any:
    """A reward, the way VecNormalize gives it now."""
    reward, rules = memory.replay.rewards[at, env], memory.rules[0]
    if not rules.normalises_rewards:
        return reward
    return np.float32(clipped(reward / rules.reward_spread, rules.clip_reward))


@kernel
def draw_minibatch(memory: Any, _: float, __: float) -> int:
    """Fill the minibatch with transitions drawn with replacement; their number is returned."""
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

# What the value of the next state is taken from.
TARGET_NETWORK, DOUBLE, ONLINE_NETWORK = range(3)


@inlined
def best_of(values: Any) -> int:
    """The first of the largest."""
    best = 0
    for k in range(1, len(values)):
        if values[k] > values[best]:
            best = k
    return best


@kernel
def learn_from_minibatch(learner: Any, learning_rate: float, _: float) -> int:
    """Take one step of gradient descent on `learner.batch`.

    The loss before it is added to ``place.losses``: Huber's, or half the squared error.
    """
    layers, batch, rules = learner.layers, learner.batch, learner.rules[0]
    n = len(batch.actions)
    lagging = learner.flat if rules.target_kind == ONLINE_NETWORK else learner.target
    forward(layers, lagging, batch.next_states, n, learner.next_outputs)
    next_values = last_outputs(layers, learner.next_outputs, n)
    preferred = next_values
    if rules.target_kind == DOUBLE:
        # Overwritten below, once the choice has been made.
        forward(layers, learner.flat, batch.next_states, n, learner.outputs)
        preferred = last_outputs(layers, learner.outputs, n)
    for i in range(n):
        batch.rewards[i] += batch.discounts[i] * next_values[i, best_of(preferred[i])]
    forward(layers, learner.flat, batch.states, n, learner.outputs)
    learner.place[0].losses += _errors(learner, n, rules.largest_error)
    backward(
        layers,
        learner.flat,
        batch.states,
        n,
        learner.outputs,
        learner.errors,
        learner.gradient,
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
        # Half the square up to the largest slope, and a straight line from there on.
        loss += slope * (error - slope / 2)
    return loss / n


@called
def follow(target: Singles, flat: Singles, tau: float) -> None:
    """Move the target network towards the one that learns, by the share ``tau``."""
    for i in range(len(flat)):
        target[i] = target[i] * np.float32(1 - tau) + np.float32(tau) * flat[i]


# Deep Q-learning as the compiled loop runs it, in the order of events of Stable-Baselines3.

# Settings, under the library's names where it has one.
RULES = np.dtype(
    [
        ("gamma", np.float64),
        ("tau", np.float64),
        ("max_grad_norm", np.float64),
        ("largest_error", np.float64),  # from which on the loss is a straight line
        ("target_kind", np.int64),
        ("n_steps", np.int64),
        ("handles_timeouts", np.bool_),  # as episodes that would have gone on
        ("learning_starts", np.int64),
        ("train_freq", np.int64),
        ("counts_episodes", np.bool_),  # rather than steps, for train_freq
        ("waits", np.bool_),  # for callbacks, before it learns from a rollout
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

# How far the training is.
PLACE = np.dtype(
    [
        ("position", np.int64),  # of the next transition in the ring
        ("full", np.bool_),
        ("n_calls", np.int64),
        ("collected", np.int64),  # steps of all environments since the last training
        ("collected_episodes", np.int64),
        ("n_updates", np.int64),
        ("exploration_rate", np.float64),
        ("decided_at", np.int64),  # the time step that `explores` is for
        ("explores", np.bool_),
        ("losses", np.float64),  # sum over the last training
        ("n_losses", np.int64),
        ("learning_rate", np.float64),  # of that training
        ("is_over", np.bool_),  # the rollout, which waits to be learnt from
        ("n_due", np.int64),  # the number of minibatches to learn from then
    ],
    align=True,
)


class QLearner(NamedTuple):
    """A network of action values as compiled functions see it, by reference."""

    rules: NDArray[np.void]  # a record of type `RULES`, alone in an array
    place: NDArray[np.void]  # one of type `PLACE`, likewise
    layers: Layers  # the shape of the network
    flat: Singles  # its parameters
    target: Singles  # those of its lagging copy
    gradient: Singles  # for work, as long
    optimizer: Optimizer  # what moves the parameters
    draw: np.uintp  # the address of `draw_minibatch`, which goes by the type of observations
    memory: np.uintp  # that of what it draws from
    improve: np.uintp  # the address of `learn_from_minibatch`
    batch: Minibatch  # the minibatch
    outputs: Singles  # for what the network puts out for the minibatch
    next_outputs: Singles  # for what is put out for its next states
    errors: Singles  # for derivatives
    single: Inputs  # one observation, to act on
    single_outputs: Singles  # for what is put out for it
    rng: NDArray[np.void]  # a handle of the agent's generator, alone in an array


@kernel
def choose_greedily(learner: Any, _: float, __: float) -> int:
    """The best action for the observation in ``learner.single``."""
    forward(learner.layers, learner.flat, learner.single, 1, learner.single_outputs)
    return best_of(last_outputs(learner.layers, learner.single_outputs, 1)[0])


@kernel
def train(learner: Any, n_updates: float, learning_rate: float) -> int:
    """Learn from ``n_updates`` minibatches, whose number is returned."""
    place = learner.place[0]
    place.losses, place.n_losses, place.learning_rate = 0.0, int(n_updates), learning_rate
    for _ in range(int(n_updates)):
        call(learner.draw, learner.memory, 0.0, 0.0)
        call(learner.improve, learner, learning_rate, 0.0)
    place.n_updates += int(n_updates)
    return int(n_updates)


class QAgent(NamedTuple):
    """What the compiled loop asks."""

    learner: Any  # a reference to a `QLearner`
    memory: Any  # one to the `Memory` that it learns from
    seen: Any  # how observations are read, of `agents.networks.observations`
    choose: np.uintp  # the address of `choose_greedily`
    train: np.uintp  # that of `train`

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Choose randomly or greedily; one coin decides for all environments."""
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
        """Store the transitions, and train where it is time to."""
        n_done = 0
        for i in range(len(envs)):
            store(self, envs[i], i)
            n_done += envs[i].done
            move_on(self.seen, envs[i])
        count_step(self, progress.exploration, n_done)
        n_updates = updates_due(self.learner, progress.num_timesteps, len(envs))
        if self.learner.rules[0].waits:
            self.learner.place[0].n_due = n_updates
        elif n_updates > 0:
            call(self.train, self.learner, float(n_updates), progress.learning_rate)


@inlined
def explores(learner: Any, num_timesteps: int) -> bool:
    """Whether the next actions are random; tosses a coin once the warm-up is over."""
    if num_timesteps < learner.rules[0].learning_starts:
        return True
    return bool(next_uniform(learner.rng[0]) < learner.place[0].exploration_rate)


@inlined
def random_action(learner: Any) -> int:
    """Any of the actions, each as likely as the others."""
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
    """Write down the step of environment ``i``."""
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
    """Count a step of every environment, and move the target network where it is time to."""
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
    """How many minibatches to learn from now: 0 unless enough has been collected."""
    place, rules = learner.place[0], learner.rules[0]
    collected = place.collected_episodes if rules.counts_episodes else place.collected
    place.is_over = collected >= rules.train_freq
    if not place.is_over:
        return 0
    n_steps = place.collected * n_envs
    place.collected = place.collected_episodes = 0
    if num_timesteps <= rules.learning_starts:
        return 0
    return int(n_steps if rules.gradient_steps < 0 else rules.gradient_steps)
