"""Rows of Monitor's files that compiled code writes are those of Python."""

import numpy as np
import pytest

from agents.compiled.records import whole_rows

END = "1.5e-05\r\n"


def python_rows(returns, lengths):
    return "".join(
        f"{round(total, 6)},{length},{END}"
        for total, length in zip(returns.tolist(), lengths.tolist(), strict=True)
    )


def test_they_are_to_the_last_letter():
    rng = np.random.default_rng(0)
    powers = 10.0 ** np.arange(15)
    returns = np.concatenate(
        [[0.0], powers, powers - 1, -powers, rng.integers(-(10**15) + 1, 10**15, 500) * 1.0]
    )
    lengths = rng.integers(1, 10**12, len(returns))
    lengths[:3] = 1, 9, 10
    assert whole_rows(returns, lengths, END) == python_rows(returns, lengths)


def test_no_episodes_are_no_rows():
    assert whole_rows(np.empty(0), np.empty(0, dtype=np.int64), END) == ""


@pytest.mark.parametrize("odd", [0.5, -1e-9, 1e15, -1e15, 1e300, np.inf, -np.inf, np.nan])
def test_what_is_not_whole_is_left_to_python(odd):
    assert whole_rows(np.array([1.0, odd]), np.array([1, 1]), END) is None
