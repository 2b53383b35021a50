"""What a state keeps of objects: they go on as those would have that were saved."""

import collections
import csv
import dataclasses
import datetime
import decimal
import enum
import functools
import io
import logging
import operator
import random
import re
import subprocess
import sys
import tempfile
import threading
import types
import weakref
from array import array
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from stable_baselines3 import DQN, HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.utils import set_random_seed

from pipeline.state_files import read_state, write_state
from pipeline.states import NotFittingError, NotKeepableError, pickled, unpickled

KEY = b"k" * 32


class Holder:
    """Anything, by name."""

    def __init__(self, **held):
        vars(self).update(held)

    def one(self):
        return 1

    def two(self):
        return 2


class World(gym.Env):
    """Of those objects that are filled in, as functions that are running hold them."""

    def __init__(self, **held):
        vars(self).update(held)


class Colour(enum.Enum):
    RED = 1


class Side(enum.Flag):
    LEFT = 1
    RIGHT = 2


class Point(NamedTuple):
    x: int
    y: list


@dataclasses.dataclass(frozen=True)
class Frozen:
    values: list


class Slotted:
    __slots__ = ("__private", "public")

    def __init__(self):
        self.__private = 1
        self.public = [2]

    def read(self):
        return self.__private, self.public

    def count(self):
        self.__private += 1


class Row(list):
    pass


class Grid(np.ndarray):
    pass


class Everything(gym.Env):
    """One of each kind, and a way to change them all."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.old_rng = np.random.RandomState(seed)
        self.python_rng = random.Random(seed)  # noqa: S311
        self.torch_rng = th.Generator().manual_seed(seed)
        self.scalars = [1, -0.0, float("nan"), float("-inf"), "a", None, True, 2**100, 1 + 2j]
        self.tuple = (1, [2], Point(3, [4]))
        self.dict = {"a": np.arange(3.0), (1, "b"): {4, 5}, Colour.RED: Colour.RED}
        self.queue = collections.deque([1, 2], maxlen=4)
        self.counts = collections.defaultdict(float, a=1.0)
        self.net = th.nn.Sequential(th.nn.Linear(3, 4), th.nn.BatchNorm1d(4))
        self.optimizer = th.optim.Adam(self.net.parameters())
        self.slotted = Slotted()
        self.frozen = Frozen([seed])
        self.same = self.frozen.values
        self.cycle = self
        self.record = np.zeros(2, np.dtype([("a", np.int8), ("b", np.float64)], align=True))
        self.objects = np.array([{"a": 1}, None], dtype=object)
        self.numbers = array("d", [1.0])
        self.bytes = [b"", b"ab", bytearray(b"c")]
        self.rewards = [float(i) for i in range(1500)]
        self.space = gym.spaces.Box(0.0, 1.0, (2,), seed=seed)
        self.function = lambda: seed
        self.partial = functools.partial(max, 1)
        self.getter = operator.attrgetter("a")

    def step(self):
        self.optimizer.zero_grad()
        (self.net(th.rand(5, 3, generator=self.torch_rng)) ** 2).mean().backward()
        self.optimizer.step()
        self.queue.append(self.rng.normal())
        self.scalars.append(self.python_rng.random())
        self.dict["new", len(self.dict)] = self.old_rng.rand(2)
        self.counts[str(len(self.counts))] += self.space.sample()[0]
        self.slotted.count()
        self.same.append(1)
        self.record["b"] += 1
        self.objects[0]["a"] += 1
        self.numbers.append(2.0)
        self.rewards.append(-1.0)
        self.tuple[2].y.append(self.rng.integers(5))

    def figures(self):
        """All of it as text."""
        weights = [p.tolist() for p in self.net.parameters()]
        moments = [s["exp_avg_sq"].tolist() for s in self.optimizer.state.values()]
        kept = [self.scalars, self.tuple, self.dict, self.queue, self.counts, self.same]
        more = [self.record, self.objects, self.numbers, self.bytes, self.rewards]
        return repr([weights, moments, self.slotted.read(), kept, more])


def gone_through(original, built, folder, moved=None):
    """What comes of an object that was saved, where another process has built one like it."""
    with (folder / "state").open("wb") as file:
        write_state(file, pickled({"it": original}), {"note": 1}, KEY)
    with (folder / "state").open("rb") as file:
        state = read_state(file, KEY)
    assert state.note == {"note": 1}
    return unpickled(state.content, {"it": built}, moved)["it"]


def again(value, folder):
    """A value that was saved and read back."""
    return gone_through(Holder(held=value), Holder(held=None), folder).held


def test_everything_goes_on_as_it_would_have(tmp_path):
    original, other = Everything(1), Everything(1)
    for _ in range(3):
        original.step()
    found = gone_through(original, other, tmp_path)
    assert found is other
    assert found.figures() == original.figures()
    for thing in (original, found):
        for _ in range(4):
            thing.step()
    assert found.figures() == original.figures()
    assert found.same is found.frozen.values
    assert found.cycle is found
    assert found.function() == 1


def test_saving_changes_nothing():
    thing = Everything(1)
    before = thing.figures()
    first, second = (bytes(pickled({"it": thing}).pickled) for _ in range(2))
    assert first == second
    assert thing.figures() == before


VALUES = [
    *(Path("/a/b"), re.compile("a+", re.IGNORECASE), np.dtype("int16"), th.float64, th.strided),
    *(th.device("cpu"), th.Size([2, 3]), slice(1, None, 2), datetime.date(2026, 11, 22), ...),
    datetime.datetime(2026, 11, 22, 7, 30, 0, 1),
    datetime.datetime(2026, 11, 22, tzinfo=datetime.UTC),
    *(datetime.timedelta(3, 4, 5), decimal.Decimal("1.50"), logging.getLogger("a name")),
    *(np.mean, np.add, th.tanh, types.MappingProxyType({"a": 1}), collections.Counter("aab")),
    *(collections.OrderedDict(b=1, a=2), Side.LEFT | Side.RIGHT, Side(0), range(1, 9, 2)),
]


# No id holds an address.
@pytest.mark.parametrize("value", VALUES, ids=lambda value: getattr(value, "__name__", repr(value)))
def test_values(tmp_path, value):
    found = again(value, tmp_path)
    assert type(found) is type(value)
    assert found == value


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
        lambda inner: st.lists(inner) | st.tuples(inner) | st.dictionaries(st.text(), inner),
        max_leaves=20,
    )
)
def test_any_data(tmp_path_factory, data):
    assert repr(again(data, tmp_path_factory.mktemp("a"))) == repr(data)


# --- arrays and tensors ---


@given(hnp.arrays(hnp.scalar_dtypes(), hnp.array_shapes(min_dims=0, min_side=0)))
def test_any_array(tmp_path_factory, values):
    found = again(values, tmp_path_factory.mktemp("a"))
    assert (found.dtype, found.shape) == (values.dtype, values.shape)
    assert found.tobytes() == values.tobytes()


def test_arrays_and_tensors_lie_in_memory_as_they_did(tmp_path):
    """A sum runs through them in that order, and rounds accordingly."""
    deep = np.arange(24.0).reshape(2, 3, 4).transpose(2, 0, 1).copy(order="K")
    for values in (np.asfortranarray(np.arange(6.0).reshape(2, 3)), deep):
        found = again(values, tmp_path)
        assert (found.strides, found.tolist()) == (values.strides, values.tolist())
    image = th.randn(2, 3, 4, 4).contiguous(memory_format=th.channels_last)
    found = again(image, tmp_path)
    assert found.stride() == image.stride()
    assert found.equal(image)


@pytest.mark.parametrize("value", [th.zeros(0, 3), th.tensor([1 + 2j]).conj(), th.arange(9)[2:5]])
def test_odd_tensors(tmp_path, value):
    assert again(value, tmp_path).equal(value)


def test_what_was_frozen_stays_frozen(tmp_path):
    net = th.nn.Linear(2, 2)
    net.weight.requires_grad_(False)
    found = again(net, tmp_path)
    assert [weights.requires_grad for weights in found.parameters()] == [False, True]
    assert isinstance(again(net.bias, tmp_path), th.nn.Parameter)


def test_a_row_of_a_table_is_that_row_again(tmp_path):
    table = np.arange(6).reshape(3, 2)
    back = table[::-1, 1]
    back.flags.writeable = False
    table, row, back, alone = again([table, table[2], back, np.ones(2)], tmp_path)
    row += 10
    alone += 1
    assert table.tolist() == [[0, 1], [2, 3], [14, 15]]
    assert back.tolist() == [15, 3, 1]
    assert not back.flags.writeable


def test_arrays_and_tensors_of_one_memory_share_it_again(tmp_path):
    tensor, array = th.zeros(4), np.zeros(4, np.float32)
    held = [tensor, tensor.numpy(), tensor[1:], array, th.from_numpy(array)]
    tensor, view, rest, array, seen = again(held, tmp_path)
    tensor[1] = 5.0
    array[2] = 7.0
    assert view.tolist() == [0, 5, 0, 0]
    assert rest.tolist() == [5, 0, 0]
    assert seen.tolist() == [0, 0, 7, 0]


def test_zeros_at_the_end_take_no_room(tmp_path):
    buffer = np.zeros((1000, 100))
    buffer[2, 3] = 1.0
    assert np.array_equal(again(buffer, tmp_path), buffer)
    assert (tmp_path / "state").stat().st_size < 4000


def test_arrays_of_other_classes_keep_what_they_add(tmp_path):
    row, grid = Row([1, 2]), np.arange(3).view(Grid)
    row.name, grid.name = "a", "b"
    masked = np.ma.masked_array([1.0, 2.0], [True, False])
    found = again([row, grid, masked], tmp_path)
    assert [type(held) for held in found] == [Row, Grid, np.ma.MaskedArray]
    assert (found[0], found[0].name, found[1].name) == ([1, 2], "a", "b")
    assert found[2].mask.tolist() == [True, False]


# --- generators ---


@pytest.mark.parametrize(
    "make",
    [
        lambda: random.Random(1).random,  # noqa: S311
        lambda: random.Random(1).choice,  # noqa: S311
        lambda: np.random.default_rng(1).random,
        lambda: np.random.RandomState(1).rand,
    ],
    ids=["Random.random", "Random.choice", "Generator.random", "RandomState.rand"],
)
def test_a_generators_method_goes_on_drawing(tmp_path, make):
    arguments = ([1, 2, 3, 4, 5, 6, 7],) if make().__name__ == "choice" else ()
    draw = make()
    draw(*arguments)
    found = again(draw, tmp_path)
    assert [found(*arguments) for _ in range(5)] == [draw(*arguments) for _ in range(5)]


def test_generators_of_one_source_share_it_and_seeds_go_on_spawning(tmp_path):
    first = np.random.default_rng(3)
    second = np.random.Generator(first.bit_generator)
    seeds, generator = np.random.SeedSequence(1), np.random.default_rng(2)
    seeds.spawn(2)
    generator.spawn(1)
    one, other, found, parent = again([first, second, seeds, generator], tmp_path)
    assert [one.random(), other.random()] == [first.random(), second.random()]
    assert found.spawn(1)[0].state == seeds.spawn(1)[0].state
    assert parent.spawn(1)[0].random() == generator.spawn(1)[0].random()


def test_the_generators_that_libraries_share_stay_theirs(tmp_path):
    shared = [random.random, np.random.mtrand._rand, th.default_generator]
    draw, numpy, torch = again(shared, tmp_path)
    assert draw.__self__ is random.random.__self__
    assert numpy is shared[1]
    assert torch is shared[2]


# --- objects, functions, references ---


class Forgetful(Holder):
    """Says in `__getstate__` what a model file needs, which is not all."""

    def __getstate__(self):
        return {"name": "forgotten"}

    def __setstate__(self, state):
        raise AssertionError("nobody asks")


def test_objects_keep_what_they_would_leave_out_of_a_copy(tmp_path):
    class MadeAnew(gym.utils.EzPickle):
        position = 0

    thing, env = Forgetful(position=3), MadeAnew(4)
    env.position = 5
    found, other = again([thing, env], tmp_path)
    assert (found.position, other.position) == (3, 5)


def test_what_was_added_since_goes_and_what_no_state_keeps_stays_as_it_was_built(tmp_path):
    class Working(World):
        excluded_from_states = ("room",)

    found = gone_through(Working(a=1, room="old"), Working(a=0, room="new", more=2), tmp_path)
    assert vars(found) == {"a": 1, "room": "new"}


def test_environments_that_functions_hold_are_the_same_objects(tmp_path):
    inner, other = World(position=3), World(position=0)
    found = gone_through(World(envs=[inner]), World(envs=[other]), tmp_path)
    assert found.envs[0] is other
    assert other.position == 3
    added = gone_through(World(envs=[inner]), World(envs=[]), tmp_path)
    assert added.envs[0].position == 3


def counting():
    count = 0

    def add():
        nonlocal count
        count += 1
        return count

    return [add, lambda: count]


def test_what_functions_have_closed_over_is_shared_again(tmp_path):
    add, _ = held = counting()
    add()
    add, read = again(held, tmp_path)
    assert add() == 2
    assert read() == 2


SEEN = "now"


def test_functions_see_the_names_of_their_module_and_themselves(tmp_path, monkeypatch):
    def factorial(n):
        return 1 if n < 2 else n * factorial(n - 1)

    found, again_factorial = again([lambda: SEEN, factorial], tmp_path)
    monkeypatch.setitem(globals(), "SEEN", "later")
    assert found() == "later"
    assert again_factorial(5) == 120


def test_a_method_that_was_put_in_place_of_another(tmp_path):
    original = World()
    original.now = Holder.two.__get__(original)
    found = gone_through(original, other := World(), tmp_path)
    assert found.now() == 2
    assert found.now.__self__ is other


def test_weak_references_locks_events_and_files_in_memory(tmp_path):
    thing, event, file = Holder(name="a"), threading.Event(), io.StringIO("abc")
    event.set()
    file.read(1)
    held = [thing, weakref.ref(thing), weakref.WeakKeyDictionary({thing: 1}), threading.Lock()]
    held += [weakref.ref(Holder()), event, file]
    found, reference, known, lock, dead, event, file = again(held, tmp_path)
    assert reference() is found
    assert known[found] == 1
    assert lock.acquire(blocking=False)
    assert dead() is None
    assert event.is_set()
    assert file.read() == "bc"


def test_caches_that_are_lost_are_named():
    @functools.lru_cache
    def double(x):
        return 2 * x

    assert pickled({"it": Holder(cache=double)}).lost == []
    double(1)
    assert pickled({"it": Holder(cache=double)}).lost == ["the cache of it.cache"]


# --- folders that were moved ---


def test_texts_and_paths_follow_a_folder_that_was_moved(tmp_path):
    original = Holder(held=["/a/b", "/a/b/c", "/a/bc", Path("/a/b/d"), "x" * 300, ("/a/b",)])
    found = gone_through(original, Holder(), tmp_path, {"/a/b": "/z"})
    assert found.held == ["/z", "/z/c", "/a/bc", Path("/z/d"), "x" * 300, ("/z",)]


# --- what belongs to the process, and what lies outside of it ---


def test_files_and_threads_are_those_of_the_new_training(tmp_path):
    with (tmp_path / "a").open("w") as file, (tmp_path / "b").open("w") as other:
        held = Holder(files=[file], thread=threading.current_thread())
        built = Holder(files=[other], thread=threading.current_thread())
        found = gone_through(held, built, tmp_path)
        assert found.files == [other]
        assert found.thread is built.thread


def test_what_the_new_training_has_not_is_missed_by_its_place(tmp_path):
    with (tmp_path / "a").open("w") as file:
        wanted = r"^_io\.TextIOWrapper is missing in it\.held\[1\]$"
        with pytest.raises(NotFittingError, match=wanted):
            gone_through(Holder(held=[1, file]), Holder(held=[1]), tmp_path)
    original, other = World(inner=World(a=1)), World(inner=Everything(1))
    with pytest.raises(NotFittingError, match=r"^World is missing in it\.inner$"):
        gone_through(original, other, tmp_path)


@pytest.mark.parametrize(
    "make",
    [
        lambda: csv.reader(["a", "b"]),
        tempfile.TemporaryDirectory,
        lambda: subprocess.Popen([sys.executable, "-c", ""]),
        random.SystemRandom,
        lambda: (i for i in range(3)),
        lambda: memoryview(b"a"),
        lambda: th.zeros(2).to_sparse(),
        lambda: Path(__file__).open(),  # noqa: SIM115
    ],
    ids=["rows", "folder", "process", "entropy", "generator", "memory", "sparse", "file"],
)
def test_what_cannot_be_kept_is_refused_by_its_place(make):
    value = make()
    with pytest.raises(NotKeepableError, match=r"^it\.held\[0\]: "):
        pickled({"it": Holder(held=[value])})
    for end in ("wait", "cleanup", "close"):
        if not isinstance(value, types.GeneratorType):
            getattr(value, end, lambda: None)()


def test_errors_of_objects_are_told_by_their_place_and_long_chains_are_refused():
    class Odd:
        @property
        def __dict__(self):
            raise ZeroDivisionError("odd")

    with pytest.raises(NotKeepableError, match=r"^it\.held: ZeroDivisionError: odd$"):
        pickled({"it": Holder(held=Odd())})
    chain = None
    for _ in range(50_000):
        chain = [chain]
    with pytest.raises(NotKeepableError, match="too deep"):
        pickled({"it": chain})


# --- replay buffers ---


GOALS = {"replay_buffer_class": HerReplayBuffer}
SPARING = {
    "optimize_memory_usage": True,
    "replay_buffer_kwargs": {"handle_timeout_termination": False},
}


@pytest.mark.parametrize(
    ("policy", "settings"), [("MultiInputPolicy", GOALS), ("MlpPolicy", SPARING)]
)
@pytest.mark.parametrize("n_steps", [30, 150], ids=["partly full", "round once"])
def test_replay_buffers_of_goals_and_those_that_spare_memory(tmp_path, policy, settings, n_steps):
    def make():
        env = BitFlippingEnv(n_bits=4, max_steps=4) if settings is GOALS else "CartPole-v1"
        common = {"learning_starts": 20, "buffer_size": 100, "seed": 1, "device": "cpu"}
        return DQN(policy, env, **common, policy_kwargs={"net_arch": [8]}, **settings)

    original, built = make().learn(n_steps), make()
    found = gone_through(original, built, tmp_path)
    assert found is built
    if settings is GOALS:
        assert found.env is found.replay_buffer.env
    weights = []
    for model in (original, found):
        set_random_seed(2)
        model.learn(100, reset_num_timesteps=False)
        weights.append([p.tolist() for p in model.policy.parameters()])
    assert weights[0] == weights[1]
