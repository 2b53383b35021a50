"""CartPole as compiled code, which shows numbers of bins."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from agents.compiled.generators import next_uniform
from agents.compiled.training_records import env_dtype
from machine_code.compiling import inlined
from mdp.array_types import Floats, Ints

STATE = ("x", "x_dot", "theta", "theta_dot")
CART_POLE_ENV = env_dtype(*((name, np.float64) for name in STATE))


@inlined
def swing(world: CartPole, env: Any) -> bool:
    """One step of Gymnasium's CartPole in its order of operations; whether it terminates."""
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
def bin_index(world: CartPole, env: Any) -> int:
    """What `DiscretizeObservation` shows of CartPole's state, rounded to single precision first."""
    dims, bins = world.dims, world.bins
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


class CartPole(NamedTuple):
    """CartPole's constants, as Gymnasium names them, and the bins that it is seen through, if any.

    Attributes:
        time_limit: steps after which an episode is truncated, or 0 for never.
        theta_threshold: in radians.
        semi_implicit: whether velocities move before positions.
        dims: the dimensions of the observation that count, shape (d,).
        bins: number of bins, lower end and upper end of each, shape (d, 3).
    """

    time_limit: int
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
    dims: Ints
    bins: Floats

    @inlined
    def step(self, env: Any, handle: Any) -> None:
        """Push the cart as ``env.action`` says; nothing is drawn for that."""
        env.terminated = swing(self, env)
        env.reward = 1.0
        env.monitor_reward = 1.0
        env.success = False
        env.next_obs = bin_index(self, env)

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw a state as ``Generator.uniform(-0.05, 0.05, 4)`` does."""
        width = 0.05 - -0.05
        env.x = -0.05 + width * next_uniform(handle)
        env.x_dot = -0.05 + width * next_uniform(handle)
        env.theta = -0.05 + width * next_uniform(handle)
        env.theta_dot = -0.05 + width * next_uniform(handle)
        env.new_obs = bin_index(self, env)

    @inlined
    def show(self, env: Any, vector: Any) -> None:
        """What the agent sees where there are no bins, in single precision, shape (4,)."""
        vector[0] = np.float32(env.x)
        vector[1] = np.float32(env.x_dot)
        vector[2] = np.float32(env.theta)
        vector[3] = np.float32(env.theta_dot)
