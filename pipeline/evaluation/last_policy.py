"""What follows from a policy, worked out once for as long as the policy stays the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Result = TypeVar("Result")


class OfLastPolicy(Generic[Result]):
    """A function of a policy that remembers its last result.

    An agent is evaluated many times, and mostly acts as it did the time before.

    Args:
        work: the function; its result is not to be changed.
    """

    def __init__(self, work: Callable[[NDArray[Any]], Result]) -> None:
        self._work = work
        self._last: tuple[NDArray[Any], Result] | None = None

    def __call__(self, policy: NDArray[Any]) -> Result:
        """The result for a policy in one of the forms of `mdp.evaluation`."""
        last = self._last
        if last is not None and last[0].dtype == policy.dtype and np.array_equal(last[0], policy):
            return last[1]
        result = self._work(policy)
        self._last = policy.copy(), result
        return result
