"""What is written as JSON: valid by its grammar, and the same when it is read."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.digests import FIELD
from pipeline.files import json_text, plain
from pipeline.runs import FINISHED, Run

leaves = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
values = st.recursive(
    leaves, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=10
)


def strictly(text):
    """The value of a text that a strict reader takes."""

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


@given(values)
def test_what_is_written_is_read_again_as_it_was(value):
    assert strictly(json_text(value)) == value


def test_what_is_no_json_is_written_as_the_nearest_that_is():
    odd = {
        "nan": math.nan,
        "limits": (-math.inf, np.float32(np.inf)),
        "array": np.arange(3, dtype=np.int8),
        "NaN, Infinity": "NaN",
        "surrogate": "\udcff",
        1: np.bool_(True),
    }
    assert strictly(json_text(odd, indent=2)) == {
        "nan": None,
        "limits": [-math.inf, math.inf],
        "array": [0, 1, 2],
        "NaN, Infinity": "NaN",
        "surrogate": "\udcff",
        "1": True,
    }
    with pytest.raises(TypeError, match="object"):
        plain([object()])


def test_a_record_of_odd_values_is_valid_and_whole(tmp_path):
    run = Run(tmp_path, "FrozenLake-v1")
    run.end(state=FINISHED, spec={"clip": math.inf, "scale": np.float32(0.5)}, final=math.nan)
    record = strictly(run.info_path.read_text(encoding="utf-8"))
    assert record == run.read_info()  # which holds it against its own digest
    assert record["spec"] == {"clip": math.inf, "scale": 0.5}
    assert record["final"] is None
    assert FIELD in record
