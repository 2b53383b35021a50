"""What every compiled environment does around its own step: sums, time limit, episodes."""

from __future__ import annotations

from typing import Any

from machine_code.compiling import inlined


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
def end_step(env: Any, time_limit: int, compensated: bool) -> None:
    """Sum up the rewards, and see whether the episode is over; a limit of 0 is none."""
    add_to_return(env, env.monitor_reward, compensated)
    env.elapsed += 1
    # A step that terminates and runs out of time counts as terminated, as DummyVecEnv has it.
    env.done = env.terminated or (time_limit > 0 and env.elapsed >= time_limit)
    env.new_obs = env.next_obs
