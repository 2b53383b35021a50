"""What runs where nothing is compiled, and what compiling takes."""

import os
import subprocess
import sys

import numpy as np
import pytest

from machine_code import WorkTime
from machine_code.compiling import compile_timer, compiled


def test_without_the_compiler_python_plans_and_evaluates():
    code = """
import gymnasium
from envs.known_models import transition_model
from mdp import finite_horizon_optimum, policy_return
for name in ("envs:Warehouse-v0", "FrozenLake-v1"):
    model = transition_model(gymnasium.make(name))
    plan = finite_horizon_optimum(model, 100)
    print(plan.start_value, policy_return(model, plan.policy, 100).expected_return)
"""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    warehouse, frozen_lake = (line.split() for line in done.stdout.splitlines())
    assert warehouse == ["79.0", "79.0"]
    planned, earned = map(float, frozen_lake)
    assert earned == pytest.approx(planned, abs=1e-12)


def test_compiling_is_timed_as_a_whole():
    @compiled
    def inner(x):
        return x * np.pi + 1

    @compiled
    def outer(x):
        return inner(x) - np.pi

    begun = WorkTime.now()
    with compile_timer() as time_compiling:
        assert time_compiling() == WorkTime()
        outer(2.0)
        first = time_compiling()
        outer(3.0)
        assert time_compiling() == first
    taken = WorkTime.now() - begun
    assert 0 < first.seconds <= taken.seconds
    assert 0 < first.cpu_seconds <= taken.cpu_seconds
