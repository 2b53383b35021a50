"""Deep Q-learning as the compiled loop runs it, in the order of events of Stable-Baselines3."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.compiled.generators import next_uniform
from agents.networks.matrix_products import Singles
from agents.networks.observations import AFTER, BEFORE, look, move_on, observe, show
from agents.networks.optimizers import Optimizer
from agents.networks.perceptron import Inputs, Layers, forward, last_outputs
from agents.networks.q_updates import best_of, follow
from agents.networks.references import call
from agents.networks.replay_batches import Minibatch
from machine_code.compiling import inlined, kernel
from mdp.array_types import Ints

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
    """A network of action values as compiled functions see it, by reference.

    Attributes:
        rules: a record of type `RULES`, alone in an array.
        place: one of type `PLACE`, likewise.
        layers: the shape of the network.
        flat: its parameters.
        target: those of its lagging copy.
        gradient: for work, as long.
        optimizer: what moves the parameters.
        draw: the address of `draw_minibatch`, which goes by the type of observations.
        memory: that of what it draws from.
        improve: the address of `learn_from_minibatch`.
        batch: the minibatch.
        outputs: for what the network puts out for the minibatch.
        next_outputs: for what is put out for its next states.
        errors: for derivatives.
        single: one observation, to act on.
        single_outputs: for what is put out for it.
        rng: a handle of the agent's generator, alone in an array.
    """

    rules: NDArray[np.void]
    place: NDArray[np.void]
    layers: Layers
    flat: Singles
    target: Singles
    gradient: Singles
    optimizer: Optimizer
    draw: np.uintp
    memory: np.uintp
    improve: np.uintp
    batch: Minibatch
    outputs: Singles
    next_outputs: Singles
    errors: Singles
    single: Inputs
    single_outputs: Singles
    rng: NDArray[np.void]


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
    """What the compiled loop asks.

    Attributes:
        learner: a reference to a `QLearner`.
        memory: one to the `Memory` that it learns from.
        seen: how observations are read, of `agents.networks.observations`.
        choose: the address of `choose_greedily`.
        train: that of `train`.
    """

    learner: Any
    memory: Any
    seen: Any
    choose: np.uintp
    train: np.uintp

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
