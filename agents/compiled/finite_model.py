"""Environments with a known transition model as compiled code.

A `FiniteModel` does what the environment's own `step` and `reset` do, bit for bit, from the same
generator: each takes one uniform number.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.compiled.generators import next_uniform, skip_uniform
from agents.compiled.training_records import env_dtype
from machine_code.compiling import inlined
from mdp.array_types import Floats, Ints

FINITE_ENV = env_dtype(("state", np.int64))

# One outcome of an action: S states, A actions and K outcomes make an array of shape (S, A, K).
OUTCOME = np.dtype(
    [
        ("cumulative", np.float64),  # probability of this outcome or one before it
        ("reward", np.float64),  # as Monitor sees it
        ("agent_reward", np.float32),  # as the agent is given it, rounded to single precision
        ("next_state", np.int32),
        ("terminated", np.bool_),
        ("success", np.bool_),
    ],
    align=True,
)


@inlined
def pick_outcome(outcomes: Any, state: int, action: int, uniform: float) -> int:
    """The first outcome whose cumulative probability exceeds ``uniform``, else 0, as toy_text."""
    for outcome in range(outcomes.shape[2]):
        if outcomes[state, action, outcome].cumulative > uniform:
            return outcome
    return 0


@inlined
def pick_start(starts: Ints, start_cumulative: Floats, uniform: float) -> int:
    """The state that an episode begins in."""
    # Halving what is left; NumPy's search takes longer to compile than the rest of an environment.
    below, above = 0, len(start_cumulative)
    while below < above:
        middle = (below + above) // 2
        if start_cumulative[middle] > uniform:
            above = middle
        else:
            below = middle + 1
    return int(starts[below]) if below < len(starts) else 0


class FiniteModel(NamedTuple):
    """Dynamics, shared by all environments of a training.

    Attributes:
        time_limit: steps after which an episode is truncated, or 0 for never.
        outcomes: records of type `OUTCOME`, shape (S, A, K).
        starts: states where an episode may begin, shape (m,).
        start_cumulative: their cumulative probabilities, shape (m,).
        observation: what is observed in each state, shape (S,).
    """

    time_limit: int
    outcomes: NDArray[np.void]
    starts: Ints
    start_cumulative: Floats
    observation: Ints

    @inlined
    def step(self, env: Any, handle: Any) -> None:
        """Do ``env.action`` in ``env.state``."""
        outcome = 0
        if self.outcomes.shape[2] > 1:
            uniform = next_uniform(handle)
            outcome = pick_outcome(self.outcomes, env.state, env.action, uniform)
        else:
            skip_uniform(handle)
        result = self.outcomes[env.state, env.action, outcome]
        env.state = result.next_state
        env.reward = result.agent_reward
        env.monitor_reward = result.reward
        env.terminated = result.terminated
        env.success = result.success
        env.next_obs = self.observation[env.state]

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw a state to begin in."""
        env.state = pick_start(self.starts, self.start_cumulative, next_uniform(handle))
        env.new_obs = self.observation[env.state]
