"""Policy optimisation as the compiled loop runs it, in the order of events of Stable-Baselines3."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.common.schedules import schedule_value
from agents.compiled.generators import next_uniform
from agents.compiled.training_records import SCHEDULE
from agents.networks.categorical import draw, log_probability
from agents.networks.matrix_products import Singles
from agents.networks.observations import AFTER, BEFORE, look, move_on, observe, show
from agents.networks.optimizers import Optimizer
from agents.networks.perceptron import Inputs, Layers, forward, last_outputs
from agents.networks.policy_updates import RolloutMinibatch
from agents.networks.references import call
from agents.networks.rollouts import Rollout, explained_variance, shuffle
from machine_code.compiling import inlined, kernel
from mdp.array_types import Ints

# Settings, under the library's names where it has one.
RULES = np.dtype(
    [
        ("gamma", np.float64),  # for what episodes lose that are cut off
        ("buffer_gamma", np.float64),  # for advantages, which the library works out in its buffer
        ("gae_lambda", np.float64),
        ("ent_coef", np.float64),
        ("vf_coef", np.float64),
        ("max_grad_norm", np.float64),
        ("target_kl", np.float64),  # infinite for none
        ("normalize_advantage", np.bool_),
        ("n_epochs", np.int64),
        ("waits", np.bool_),  # for callbacks, before it learns from a rollout
        ("clip_range", SCHEDULE),
        ("clip_range_vf", SCHEDULE),
    ],
    align=True,
)

# How far the training is.
PLACE = np.dtype(
    [
        ("step", np.int64),  # of the rollout
        ("n_rollouts", np.int64),
        ("n_updates", np.int64),  # epochs, as the library counts them
        ("remaining", np.float64),  # share of the training that was left at the last one
        ("clip_range", np.float64),  # how far ratios of probabilities may move
        ("clip_range_vf", np.float64),  # how far values may
        ("policy_gradient", np.float64),  # means over the last training
        ("value", np.float64),
        ("entropy", np.float64),
        ("clipped", np.float64),
        ("kl", np.float64),  # over its last epoch
        ("explained", np.float64),  # share of the returns' variance, by the values before it
        ("expected", np.float64),  # value of the observation that was looked at last
        ("log_probability", np.float64),  # of the action that was drawn last
    ],
    align=True,
)


class PolicyLearner(NamedTuple):
    """Networks of action probabilities and of values as compiled functions see them, by reference.

    Attributes:
        rules: a record of type `RULES`, alone in an array.
        place: one of type `PLACE`, likewise.
        losses: one of type `LOSSES`, likewise.
        policy: the shape of the one network.
        value: the shape of the other.
        flat: the parameters of both.
        gradient: for work, as long.
        optimizer: what moves the parameters.
        rollout: what has been done, and come of it.
        pick: the address of `pick_steps`, which goes by the type of observations.
        memory: that of what it takes steps from.
        starts: whether the present observations begin episodes, shape (E,).
        last_values: values of what the rollout ends with, shape (E,).
        improve: the address of `learn_from_rollout_minibatch`.
        order: numbers of the rollout's steps, to be shuffled, shape (T * E,).
        batch: the minibatch.
        policy_outputs: for what the network puts out for the minibatch.
        policy_errors: for derivatives.
        value_outputs: as for the policy.
        value_errors: as for the policy.
        single: one observation, to act on.
        rng: a handle of the agent's generator, alone in an array.
    """

    rules: NDArray[np.void]
    place: NDArray[np.void]
    losses: NDArray[np.void]
    policy: Layers
    value: Layers
    flat: Singles
    gradient: Singles
    optimizer: Optimizer
    rollout: Rollout
    pick: np.uintp
    memory: np.uintp
    starts: Singles
    last_values: Singles
    improve: np.uintp
    order: Ints
    batch: RolloutMinibatch
    policy_outputs: Singles
    policy_errors: Singles
    value_outputs: Singles
    value_errors: Singles
    single: Inputs
    rng: NDArray[np.void]


@kernel
def evaluate(learner: Any, _: float, __: float) -> int:
    """Put the value of the observation in ``learner.single`` into ``place.expected``."""
    forward(learner.value, learner.flat, learner.single, 1, learner.value_outputs)
    values = last_outputs(learner.value, learner.value_outputs, 1)
    learner.place[0].expected = float(values[0, 0])
    return 0


@kernel
def choose_randomly(learner: Any, _: float, __: float) -> int:
    """An action for the observation in ``learner.single``, whose value and chance are noted."""
    evaluate(learner, 0.0, 0.0)
    forward(learner.policy, learner.flat, learner.single, 1, learner.policy_outputs)
    logits = last_outputs(learner.policy, learner.policy_outputs, 1)[0]
    action = draw(logits, next_uniform(learner.rng[0]))
    learner.place[0].log_probability = log_probability(logits, action)
    return action


@kernel
def train(learner: Any, remaining: float, learning_rate: float) -> int:
    """Learn from the whole rollout as often as there are epochs.

    Args:
        learner: with the advantages of the rollout.
        remaining: share of the training that is left.
        learning_rate: of the optimizer.

    Returns:
        The number of minibatches.
    """
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
    """Learn from all of the rollout once.

    Returns:
        The number of minibatches, and False where the policy has moved too far.
    """
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
    """What the compiled loop asks.

    Attributes:
        learner: a reference to a `PolicyLearner`.
        memory: one to the `RolloutMemory` that it learns from.
        seen: how observations are read, of `agents.networks.observations`.
        choose: the address of `choose_randomly`.
        evaluate: that of `evaluate`.
        estimate: that of `estimate_advantages`.
        train: that of `train`.
    """

    learner: Any
    memory: Any
    seen: Any
    choose: np.uintp
    evaluate: np.uintp
    estimate: np.uintp
    train: np.uintp

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Draw an action, and note how likely it was and what is expected."""
        look(self.seen, env, BEFORE, self.learner.single, self.learner.policy.one_hot)
        env.action = call(self.choose, self.learner, 0.0, 0.0)
        env.value = self.learner.place[0].expected
        env.log_probability = self.learner.place[0].log_probability

    @inlined
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Write the step down, and train at the end of the rollout."""
        learner = self.learner
        for i in range(len(envs)):
            note_step(self, envs[i], i)
            move_on(self.seen, envs[i])
        learner.place[0].step += 1
        if learner.place[0].step == len(learner.rollout.rewards):
            for i in range(len(envs)):
                learner.last_values[i] = np.float32(value_at(self, envs[i], BEFORE))
            call(self.estimate, learner, 0.0, 0.0)
            if not learner.rules[0].waits:
                call(self.train, learner, progress.remaining, progress.learning_rate)


@inlined
def value_at(agent: PolicyAgent, env: Any, moment: int) -> float:
    """The value of what an environment showed at that moment."""
    learner = agent.learner
    look(agent.seen, env, moment, learner.single, learner.policy.one_hot)
    call(agent.evaluate, learner, 0.0, 0.0)
    return float(learner.place[0].expected)


@inlined
def note_step(agent: PolicyAgent, env: Any, i: int) -> None:
    """Write down the step of environment ``i``."""
    learner = agent.learner
    rollout, step = learner.rollout, learner.place[0].step
    observe(agent.seen, env, BEFORE, agent.memory.observations[step, i])
    rollout.actions[step, i, 0] = np.float32(env.action)
    rollout.values[step, i] = np.float32(env.value)
    rollout.log_probs[step, i] = np.float32(env.log_probability)
    rollout.episode_starts[step, i] = learner.starts[i]
    reward = np.float32(env.reward)
    if env.done and not env.terminated:
        # The episode was cut off: what would have come is a part of the reward.
        gamma = np.float32(learner.rules[0].gamma)
        reward += gamma * np.float32(value_at(agent, env, AFTER))
    rollout.rewards[step, i] = reward
    learner.starts[i] = np.float32(env.done)


@kernel
def act_on_rows(learner: Any, shown: Any, actions: Ints) -> None:
    """Choose actions, shape (E,), for observations of shape (E, d), and note their likelihood."""
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
    """Work out the values, shape (n,), of observations of shape (n, d)."""
    for i in range(len(values)):
        show(learner.single, 0, shown[i], learner.policy.one_hot)
        evaluate(learner, 0.0, 0.0)
        values[i] = np.float32(learner.place[0].expected)
