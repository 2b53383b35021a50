"""What a model file holds beside tables comes back as it was, and nothing else can be built."""

import enum
import json
import pickletools
import string
import subprocess
import sys
import zipfile
from base64 import b64decode
from collections import OrderedDict, deque, namedtuple

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from agents import load_algorithm
from agents.common.model_files import CODECS, UnknownTypeError, decode, encode
from agents.common.schedules import ExponentialSchedule, library_schedule
from agents.tabular.dyna import MOST_BYTES, DatedModelPolicy, ModelPolicy
from agents.tabular.optimism import CountedModelPolicy
from pipeline.settings.components import build_algorithm_kwargs
from safe_files.files import MAX_ARCHIVE_BYTES

ARRAY_DTYPES = [
    npst.boolean_dtypes(),
    npst.integer_dtypes(endianness="?"),
    npst.unsigned_integer_dtypes(endianness="?"),
    npst.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
]
names = st.text(string.ascii_lowercase, min_size=1, max_size=3)
seeds = st.integers(0, 2**32)
shares = st.floats(0.01, 1)
positive = st.floats(1e-6, 1e6)


def through_json(value):
    return decode(json.loads(json.dumps(encode(value))))


# --- arrays, numbers, containers -----------------------------------------------------------------


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
keys = st.recursive(
    st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner, max_size=3).map(tuple),
    max_leaves=4,
)
containers = st.recursive(
    plain,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.lists(inner, max_size=3).map(deque)
        | st.lists(inner, max_size=3).map(lambda items: deque(items, maxlen=5))
        | st.dictionaries(keys, inner, max_size=3)
    ),
    max_leaves=12,
)


def same(first, second):
    """Equal in value, in type and in the order of their parts, all the way down."""
    if type(first) is not type(second):
        return False
    if isinstance(first, dict):
        return same(list(first.items()), list(second.items()))
    if isinstance(first, deque) and first.maxlen != second.maxlen:
        return False
    if isinstance(first, list | tuple | deque):
        return len(first) == len(second) and all(map(same, first, second))
    return first == second


@given(containers)
def test_nested_containers_come_back(value):
    assert same(through_json(value), value)


@pytest.mark.parametrize(
    ("scalar", "number"),
    [
        (np.float64(0.1), 0.1),
        (np.float32(0.1), float(np.float32(0.1))),
        (np.int64(-(2**63)), -(2**63)),
        (np.uint64(2**64 - 1), 2**64 - 1),
        (np.bool_(True), True),
        (np.str_("x"), "x"),
    ],
)
def test_numpy_scalars_become_plain_numbers(scalar, number):
    assert same(through_json(scalar), number)


# --- generators ----------------------------------------------------------------------------------


@given(seeds, st.integers(0, 5))
def test_generators_go_on_where_they_were(seed, draws):
    rng = np.random.default_rng(seed)
    # Numbers of 32 bits are drawn in pairs: the second one waits inside the generator.
    rng.integers(2**32, size=draws, dtype=np.uint32)
    back = through_json(rng)
    for _ in range(2):
        assert back.integers(2**32, dtype=np.uint32) == rng.integers(2**32, dtype=np.uint32)
    np.testing.assert_array_equal(back.standard_normal(8), rng.standard_normal(8))


# --- schedules -----------------------------------------------------------------------------------

schedules = st.recursive(
    st.builds(ConstantSchedule, st.floats(-10, 10))
    | st.builds(LinearSchedule, st.floats(-10, 10), st.floats(-10, 10), shares)
    | st.builds(ExponentialSchedule, positive, positive, shares),
    lambda inner: st.builds(FloatSchedule, inner),
    max_leaves=2,
)


@given(schedules, st.lists(st.floats(0, 1), min_size=1))
def test_schedules_come_back(schedule, progress):
    back = through_json(schedule)
    assert type(back) is type(schedule)
    assert repr(back) == repr(schedule)
    assert [back(p) for p in progress] == [schedule(p) for p in progress]


# --- spaces --------------------------------------------------------------------------------------


@st.composite
def multi_discretes(draw):
    shape = draw(npst.array_shapes(max_dims=2, max_side=3))
    dtype = draw(st.sampled_from([np.int8, np.int32, np.int64]))
    nvec = draw(npst.arrays(dtype, shape, elements=st.integers(1, 9)))
    start = draw(npst.arrays(dtype, shape, elements=st.integers(-9, 9)))
    return spaces.MultiDiscrete(nvec, dtype=dtype, start=start)


@st.composite
def boxes(draw):
    shape = draw(npst.array_shapes(min_dims=0, max_dims=2, max_side=3))
    dtype, elements, no_bound = draw(
        st.sampled_from(
            [
                (np.float32, st.floats(-9, 9, width=32), np.inf),
                (np.float64, st.floats(-9, 9), np.inf),
                (np.uint8, st.integers(0, 255), None),
                (np.int64, st.integers(-9, 9), None),
            ]
        )
    )
    first, second = (draw(npst.arrays(dtype, shape, elements=elements)) for _ in range(2))
    low, high = np.minimum(first, second), np.maximum(first, second)
    if no_bound is not None:
        low = np.where(draw(npst.arrays(bool, shape)), dtype(-no_bound), low).astype(dtype)
        high = np.where(draw(npst.arrays(bool, shape)), dtype(no_bound), high).astype(dtype)
    return spaces.Box(low, high, dtype=dtype)


simple_spaces = (
    st.builds(spaces.Discrete, st.integers(1, 9), start=st.integers(-9, 9))
    | multi_discretes()
    | st.builds(
        spaces.MultiBinary, st.integers(1, 5) | st.lists(st.integers(1, 3), min_size=1, max_size=3)
    )
    | boxes()
)
any_space = st.recursive(
    simple_spaces,
    lambda inner: (
        st.lists(inner, min_size=1, max_size=3).map(spaces.Tuple)
        # As pairs, so that the order of the keys is anything.
        | st.dictionaries(names, inner, min_size=1, max_size=3).map(
            lambda parts: spaces.Dict(list(parts.items()))
        )
    ),
    max_leaves=5,
)


def parts(space):
    """The space, and all that it is made of, in order."""
    inner = getattr(space, "spaces", ())
    named = inner.items() if isinstance(inner, dict) else enumerate(inner)
    return [type(space), *(entry for key, part in named for entry in (key, *parts(part)))]


def flat(space, sample):
    return spaces.flatten(space, sample).tolist()


@given(any_space, seeds, st.integers(0, 3))
def test_spaces_come_back_and_go_on_sampling(space, seed, draws):
    space.seed(seed)
    for _ in range(draws):
        space.sample()
    back = through_json(space)
    assert back == space
    assert parts(back) == parts(space)
    assert (back.shape, back.dtype) == (space.shape, space.dtype)
    for _ in range(3):
        assert flat(back, back.sample()) == flat(space, space.sample())


def test_a_space_that_was_never_sampled_has_no_generator_yet():
    space = spaces.Discrete(3)
    assert through_json(space)._np_random is None
    assert space._np_random is None


# --- what has no place in the format -------------------------------------------------------------


class Level(enum.Enum):
    HIGH = 1


class Shadow(list):
    """Same behaviour, another class."""


Point = namedtuple("Point", "x y")
# Classes that only call themselves what the format knows.
Impostor = type("Discrete", (), {"n": 3, "start": 0, "_np_random": None})
NamedLikeATuple = type("tuple", (), {})

UNKNOWN = {
    "set": {1},
    "bytes": b"x",
    "complex": 1j,
    "object": object(),
    "function": len,
    "lambda": lambda progress: progress,
    "class": int,
    "enum": Level.HIGH,
    "named tuple": Point(1, 2),
    "ordered dictionary": OrderedDict(a=1),
    "impostor of a space": Impostor(),
    "impostor of a container": NamedLikeATuple(),
    "text space": spaces.Text(3),
    "sequence space": spaces.Sequence(spaces.Discrete(2)),
    "space of unknown parts": spaces.Tuple([spaces.Discrete(2), spaces.Text(3)]),
    "schedule of a function": FloatSchedule(lambda progress: progress),
    "other bit generator": np.random.Generator(np.random.Philox(0)),
    "older generator": np.random.RandomState(0),
    "date": np.datetime64("2020-01-01"),
    "duration": np.timedelta64(1, "s"),
    "complex scalar": np.complex64(1),
    "wide scalar": np.longdouble(1),
    "array of objects": np.array([1, None]),
    "array of texts": np.array(["x"]),
    "array of dates": np.array(["2020-01-01"], dtype="M8[ns]"),
    "array of records": np.zeros(1, dtype="i4,f4"),
    "array of wide floats": np.zeros(1, dtype=np.longdouble),
    "array of complex": np.zeros(1, dtype=np.complex64),
}


@pytest.mark.parametrize("kind", UNKNOWN)
def test_other_types_are_refused_wherever_they_stand(kind):
    value = UNKNOWN[kind]
    for nested in (value, [value], (1, value), {"key": value}, deque([value])):
        with pytest.raises(UnknownTypeError, match="cannot be written as JSON"):
            encode(nested)


def test_a_key_of_another_type_is_refused():
    with pytest.raises(UnknownTypeError, match="frozenset"):
        encode({frozenset(): 1})


# --- damaged files -------------------------------------------------------------------------------

json_values = st.recursive(
    plain,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)
samples = [
    encode(value)
    for value in (
        {"a": 1},
        (1, 2),
        deque([1], maxlen=2),
        np.arange(4.0).reshape(2, 2),
        np.random.default_rng(0),
        ConstantSchedule(1.0),
        LinearSchedule(1.0, 0.0, 0.5),
        ExponentialSchedule(1.0, 0.5, 0.5),
        FloatSchedule(1.0),
        spaces.Discrete(3, seed=0),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary([2, 3]),
        spaces.Box(-1, 1, (2,)),
        spaces.Tuple([spaces.Discrete(2)]),
        spaces.Dict({"a": spaces.Discrete(2)}),
    )
]


def nodes(data):
    """All values inside nested JSON."""
    inner = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    return [data, *(node for part in inner for node in nodes(part))]


foreign_parts = st.sampled_from([node for sample in samples for node in nodes(sample)])
odd_values = st.sampled_from(
    [2**64, -(2**64), -1, 0.5, 1e400, "(2,,3)i4", "O", "<f16", "PCG64", [[1], 2], {}, []]
)
# Anything at all; and known types whose fields are anything, or parts of others.
damaged = st.recursive(
    json_values
    | st.sampled_from([*CODECS, "builtins.eval", None, 3]).map(lambda name: {"type": name})
    | st.sampled_from(sorted(CODECS)).flatmap(
        lambda name: st.fixed_dictionaries(
            dict.fromkeys(CODECS[name].fields, odd_values | foreign_parts | json_values)
        ).map(lambda fields: {"type": name, **fields})
    ),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.sampled_from(samples).flatmap(
            lambda sample: st.tuples(st.sampled_from(sorted(sample)), inner).map(
                lambda change: {**sample, change[0]: change[1]}
            )
        )
    ),
    max_leaves=4,
)


@pytest.mark.filterwarnings("ignore")  # NumPy and Gymnasium warn of the numbers that they are given
@settings(max_examples=500)
@given(damaged)
def test_any_json_is_decoded_or_refused(data):
    try:
        value = decode(data)
    except ValueError:
        return
    # What was let in is nothing but what the format knows.
    json.dumps(encode(value))


@pytest.mark.parametrize("sample", samples, ids=lambda sample: sample["type"])
def test_fields_must_be_those_of_the_type(sample):
    for field in sample:
        less = {key: value for key, value in sample.items() if key != field}
        with pytest.raises(ValueError, match="in an agent's file"):
            decode(less)
    with pytest.raises(ValueError, match=f"damaged {sample['type']} in an agent's file"):
        decode({**sample, "seed": 1})


@pytest.mark.parametrize("name", ["object", "os.system", "Codec", "Text", "", None, 3, [], {}])
def test_a_type_that_is_not_in_the_table_is_not_built(name):
    with pytest.raises(ValueError, match="unknown type"):
        decode({"type": name, "n": 3})


OUT_OF_RANGE = {
    "huge size": {"type": "Discrete", "n": 2**70, "start": 0, "rng": None},
    "no size": {"type": "Discrete", "n": 0, "start": 0, "rng": None},
    "no generator": {"type": "Discrete", "n": 3, "start": 0, "rng": 7},
    "huge queue": {"type": "deque", "iterable": [], "maxlen": 2**70},
    "huge entry": {"type": "ndarray", "dtype": "<i8", "values": [2**70], "shape": [1]},
    "other shape": {"type": "ndarray", "dtype": "<i8", "values": [1, 2], "shape": [3]},
    "objects": {"type": "ndarray", "dtype": "|O", "values": [1], "shape": [1]},
    "broken dtype": {"type": "ndarray", "dtype": "(2,,3)i4", "values": [1], "shape": [1]},
    "empty state": {"type": "Generator", "state": {"type": "dict", "pairs": []}},
    "list as a key": {"type": "dict", "pairs": [[[], 1]]},
    "text as a schedule": {"type": "FloatSchedule", "value_schedule": "fast"},
    "decay from 0": {"type": "ExponentialSchedule", "start": 0.0, "end": 1.0, "end_fraction": 1.0},
}


@pytest.mark.parametrize("damage", OUT_OF_RANGE)
def test_fields_out_of_range_are_refused(damage):
    with pytest.raises(ValueError, match=r"."):
        decode(OUT_OF_RANGE[damage])


# --- files of agents of the library ---------------------------------------------------------------

EXPONENTIAL = {
    name: {"learning_rate": "exp_0.1_0.001"}
    for name in ("ppo", "a2c", "dqn", "double_dqn", "deep_qlearning", "qrdqn")
}
EXPONENTIAL["ppo"] |= {"clip_range": "exp_0.4_0.1"}


@pytest.mark.parametrize(("start", "end"), [(0.1, 0.001), (0.001, 0.1), (0.5, 0.5)])
def test_a_librarys_schedule_is_ours(start, end):
    ours = ExponentialSchedule(start, end)
    theirs = library_schedule(ours)
    for remaining in np.linspace(0.0, 1.0, 11).tolist():
        assert float(theirs(remaining)) == pytest.approx(ours(remaining), rel=1e-12)


def zip_with_exponential_schedule(name, tmp_path):
    algorithm = load_algorithm(name)
    kwargs = build_algorithm_kwargs(algorithm, {"policy": "MlpPolicy", **EXPONENTIAL[name]}, name)
    model = algorithm(env=gym.make("CartPole-v1"), **kwargs)
    model.save(tmp_path / name)
    return tmp_path / f"{name}.zip"


@pytest.mark.parametrize("name", EXPONENTIAL)
def test_a_library_agents_zip_names_no_module_of_this_project(name, tmp_path):
    with zipfile.ZipFile(zip_with_exponential_schedule(name, tmp_path)) as archive:
        data = json.loads(archive.read("data"))
    words = [
        str(argument)
        for value in data.values()
        if isinstance(value, dict) and ":serialized:" in value
        for _, argument, _ in pickletools.genops(b64decode(value[":serialized:"]))
    ]
    assert any(word.startswith("stable_baselines3") for word in words)
    ours = {"agents", "envs", "mdp", "pipeline", "experiments", "commands"}
    assert ours.isdisjoint(word.partition(".")[0] for word in words)


def test_a_library_agents_zip_opens_where_this_project_is_not(tmp_path):
    path = zip_with_exponential_schedule("ppo", tmp_path)
    code = (
        "import sys\n"
        f"sys.path = [p for p in sys.path if 'site-packages' in p or 'lib/python' in p]\n"
        "sys.meta_path = [f for f in sys.meta_path if 'editable' not in repr(f)]\n"
        "import importlib.util\n"
        "assert importlib.util.find_spec('agents') is None\n"
        "from stable_baselines3 import PPO\n"
        f"model = PPO.load({str(path)!r})\n"
        "print(model.lr_schedule(0.5), model.clip_range(0.5))\n"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert [float(word) for word in done.stdout.split()] == pytest.approx([0.01, 0.2])


# --- what is replaced on the way -----------------------------------------------------------------


@pytest.mark.parametrize("name", ["qlearning", "reinforce", "ucb", "optimal"])
def test_custom_objects_replace_what_the_file_holds_and_nothing_else(name, tmp_path):
    env = "SegmentBandit-v0" if name == "ucb" else "FrozenLake-v1"
    model = load_algorithm(name)(env=env, seed=0)
    model.save(tmp_path / "agent")
    replaced = {"stats_window_size": 7, "predict": "shadowed", "no_such_thing": 1}
    loaded = type(model).load(tmp_path / "agent", custom_objects=replaced)
    assert loaded._stats_window_size == model._stats_window_size
    assert not {"predict", "no_such_thing"} & set(vars(loaded))
    loaded = type(model).load(tmp_path / "agent", custom_objects={"_stats_window_size": 7})
    assert loaded._stats_window_size == 7
    with pytest.raises(ValueError, match="custom_objects must be a dictionary"):
        type(model).load(tmp_path / "agent", custom_objects=["learning_rate"])


def test_what_is_replaced_need_not_be_readable(tmp_path):
    model = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0)
    model.save(tmp_path / "agent")
    with zipfile.ZipFile(tmp_path / "agent.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    rate = b'"learning_rate": '
    members["data"] = members["data"].replace(rate + b"0.1", rate + b'{"type": "?"}')
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(ValueError, match="unknown type '\\?'"):
        type(model).load(tmp_path / "other")
    loaded = type(model).load(tmp_path / "other", custom_objects={"learning_rate": 0.25})
    assert loaded.lr_schedule(0.5) == 0.25


@pytest.mark.parametrize("kind", [ModelPolicy, DatedModelPolicy, CountedModelPolicy])
def test_the_largest_model_fits_into_a_file_that_is_read_again(kind):
    policy = kind(spaces.Discrete(1000), spaces.Discrete(4))
    with pytest.raises(ValueError, match="of each") as refusal:
        policy.keep_outcomes(10**9)
    most = int(str(refusal.value).split("at most ")[1].split()[0])
    policy.keep_outcomes(most)
    size = sum(array.nbytes for array in policy.buffers())
    per_outcome = sum(array[..., 0].nbytes for array in policy.buffers() if array.shape[-1] == most)
    # Numbers of which there is one are counted for each state.
    assert MOST_BYTES - per_outcome - 16_000 <= size <= MOST_BYTES < MAX_ARCHIVE_BYTES
    with pytest.raises(ValueError, match=f"at most {most} of each"):
        policy.keep_outcomes(most + 1)
