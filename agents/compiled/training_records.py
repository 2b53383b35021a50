"""What the compiled loop works on, as records in arrays.

Handing on a record costs compiled code nothing, where as many arrays would cost more than the
learning itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SCHEDULE = np.dtype(
    [(name, np.float64) for name in ("kind", "start", "end", "end_fraction")], align=True
)

# One environment and the step that it took last.
_ENV_FIELDS = [
    ("elapsed", np.int64),  # steps of the episode
    ("episode_return", np.float64),  # sum of the rewards that Monitor sees
    ("compensation", np.float64),  # what rounding has taken from it
    ("obs", np.int64),
    ("action", np.int64),
    ("probability", np.float64),  # of the action, where the agent tells
    ("reward", np.float64),
    ("monitor_reward", np.float64),
    ("terminated", np.bool_),
    ("done", np.bool_),
    ("success", np.bool_),
    ("next_obs", np.int64),  # before any reset
    ("new_obs", np.int64),  # after it
    ("next_action", np.int64),  # committed to, or UNDECIDED
    ("uniform", np.float64),  # in [0, 1), for updates that are partly random
    ("target", np.float64),  # of the last update, where the agent tells; else nan
    ("td_error", np.float64),  # likewise
]

UNDECIDED = -1


def env_dtype(*state: tuple[str, type]) -> np.dtype[np.void]:
    """The record of an environment whose own state has these fields."""
    # First: behind the others they would make the record a subtype of `ENV` in Numba's eyes.
    return np.dtype([*state, *_ENV_FIELDS], align=True)


def env_records(n: int, kind: np.dtype[np.void]) -> NDArray[np.void]:
    """Records of n environments that nothing was learnt in yet, of a type from `env_dtype`."""
    records = np.zeros(n, dtype=kind)
    records["target"] = records["td_error"] = np.nan
    return records


# An environment that is stepped outside of compiled code keeps its state to itself.
ENV = env_dtype()

# How far the training is; there is one record of it.
PROGRESS = np.dtype(
    [
        ("num_timesteps", np.int64),
        ("total_timesteps", np.float64),
        ("remaining", np.float64),
        ("exploration", np.float64),  # what its schedule says now
        ("exploration_schedule", SCHEDULE),
        ("learning_rate", np.float64),
        ("learning_rate_schedule", SCHEDULE),
        ("episodes", np.int64),
        ("episode_budget", np.int64),  # episodes to train for; 0 where steps are counted
        ("budget_episodes", np.int64),  # episodes that have counted towards it
        ("logged_episodes", np.int64),  # those in the log
        ("mean_td_error", np.float64),
        ("record_interval", np.int64),  # episodes between two records of the log; 0 for none
        ("next_record", np.int64),  # the number of episodes at which the next one is due
        ("n_records", np.int64),  # of the block
    ],
    align=True,
)

# What a record of the log is made from: a moment of a block, after what was learnt there.
RECORD = np.dtype(
    [
        ("step", np.int64),  # of the block
        ("logged_episodes", np.int64),  # of the block so far
        ("episodes", np.int64),  # of the training
        ("exploration", np.float64),
        ("learning_rate", np.float64),
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
