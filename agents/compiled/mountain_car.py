"""MountainCar as compiled code."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from agents.compiled.generators import next_uniform
from agents.compiled.training_records import env_dtype
from machine_code.compiling import inlined

CAR_STATE = ("position", "velocity")
MOUNTAIN_CAR_ENV = env_dtype(*((name, np.float64) for name in CAR_STATE))


@inlined
def drive(world: MountainCar, env: Any) -> bool:
    """One step of Gymnasium's MountainCar in its order of operations; whether it terminates."""
    position, velocity = env.position, env.velocity
    push = (env.action - 1) * world.force
    velocity += push + math.cos(3 * position) * (-world.gravity)
    velocity = min(max(velocity, -world.max_speed), world.max_speed)
    position += velocity
    position = min(max(position, world.min_position), world.max_position)
    if position == world.min_position and velocity < 0:
        velocity = 0.0
    env.position, env.velocity = position, velocity
    return bool(position >= world.goal_position and velocity >= world.goal_velocity)


class MountainCar(NamedTuple):
    """MountainCar's constants, as Gymnasium names them.

    Attributes:
        time_limit: steps after which an episode is truncated, or 0 for never.
    """

    time_limit: int
    force: float
    gravity: float
    max_speed: float
    min_position: float
    max_position: float
    goal_position: float
    goal_velocity: float

    @inlined
    def step(self, env: Any, handle: Any) -> None:
        """Push the car as ``env.action`` says; nothing is drawn for that."""
        env.terminated = drive(self, env)
        env.reward = -1.0
        env.monitor_reward = -1.0
        env.success = False
        env.next_obs = 0

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Draw a position as ``Generator.uniform(-0.6, -0.4)`` does; the car stands still."""
        width = -0.4 - -0.6
        env.position = -0.6 + width * next_uniform(handle)
        env.velocity = 0.0
        env.new_obs = 0

    @inlined
    def show(self, env: Any, vector: Any) -> None:
        """What the agent sees, in single precision, shape (2,)."""
        vector[0] = np.float32(env.position)
        vector[1] = np.float32(env.velocity)
