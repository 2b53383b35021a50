"""State recorded of one object, and poured into another of the same build."""

import collections
import dataclasses
import enum
import functools
import json
import operator
import random
import threading
from array import array
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from snapshots.filling import NotRestorableError
from snapshots.kinds import NotRecordableError
from snapshots.recording import record
from snapshots.restoring import restore
from snapshots.snapshot_files import BadSnapshotError, read_snapshot, write_snapshot

KEY = b"k" * 32


class Colour(enum.Enum):
    RED = 1


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


class Holder:
    """Anything, under the name ``held``."""

    def __init__(self, held=None):
        self.held = held


class Everything:
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


def as_text(value):
    """All that a snapshot of an object says, with its arrays."""
    snapshot = record({"it": value})
    return json.dumps(snapshot.nodes), [a.tobytes() for a in snapshot.arrays]


def written(path, *args):
    with path.open("wb") as file:
        write_snapshot(file, *args)


def read_back(path, key):
    with path.open("rb") as file:
        return read_snapshot(file, key)


def through_file(snapshot, folder):
    written(folder / "file", snapshot, {"note": 1}, KEY)
    found, note = read_back(folder / "file", KEY)
    assert note == {"note": 1}
    return found


def test_everything_goes_on_as_it_would_have(tmp_path):
    original = Everything(1)
    for _ in range(3):
        original.step()
    snapshot = through_file(record({"it": original}), tmp_path)
    other = Everything(1)
    net, frozen = other.net, other.frozen
    restore(snapshot, {"it": other})
    assert as_text(other) == as_text(original)
    for thing in (original, other):
        for _ in range(4):
            thing.step()
    assert as_text(other) == as_text(original)
    assert other.net is net
    assert other.frozen is frozen
    assert other.same is other.frozen.values
    assert other.cycle is other
    assert other.slotted.read() == original.slotted.read()


def test_recording_changes_nothing():
    thing = Everything(1)
    before = as_text(thing)
    assert as_text(thing) == before


def test_two_objects_do_not_become_one():
    shared = [1]
    original, other = Holder(([1], [2])), Holder((shared, shared))
    restore(record({"it": original}), {"it": other})
    assert other.held == ([1], [2])
    assert other.held[0] is not other.held[1]


def test_one_object_does_not_become_two():
    shared = np.zeros(2)
    original, other = Holder([shared, shared]), Holder([np.ones(2), np.ones(2)])
    restore(record({"it": original}), {"it": other})
    assert other.held[0] is other.held[1]


def test_arrays_are_filled_in_place_so_that_views_follow():
    original, other = Holder(np.arange(4.0)), Holder(np.zeros(4))
    view = other.held[1:]
    restore(record({"it": original}), {"it": other})
    assert view.tolist() == [1, 2, 3]


def test_generators_seeded_otherwise_are_replaced():
    original, other = Holder(np.random.default_rng(1)), Holder(np.random.default_rng(2))
    restore(record({"it": original}), {"it": other})
    assert [g.random() for g in original.held.spawn(2)] == [g.random() for g in other.held.spawn(2)]
    assert original.held.random() == other.held.random()


def test_what_was_added_since_is_taken_away():
    original, other = Holder(1), Holder(1)
    other.more = 2
    restore(record({"it": original}), {"it": other})
    assert not hasattr(other, "more")


def test_moved_folders():
    original, other = Holder(["/a/b", "/a/b/c", "/a/bc"]), Holder([])
    restore(record({"it": original}), {"it": other}, {"/a/b": "/z"})
    assert other.held == ["/z", "/z/c", "/a/bc"]


@pytest.mark.parametrize(
    "value", [iter([1]), (i for i in range(3)), memoryview(b"a"), th.zeros(2).to_sparse()]
)
def test_what_cannot_be_kept_is_refused_by_its_place(value):
    with pytest.raises(NotRecordableError, match=r"^it\.held\[0\]: "):
        record({"it": Holder([value])})


def test_exceptions_hold_more_than_attributes():
    with pytest.raises(NotRecordableError, match=r"builtins\.ValueError"):
        record({"it": Holder(ValueError("a"))})


def test_locks_and_code_stay_as_they_were_built():
    original, other = Holder([threading.Lock(), len, Holder]), Holder([threading.Lock(), max, int])
    lock = other.held[0]
    restore(record({"it": original}), {"it": other})
    assert other.held == [lock, len, Holder]


def test_chains_that_are_too_long_are_refused():
    chain = None
    for _ in range(5000):
        chain = [chain]
    with pytest.raises(NotRecordableError, match="too deep"):
        record({"it": chain})


def test_no_class_is_imported_because_a_snapshot_asks():
    snapshot = record({"it": Holder(Holder())})
    for node in snapshot.nodes:
        if node["kind"] == "object":
            node["class"] = "antigravity:Holder"
    with pytest.raises(NotRestorableError, match="antigravity"):
        restore(snapshot, {"it": Holder(Holder())})


def test_another_build_is_refused():
    with pytest.raises(NotRestorableError):
        restore(record({"it": Holder(th.optim.SGD([th.ones(1)]))}), {"it": Holder()})


@given(hnp.arrays(hnp.scalar_dtypes(), hnp.array_shapes(min_dims=0, min_side=0)))
def test_any_array(tmp_path_factory, values):
    original, other = Holder(values), Holder()
    restore(through_file(record({"it": original}), tmp_path_factory.mktemp("a")), {"it": other})
    assert (other.held.dtype, other.held.shape) == (values.dtype, values.shape)
    assert other.held.tobytes() == values.tobytes()


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
        lambda inner: st.lists(inner) | st.tuples(inner) | st.dictionaries(st.text(), inner),
        max_leaves=20,
    )
)
def test_any_data(tmp_path_factory, data):
    other = Holder()
    snapshot = record({"it": Holder(data)})
    restore(through_file(snapshot, tmp_path_factory.mktemp("a")), {"it": other})
    assert repr(other.held) == repr(data)


@pytest.mark.parametrize("odd", [0.5, float("nan"), 3, 2**63, -(2**63), True, None, "a"])
@pytest.mark.parametrize("usual", [0.25, 7])
def test_long_lists(tmp_path, usual, odd):
    numbers, other = [usual] * 1500 + [odd], Holder([])
    restore(through_file(record({"it": Holder(numbers)}), tmp_path), {"it": other})
    assert [(type(n), repr(n)) for n in other.held] == [(type(n), repr(n)) for n in numbers]


def test_zeros_at_the_end_take_no_room(tmp_path):
    buffer = np.zeros((1000, 100))
    buffer[2, 3] = 1.0
    snapshot = through_file(record({"it": Holder(buffer)}), tmp_path)
    assert (tmp_path / "file").stat().st_size < 4000
    assert np.array_equal(snapshot.arrays[0], buffer)


def test_every_flipped_bit_is_noticed(tmp_path):
    written(tmp_path / "file", record({"it": Holder(np.arange(3))}), {}, KEY)
    content = bytearray((tmp_path / "file").read_bytes())
    for place in range(len(content)):
        content[place] ^= 1
        (tmp_path / "file").write_bytes(content)
        content[place] ^= 1
        with pytest.raises(BadSnapshotError):
            read_back(tmp_path / "file", KEY)


@pytest.mark.parametrize("share", range(0, 100, 7))
def test_every_truncation_is_noticed(tmp_path, share):
    written(tmp_path / "file", record({"it": Holder(np.arange(3))}), {}, KEY)
    content = (tmp_path / "file").read_bytes()
    (tmp_path / "file").write_bytes(content[: len(content) * share // 100])
    with pytest.raises(BadSnapshotError):
        read_back(tmp_path / "file", KEY)


def test_another_key_is_refused_before_anything_is_parsed(tmp_path, monkeypatch):
    written(tmp_path / "file", record({"it": Holder(1)}), {}, KEY)
    monkeypatch.setattr(json, "loads", lambda *_: pytest.fail("it was parsed"))
    with pytest.raises(BadSnapshotError, match="another user"):
        read_back(tmp_path / "file", b"x" * 32)
