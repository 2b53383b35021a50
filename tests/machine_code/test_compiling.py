"""Compiled functions: parts are compiled once, and what compiling takes is told."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numba.core import event

from rl_yardstick.machine_code import WorkTime
from rl_yardstick.machine_code.compiling import called, compile_timer, compiled, inlined, kernel


@called
def scale(numbers, factor):
    for i in range(len(numbers)):
        numbers[i] *= factor


@inlined
def total(numbers, times):
    result = 0.0
    for i in range(len(numbers)):
        result += numbers[i]
    return times * result


@kernel
def scaled_total(numbers, times):
    scale(numbers, 2)
    scale(numbers, times)
    return total(numbers, 1) + total(numbers, times)


class Compiled(event.Listener):
    """Names of what is compiled."""

    names = ()

    def on_start(self, event):
        self.names += (event.data["dispatcher"].py_func.__name__,)

    def on_end(self, event):
        pass


def test_parts_are_compiled_once_and_only_python_is_refused():
    numbers = np.array([1.0, 2.5])
    with pytest.raises(TypeError, match="only compiled functions can call scale"):
        scale(numbers, 2)
    noted = Compiled()
    with event.install_listener("numba:compile", noted):
        assert scaled_total(numbers, 3) == 4 * 6 * 3.5
    # Numbers that are written out are none of their own type.
    assert sorted(noted.names) == ["scale", "scaled_total", "total"]
    assert numbers.tolist() == [6.0, 15.0]
    with pytest.raises(TypeError, match="only compiled functions can call scale"):
        scale(numbers, 2)
    assert total(numbers, 2) == 42


def test_without_the_compiler_python_plans_and_evaluates():
    code = """
import gymnasium
from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.mdp import finite_horizon_optimum, policy_return
for name in ("rl_yardstick.envs:Warehouse-v0", "FrozenLake-v1"):
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
