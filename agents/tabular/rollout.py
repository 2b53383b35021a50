"""The compiled training loop: many steps of acting and learning in one call.

It does what the interpreted loop of `OnlineAlgorithm` does, in the same order, with the same
functions and the same random numbers, so that both end in the same bits.

What belongs to one environment, or to one episode, is a record in an array: passing records costs
compiled code nothing, where passing as many arrays would cost more than the learning itself.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.exploration import GAUSSIAN_NOISE
from agents.schedules import ScheduleRow, schedule_value
from agents.tabular.rules import SARSA, behaviour_action, update
from agents.tabular.simulator import (
    MODEL,
    CartPole,
    World,
    bin_index,
    cart_pole_step,
    pick_outcome,
    pick_start,
)
from agents.tabular.steps import UNDECIDED
from mdp.compiled import inlined, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# One environment and the step that it took last.
ENV = np.dtype(
    [
        ("state", np.int64),  # of a finite model
        ("x", np.float64),  # of CartPole, and so the next three
        ("x_dot", np.float64),
        ("theta", np.float64),
        ("theta_dot", np.float64),
        ("elapsed", np.int64),  # steps of the episode
        ("episode_return", np.float64),  # sum of the rewards that Monitor sees
        ("compensation", np.float64),  # what rounding has taken from it
        ("uniforms_used", np.int64),
        ("obs", np.int64),
        ("action", np.int64),
        ("reward", np.float64),
        ("monitor_reward", np.float64),
        ("terminated", np.bool_),
        ("done", np.bool_),
        ("success", np.bool_),
        ("next_obs", np.int64),  # before any reset
        ("new_obs", np.int64),  # after it
        ("next_action", np.int64),  # committed to, or UNDECIDED
    ],
    align=True,
)

# How far the training is; there is one record of it.
PROGRESS = np.dtype(
    [
        ("num_timesteps", np.int64),
        ("total_timesteps", np.float64),
        ("remaining", np.float64),
        ("episodes", np.int64),
        ("budget_episodes", np.int64),  # of them, those that count towards a budget of episodes
        ("logged_episodes", np.int64),  # those in the log
        ("mean_td_error", np.float64),
    ],
    align=True,
)

# An episode that has ended.
EPISODE = np.dtype(
    [
        ("env", np.int64),
        ("step", np.int64),  # of the block
        ("episode_return", np.float64),
        ("length", np.int64),
        ("success", np.bool_),
    ],
    align=True,
)


class Learner(NamedTuple):
    """How the agent acts and learns.

    Attributes:
        rule: which update rule.
        strategy: exploration strategy.
        gamma: discount factor.
        tie_scale: 1 to break ties at random, 0 to take the first best action.
        sample_average: step size 1/N.
        skip_terminal_update: learn nothing from a transition that terminates.
        exploration: schedule of the exploration rate.
        learning_rate: schedule of the step size.
        episode_budget: episodes to train for, over which schedules run then; 0 for steps.
    """

    rule: int
    strategy: int
    gamma: float
    tie_scale: float
    sample_average: bool
    skip_terminal_update: bool
    exploration: ScheduleRow
    learning_rate: ScheduleRow
    episode_budget: int


@inlined
def exploration_rate(
    strategy: int, schedule: ScheduleRow, remaining: float, episodes: int
) -> float:
    """How much to explore now."""
    rate = schedule_value(schedule, remaining)
    if strategy == GAUSSIAN_NOISE:
        return rate / (episodes + 1)
    return rate


@inlined
def draw(strategy: int, rng: np.random.Generator, draws: Floats) -> None:
    """Fill in the random numbers of one choice."""
    for k in range(len(draws)):
        if strategy == GAUSSIAN_NOISE:
            draws[k] = rng.standard_normal()
        else:
            draws[k] = rng.random()


@inlined
def add_to_return(env: Any, reward: float, compensated: bool) -> None:
    """Add as Python's `sum` does: since 3.12 it keeps track of what rounding takes."""
    total = env.episode_return
    new_total = total + reward
    if compensated:
        if abs(total) >= abs(reward):
            env.compensation += (total - new_total) + reward
        else:
            env.compensation += (reward - new_total) + total
    env.episode_return = new_total


@inlined
def begin_episode(env: Any) -> None:
    """Start counting anew."""
    env.elapsed = 0
    env.episode_return = 0.0
    env.compensation = 0.0


@inlined
def reset_model(
    env: Any, starts: Ints, start_cumulative: Floats, observation: Ints, uniforms: Floats, i: int
) -> None:
    """Reset a finite model, with the next number of row ``i`` of ``uniforms``."""
    env.state = pick_start(starts, start_cumulative, uniforms[i, env.uniforms_used])
    env.uniforms_used += 1
    env.new_obs = observation[env.state]


@inlined
def reset_cart_pole(env: Any, dims: Ints, bins: Floats, uniforms: Floats, i: int) -> None:
    """Reset CartPole, with the next four numbers, as Generator.uniform(-0.05, 0.05) does."""
    used = env.uniforms_used
    width = 0.05 - -0.05
    env.x = -0.05 + width * uniforms[i, used]
    env.x_dot = -0.05 + width * uniforms[i, used + 1]
    env.theta = -0.05 + width * uniforms[i, used + 2]
    env.theta_dot = -0.05 + width * uniforms[i, used + 3]
    env.uniforms_used = used + 4
    env.new_obs = bin_index(env, dims, bins)


@inlined
def step_model(env: Any, outcomes: Any, observation: Ints, uniforms: Floats, i: int) -> None:
    """One step of a finite model."""
    outcome = pick_outcome(outcomes, env.state, env.action, uniforms[i, env.uniforms_used])
    env.uniforms_used += 1
    result = outcomes[env.state, env.action, outcome]
    env.state = result.next_state
    env.reward = result.agent_reward
    env.monitor_reward = result.reward
    env.terminated = result.terminated
    env.success = result.success
    env.next_obs = observation[env.state]


@inlined
def step_cart_pole(env: Any, constants: CartPole, dims: Ints, bins: Floats) -> None:
    """One step of CartPole."""
    env.terminated = cart_pole_step(env, constants)
    env.reward = 1.0
    env.monitor_reward = 1.0
    env.success = False
    env.next_obs = bin_index(env, dims, bins)


@inlined
def end_step(env: Any, time_limit: int, compensated: bool) -> None:
    """Sum up the rewards, and see whether the episode is over."""
    add_to_return(env, env.monitor_reward, compensated)
    env.elapsed += 1
    # A step that terminates and runs out of time counts as terminated, as DummyVecEnv has it.
    env.done = env.terminated or (time_limit > 0 and env.elapsed >= time_limit)
    env.new_obs = env.next_obs


@inlined
def log_episode(env: Any, progress: Any, log: Any, i: int, step: int) -> None:
    """Append the episode that has just ended in environment ``i``."""
    entry = log[progress.logged_episodes]
    entry.env = i
    entry.step = step
    entry.episode_return = env.episode_return + env.compensation
    entry.length = env.elapsed
    entry.success = env.success
    progress.logged_episodes += 1


@inlined
def act(
    learner: Learner,
    env: Any,
    tables: Floats,
    rate: float,
    rng: np.random.Generator,
    draws: Floats,
    scratch: Floats,
) -> None:
    """Do what was committed to, or choose."""
    env.action = env.next_action
    env.next_action = UNDECIDED
    if env.action == UNDECIDED:
        draw(learner.strategy, rng, draws)
        env.action = behaviour_action(
            tables, env.obs, learner.strategy, rate, learner.tie_scale, draws, scratch
        )


@inlined
def commit_to_next_action(
    learner: Learner,
    env: Any,
    tables: Floats,
    rate: float,
    rng: np.random.Generator,
    draws: Floats,
    scratch: Floats,
) -> None:
    """SARSA's choice of what it does next; none where nothing follows."""
    env.next_action = 0
    if not env.terminated:
        draw(learner.strategy, rng, draws)
        env.next_action = behaviour_action(
            tables, env.next_obs, learner.strategy, rate, learner.tie_scale, draws, scratch
        )


@inlined
def note_progress(learner: Learner, progress: Any, n_done: int) -> None:
    """Count the episodes of a budget, and how much of the training remains."""
    if learner.episode_budget > 0:
        progress.budget_episodes += n_done
        share_done = max(float(progress.budget_episodes), 1e-9) / learner.episode_budget
        progress.total_timesteps = progress.num_timesteps / share_done
    progress.remaining = 1.0 - float(progress.num_timesteps) / progress.total_timesteps


@inlined
def learn(
    learner: Learner,
    envs: Any,
    progress: Any,
    tables: Floats,
    visit_counts: Ints,
    rng: np.random.Generator,
    draws: Floats,
    update_draws: Floats,
    scratch: Floats,
) -> None:
    """What the agent does after a step of all environments.

    Args:
        learner: the agent.
        envs: records of type `ENV`, shape (n,).
        progress: a record of type `PROGRESS`.
        tables: action values, shape (T, S, A).
        visit_counts: updates of each entry, shape (T, S, A).
        rng: the agent's generator.
        draws: room for the random numbers of a choice.
        update_draws: room for those of the updates, shape (n,); zeros.
        scratch: room for A values.
    """
    n_done = 0
    for i in range(len(envs)):
        n_done += envs[i].done
    note_progress(learner, progress, n_done)
    rate = exploration_rate(
        learner.strategy, learner.exploration, progress.remaining, progress.episodes
    )
    learning_rate = schedule_value(learner.learning_rate, progress.remaining)
    # All choices, then all random numbers of the updates, then the updates in order.
    for i in range(len(envs)):
        if learner.rule == SARSA:
            commit_to_next_action(learner, envs[i], tables, rate, rng, draws, scratch)
    if tables.shape[0] > 1:
        for i in range(len(envs)):
            update_draws[i] = rng.random()
    total_error = 0.0
    for i in range(len(envs)):
        env = envs[i]
        if not (env.terminated and learner.skip_terminal_update):
            td_error = update(
                learner.rule,
                tables,
                visit_counts,
                env.obs,
                env.action,
                env.reward,
                0.0 if env.terminated else learner.gamma,
                env.next_obs,
                env.next_action,
                learning_rate,
                learner.sample_average,
                learner.strategy,
                rate,
                learner.tie_scale,
                update_draws[i],
                scratch,
            )
            total_error += abs(td_error)
        env.obs = env.new_obs
        if env.done:
            env.next_action = UNDECIDED
    progress.mean_td_error = total_error / len(envs)
    progress.episodes += n_done


@kernel
def learn_from_step(
    learner: Learner,
    envs: Any,
    progress: Any,
    tables: Floats,
    visit_counts: Ints,
    rng: np.random.Generator,
    draws: Floats,
    update_draws: Floats,
    scratch: Floats,
) -> None:
    """`learn`, to be called from outside."""
    learn(learner, envs, progress, tables, visit_counts, rng, draws, update_draws, scratch)


@kernel
def run_block(
    world: World,
    learner: Learner,
    envs: Any,
    progress: Any,
    tables: Floats,
    visit_counts: Ints,
    rng: np.random.Generator,
    uniforms: Floats,
    draws: Floats,
    update_draws: Floats,
    scratch: Floats,
    log: Any,
    rewards: Floats,
    n_steps: int,
    max_episodes: int,
    compensated: bool,
) -> int:
    """Act for ``n_steps``, learning after each of them but the last.

    The last step is left to be learnt from by `learn_from_step`, since callbacks come before that.

    Args:
        world: the dynamics.
        learner: as in `learn`, and so the next two.
        envs: environments.
        progress: how far the training is.
        tables: as in `learn`, and so the next two.
        visit_counts: updates of each entry.
        rng: the agent's generator.
        uniforms: random numbers of the environments, shape (n, capacity).
        draws: as in `learn`, and so the next two.
        update_draws: room for random numbers.
        scratch: room for A values.
        log: records of type `EPISODE`, filled with the episodes that end.
        rewards: filled with what Monitor sees, shape (capacity, n).
        n_steps: steps of every environment.
        max_episodes: stop after the step on which so many episodes have ended.
        compensated: how Python's `sum` adds.

    Returns:
        The number of steps taken.
    """
    is_model = world.kind == MODEL
    outcomes, observation = world.outcomes, world.observation
    starts, start_cumulative = world.starts, world.start_cumulative
    dims, bins = world.dims, world.bins
    progress.logged_episodes = 0
    for step in range(n_steps):
        rate = exploration_rate(
            learner.strategy, learner.exploration, progress.remaining, progress.episodes
        )
        for i in range(len(envs)):
            act(learner, envs[i], tables, rate, rng, draws, scratch)
        for i in range(len(envs)):
            env = envs[i]
            if is_model:
                step_model(env, outcomes, observation, uniforms, i)
            else:
                step_cart_pole(env, world.cart_pole, dims, bins)
            end_step(env, world.time_limit, compensated)
            rewards[step, i] = env.monitor_reward
            if env.done:
                log_episode(env, progress, log, i, step)
                begin_episode(env)
                if is_model:
                    reset_model(env, starts, start_cumulative, observation, uniforms, i)
                else:
                    reset_cart_pole(env, dims, bins, uniforms, i)
        progress.num_timesteps += len(envs)
        if step == n_steps - 1 or progress.logged_episodes >= max_episodes:
            return step + 1
        learn(learner, envs, progress, tables, visit_counts, rng, draws, update_draws, scratch)
    return n_steps
