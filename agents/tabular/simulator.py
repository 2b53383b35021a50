"""Environments as compiled code: a finite model, or CartPole seen through bins.

A `World` replays what the environment's own `step` and `reset` do, bit for bit, from the same
uniform numbers: one for each step and reset of a finite model, four for each reset of CartPole.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mdp.machine_code import inlined

MODEL = 0
CART_POLE = 1

MAX_DRAWS_PER_STEP = 4

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


# One outcome of an action: S states, A actions and K outcomes make an array of shape (S, A, K).
OUTCOME = np.dtype(
    [
        ("cumulative", np.float64),  # probability of this outcome or one before it
        ("reward", np.float64),  # as Monitor sees it
        ("agent_reward", np.float64),  # as the agent is given it, rounded to single precision
        ("next_state", np.int64),
        ("terminated", np.bool_),
        ("success", np.bool_),
    ],
    align=True,
)


class CartPole(NamedTuple):
    """CartPole's constants, as Gymnasium names them; the angle limit is in radians."""

    gravity: float
    masspole: float
    total_mass: float
    length: float
    polemass_length: float
    force_mag: float
    tau: float
    semi_implicit: bool
    x_threshold: float
    theta_threshold: float


class World(NamedTuple):
    """Dynamics, shared by all environments of a training.

    Attributes:
        kind: `MODEL` or `CART_POLE`; an array that the kind does not use is empty.
        time_limit: steps after which an episode is truncated, or 0 for never.
        outcomes: records of type `OUTCOME`, shape (S, A, K).
        starts: states where an episode may begin, shape (m,).
        start_cumulative: their cumulative probabilities, shape (m,).
        observation: what is observed in each state, shape (S,).
        cart_pole: CartPole's constants.
        dims: the dimensions of its observation that count, shape (d,).
        bins: number of bins, lower end and upper end of each, shape (d, 3).
    """

    kind: int
    time_limit: int
    outcomes: NDArray[np.void]
    starts: Ints
    start_cumulative: Floats
    observation: Ints
    cart_pole: CartPole
    dims: Ints
    bins: Floats


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
    index = int(np.searchsorted(start_cumulative, uniform, side="right"))
    if index == len(starts):
        return 0
    return int(starts[index])


@inlined
def cart_pole_step(env: Any, world: CartPole) -> bool:
    """One step of Gymnasium's CartPole in its order of operations.

    Args:
        env: a record with the fields x, x_dot, theta, theta_dot, which are changed, and action.
        world: the constants.

    Returns:
        Whether the episode terminates.
    """
    x, x_dot, theta, theta_dot = env.x, env.x_dot, env.theta, env.theta_dot
    force = world.force_mag if env.action == 1 else -world.force_mag
    cos_theta = math.cos(theta)
    sin_theta = math.sin(theta)
    temp = (force + world.polemass_length * (theta_dot * theta_dot) * sin_theta) / world.total_mass
    theta_acc = (world.gravity * sin_theta - cos_theta * temp) / (
        world.length * (4.0 / 3.0 - world.masspole * (cos_theta * cos_theta) / world.total_mass)
    )
    x_acc = temp - world.polemass_length * theta_acc * cos_theta / world.total_mass
    if world.semi_implicit:
        x_dot = x_dot + world.tau * x_acc
        x = x + world.tau * x_dot
        theta_dot = theta_dot + world.tau * theta_acc
        theta = theta + world.tau * theta_dot
    else:
        x = x + world.tau * x_dot
        x_dot = x_dot + world.tau * x_acc
        theta = theta + world.tau * theta_dot
        theta_dot = theta_dot + world.tau * theta_acc
    env.x, env.x_dot, env.theta, env.theta_dot = x, x_dot, theta, theta_dot
    return bool(abs(x) > world.x_threshold or abs(theta) > world.theta_threshold)


@inlined
def bin_index(env: Any, dims: Ints, bins: Floats) -> int:
    """What `DiscretizeObservation` shows of CartPole's state, rounded to single precision first."""
    index = 0
    for d in range(len(dims)):
        value = env.x
        if dims[d] == 1:
            value = env.x_dot
        elif dims[d] == 2:
            value = env.theta
        elif dims[d] == 3:
            value = env.theta_dot
        n_bins, low, high = bins[d, 0], bins[d, 1], bins[d, 2]
        place = (float(np.float32(value)) - low) / (high - low) * n_bins
        index = index * int(n_bins) + int(min(max(place, 0.0), n_bins - 1.0))
    return index
