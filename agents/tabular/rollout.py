"""The compiled training loop: many steps of acting and learning in one call.

It does what the interpreted loop of `OnlineAlgorithm` does, in the same order, with the same
functions and the same random numbers, so that both end in the same bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.common.exploration import GAUSSIAN_NOISE
from agents.common.schedules import ScheduleRow, schedule_value
from agents.tabular.records import Learner
from agents.tabular.rules import SARSA, behaviour_action, update
from agents.tabular.simulator import MODEL, World
from agents.tabular.stepping import (
    begin_episode,
    end_step,
    log_episode,
    reset_cart_pole,
    reset_model,
    step_cart_pole,
    step_model,
)
from agents.tabular.steps import UNDECIDED
from mdp.machine_code import inlined, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


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
