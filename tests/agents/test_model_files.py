"""What a model file holds beside tables comes back as it was, and nothing else can be built."""

import copy
import json
import re
import zipfile
from collections import deque

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.model_files import CODECS, UnknownTypeError, decode, encode
from rl_yardstick.agents.common.schedules import ExponentialSchedule

ARRAY_DTYPES = [
    npst.boolean_dtypes(),
    npst.integer_dtypes(endianness="?"),
    npst.unsigned_integer_dtypes(endianness="?"),
    npst.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
]


def through_json(value):
    return decode(json.loads(json.dumps(encode(value))))


@given(npst.arrays(st.one_of(ARRAY_DTYPES), npst.array_shapes(min_dims=0, min_side=0)))
def test_arrays_come_back_to_the_last_bit(array):
    back = through_json(array)
    assert back.dtype == array.dtype
    assert back.shape == array.shape
    np.testing.assert_array_equal(back, array)
    if array.dtype.kind == "f":
        numbers = ~np.isnan(array)
        np.testing.assert_array_equal(np.signbit(back)[numbers], np.signbit(array)[numbers])


plain = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()


def drawn_from(kind, *args, **kwargs):
    """A space that is in the middle of its random numbers."""
    space = kind(*args, **kwargs, seed=4)
    space.sample()
    return space


def generator(draws):
    """Numbers of 32 bits are drawn in pairs: the second one waits inside the generator."""
    rng = np.random.default_rng(3)
    rng.integers(2**32, size=draws, dtype=np.uint32)
    return rng


NO_LOW = np.array([[-np.inf, 0.1], [-2, -np.inf]], np.float32)
NESTED = spaces.Tuple([spaces.MultiBinary(3)])
BOX = drawn_from(spaces.Box, NO_LOW, np.full((2, 2), 3, np.float32))
SAMPLES = {
    "dictionary": {"b": 1, "a": 2, (True, ("x", 3)): None},
    "tuple": (1, 2),
    "queue": deque([1], maxlen=2),
    "array": np.arange(4.0).reshape(2, 2),
    "generator": generator(4),
    "generator between two": generator(3),
    "constant": ConstantSchedule(1.0),
    "linear": LinearSchedule(1.0, 0.0, 0.5),
    "exponential": ExponentialSchedule(1.0, 0.5, 0.5),
    "schedule of one": FloatSchedule(LinearSchedule(0.1, 3.0, 0.7)),
    "numbers": drawn_from(spaces.Discrete, 3, start=-2),
    "never sampled": spaces.Discrete(3),
    "many numbers": drawn_from(spaces.MultiDiscrete, [[2, 3]], dtype=np.int8, start=[[-4, 5]]),
    "bits": drawn_from(spaces.MultiBinary, [2, 3]),
    "box": BOX,
    "bytes": drawn_from(spaces.Box, 0, 255, (2, 1), np.uint8),
    "tuple of spaces": drawn_from(spaces.Tuple, [spaces.Discrete(2), BOX]),
    "spaces by name": drawn_from(spaces.Dict, [("b", spaces.Discrete(9)), ("a", NESTED)]),
}


def shown(value):
    """What can be seen of a value and of what it draws or says next."""
    if isinstance(value, np.random.Generator):
        numbers = [value.integers(2**32, dtype=np.uint32).item() for _ in range(2)]
        return numbers, value.standard_normal(8).tolist()
    if isinstance(value, gym.Space):
        is_seeded = value._np_random is not None
        nested = [shown(part) for part in value.spaces.values()] if hasattr(value, "keys") else []
        drawn = [spaces.flatten(value, value.sample()).tolist() for _ in range(3 * is_seeded)]
        return repr(value), value.shape, value.dtype, nested, drawn
    says = [value(progress) for progress in (1.0, 0.6, 0.0)] if callable(value) else []
    return repr(value), says, getattr(value, "dtype", None)


@pytest.mark.parametrize("name", SAMPLES)
def test_it_comes_back_and_goes_on_where_it_was(name):
    value = copy.deepcopy(SAMPLES[name])
    back = through_json(value)
    assert type(back) is type(value)
    assert shown(back) == shown(value)
    text = encode(value)
    for field in text:
        less = {key: part for key, part in text.items() if key != field}
        with pytest.raises(ValueError, match="in an agent's file"):
            decode(less)
    with pytest.raises(ValueError, match=f"damaged {text['type']} in an agent's file"):
        decode({**text, "seed": 1})


# A class that only calls itself what the format knows.
Impostor = type("Discrete", (), {"n": 3, "start": 0, "_np_random": None})

UNKNOWN = {
    "set": {1},
    "object": object(),
    "lambda": lambda progress: progress,
    "impostor of a space": Impostor(),
    "space of unknown parts": spaces.Tuple([spaces.Discrete(2), spaces.Text(3)]),
    "schedule of a function": FloatSchedule(lambda progress: progress),
    "other bit generator": np.random.Generator(np.random.Philox(0)),
    "array of objects": np.array([1, None]),
}


@pytest.mark.parametrize("kind", UNKNOWN)
def test_other_types_are_refused_wherever_they_stand(kind):
    value = UNKNOWN[kind]
    for nested in (value, [value], {"key": value}):
        with pytest.raises(UnknownTypeError, match="cannot be written as JSON"):
            encode(nested)


json_values = st.recursive(
    plain,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)
samples = [encode(value) for value in SAMPLES.values()]


def nodes(data):
    """All values inside nested JSON."""
    inner = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    return [data, *(node for part in inner for node in nodes(part))]


# Anything at all; and known types whose fields are anything, or parts of others.
parts = st.sampled_from([node for sample in samples for node in nodes(sample)])
odd_values = parts | st.sampled_from([2**64, -1, 0.5, 1e400, "O", "<f16", "PCG64", [[1], 2], {}])
damaged = json_values | st.sampled_from(sorted(CODECS)).flatmap(
    lambda name: st.fixed_dictionaries(
        dict.fromkeys(CODECS[name].fields, odd_values | json_values)
    ).map(lambda fields: {"type": name, **fields})
)


@pytest.mark.filterwarnings("ignore")  # NumPy and Gymnasium warn of the numbers that they are given
@settings(max_examples=100)
@given(damaged)
def test_any_json_is_decoded_or_refused(data):
    try:
        value = decode(data)
    except ValueError:
        return
    # What was let in is nothing but what the format knows.
    json.dumps(encode(value))


@pytest.mark.parametrize("name", ["qlearning", "reinforce", "ucb", "optimal"])
def test_custom_objects_replace_what_the_file_holds_and_nothing_else(name, tmp_path):
    model = load_algorithm(name)(env="SegmentBandit-v0" if name == "ucb" else "FrozenLake-v1")
    model.save(tmp_path / "whole")
    with (
        zipfile.ZipFile(tmp_path / "whole.zip") as whole,
        zipfile.ZipFile(tmp_path / "agent.zip", "w") as damaged,
    ):
        for member in whole.namelist():
            size = rb'("_stats_window_size"): \d+'
            damaged.writestr(member, re.sub(size, rb'\1: {"type": "?"}', whole.read(member)))
    with pytest.raises(ValueError, match="unknown type '\\?'"):  # what is replaced is not read
        type(model).load(tmp_path / "agent")
    replaced = {"_stats_window_size": 7, "predict": "shadowed", "no_such_thing": 1}
    loaded = type(model).load(tmp_path / "agent", custom_objects=replaced)
    assert loaded._stats_window_size == 7
    assert not {"predict", "no_such_thing"} & set(vars(loaded))
    with pytest.raises(ValueError, match="custom_objects must be a dictionary"):
        type(model).load(tmp_path / "agent", custom_objects=["learning_rate"])
