"""What the compiled loop works on.

What belongs to one environment, or to one episode, is a record in an array: passing records costs
compiled code nothing, where passing as many arrays would cost more than the learning itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from agents.common.schedules import ScheduleRow

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
