"""What compiled functions call is compiled as a part of them, once, and is no machine code."""

import numpy as np
import pytest
from numba.core import event

from mdp.machine_code import called, inlined, kernel


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

    def __init__(self):
        self.names = []

    def on_start(self, event):
        self.names.append(event.data["dispatcher"].py_func.__name__)

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
    # What Python may call as well is machine code once it does.
    assert not total.overloads
    assert total(numbers, 2) == 42
    assert len(total.overloads) == 1
