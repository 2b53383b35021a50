"""Gymnasium's cars and its pendulum with default arguments, as arithmetic of one dimension."""

from __future__ import annotations

import math

import numpy as np

from mdp.pushed_motion import PushedMotion

# Both cars, but for their goals and engines.
_CAR = PushedMotion(
    low=-1.2,
    high=0.5,
    is_circle=False,
    most_speed=0.07,
    time_step=1.0,
    pull_size=-0.0025,
    pull_rate=3.0,
    pull_phase=0.0,
    push=0.001,
    actions=np.array([-1.0, 0.0, 1.0]),
    is_continuous=False,
    step_cost=1.0,
    position_cost=0.0,
    speed_cost=0.0,
    action_cost=0.0,
    final_cost=0.0,
    horizon=200,
    rounding=1e-9,
)
MOTIONS = {
    "MountainCar-v0": _CAR,
    # It keeps its state in single precision. A return is 100 less the cost, which is 100 where the
    # goal is not reached.
    "MountainCarContinuous-v0": _CAR._replace(
        high=0.45,
        push=0.0015,
        actions=np.array([-1.0, 1.0]),
        is_continuous=True,
        step_cost=0.0,
        action_cost=0.1,
        final_cost=100.0,
        horizon=999,
        rounding=1e-6,
    ),
    "Pendulum-v1": PushedMotion(
        low=-math.pi,
        high=math.pi,
        is_circle=True,
        most_speed=8.0,
        time_step=0.05,
        pull_size=0.75,
        pull_rate=1.0,
        pull_phase=-math.pi / 2,
        push=0.15,
        actions=np.array([-2.0, 2.0]),
        is_continuous=True,
        step_cost=0.0,
        position_cost=1.0,
        speed_cost=0.1,
        action_cost=0.001,
        final_cost=0.0,
        horizon=200,
        rounding=1e-9,
    ),
}
# A return is this, less the cost.
COST_FREE_RETURN = {"MountainCar-v0": 0.0, "MountainCarContinuous-v0": 100.0, "Pendulum-v1": 0.0}
# Where episodes begin: uniform positions from and to, and speeds.
STARTS = {
    "MountainCar-v0": ((-0.6, -0.4), (0.0, 0.0)),
    "MountainCarContinuous-v0": ((-0.6, -0.4), (0.0, 0.0)),
    "Pendulum-v1": ((-math.pi, math.pi), (-1.0, 1.0)),
}
