"""Steps and resets of one environment, on its record."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.tabular.simulator import CartPole, bin_index, cart_pole_step, pick_outcome, pick_start
from mdp.machine_code import inlined

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


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
