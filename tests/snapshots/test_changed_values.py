"""What has become another since it was built is that again, is refused, or is said to be lost."""

import csv
import datetime
import decimal
import functools
import logging
import random
import re
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from types import SimpleNamespace as Holder

import numpy as np
import pytest
import torch as th

from snapshots.filling import NotRestorableError
from snapshots.kinds import NotRecordableError
from snapshots.recording import record
from snapshots.restoring import restore
from snapshots.snapshot_files import read_snapshot, write_snapshot

KEY = b"k" * 32


def gone_through(was_built, became, folder):
    """What becomes of a value that another process had built, and this one has changed."""
    with (folder / "file").open("wb") as file:
        write_snapshot(file, record({"it": Holder(held=became)}), {}, KEY)
    other = Holder(held=was_built)
    with (folder / "file").open("rb") as file:
        restore(read_snapshot(file, KEY)[0], {"it": other})
    return other.held


@pytest.mark.parametrize(
    "value",
    [
        Path("/a/b"),
        re.compile("a+", re.IGNORECASE),
        np.dtype("int16"),
        th.float64,
        th.device("cpu"),
        th.Size([2, 3]),
        slice(1, None, 2),
        datetime.datetime(2026, 11, 22, 7, 30, 0, 1),
        datetime.datetime(2026, 11, 22, tzinfo=datetime.UTC),
        datetime.date(2026, 11, 22),
        datetime.timedelta(3, 4, 5),
        decimal.Decimal("1.50"),
        ...,
        logging.getLogger("a name"),
        np.mean,
    ],
)
@pytest.mark.parametrize("was_built", [None, Path("/c"), np.dtype("float32")])
def test_values_that_are_made_from_a_few_words(tmp_path, value, was_built):
    found = gone_through(was_built, value, tmp_path)
    assert type(found) is type(value)
    assert found == value


def test_seeds_go_on_spawning(tmp_path):
    seeds = np.random.SeedSequence(1)
    seeds.spawn(2)
    found = gone_through(np.random.SeedSequence(1), seeds, tmp_path)
    assert found.spawn(1)[0].state == seeds.spawn(1)[0].state


def test_paths_follow_a_folder_that_was_moved():
    other = Holder(held=None)
    restore(record({"it": Holder(held=Path("/a/b"))}), {"it": other}, {"/a": "/z"})
    assert other.held == Path("/z/b")


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
    found = gone_through(make(), draw, tmp_path)
    assert [found(*arguments) for _ in range(5)] == [draw(*arguments) for _ in range(5)]


@pytest.mark.parametrize("was_built", [np.zeros((2, 3)), None])
def test_arrays_lie_in_memory_as_they_did(tmp_path, was_built):
    """A sum runs through them in that order, and rounds accordingly."""
    columns = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    deep = np.arange(24.0).reshape(2, 3, 4).transpose(2, 0, 1)
    found = gone_through(was_built, columns, tmp_path)
    assert found.strides == columns.strides
    assert found.tolist() == columns.tolist()
    other = gone_through(None, deep.copy(order="K"), tmp_path)
    assert (other.strides, other.tolist()) == (deep.strides, deep.tolist())


def test_tensors_lie_in_memory_as_they_did(tmp_path):
    image = th.randn(2, 3, 4, 4).contiguous(memory_format=th.channels_last)
    found = gone_through(None, image, tmp_path)
    assert found.stride() == image.stride()
    assert found.equal(image)


def test_what_can_be_written_to_can_be_again(tmp_path):
    locked = np.arange(3.0)
    locked.flags.writeable = False
    gone_through(locked, np.arange(3.0), tmp_path)[0] = 5.0


@pytest.mark.parametrize("value", [th.zeros(0, 3), th.tensor([1 + 2j]).conj(), th.Size([])])
def test_odd_tensors(tmp_path, value):
    found = gone_through(None, value, tmp_path)
    assert found == value if isinstance(value, th.Size) else found.equal(value)


def test_what_was_frozen_stays_frozen(tmp_path):
    net = th.nn.Linear(2, 2)
    net.weight.requires_grad_(False)
    found = gone_through(th.nn.Linear(2, 2), net, tmp_path)
    assert [weights.requires_grad for weights in found.parameters()] == [False, True]
    assert isinstance(gone_through(None, net.bias, tmp_path), th.nn.Parameter)


def test_an_event_stays_set(tmp_path):
    event = threading.Event()
    event.set()
    assert gone_through(threading.Event(), event, tmp_path).is_set()


@pytest.mark.parametrize(
    "make",
    [
        lambda: csv.reader(["a", "b"]),
        tempfile.TemporaryDirectory,
        lambda: subprocess.Popen([sys.executable, "-c", ""]),
        random.SystemRandom,
    ],
    ids=["rows", "folder", "process", "entropy"],
)
def test_what_lies_outside_of_the_process_is_refused(make):
    value = make()
    with pytest.raises(NotRecordableError, match=r"^it\.held: "):
        record({"it": Holder(held=value)})
    for end in ("wait", "cleanup"):
        getattr(value, end, lambda: None)()


def test_a_file_that_was_opened_since_is_missed(tmp_path):
    with (
        (tmp_path / "written").open("w") as file,
        pytest.raises(NotRestorableError, match="TextIOWrapper is missing in held"),
    ):
        gone_through(None, file, tmp_path)


def test_errors_of_objects_are_told_by_their_place():
    class Odd:
        @property
        def __dict__(self):
            raise ZeroDivisionError("odd")

    with pytest.raises(NotRecordableError, match=r"it\.held: ZeroDivisionError: odd"):
        record({"it": Holder(held=Odd())})


def test_caches_and_orders_that_are_lost_are_named():
    @functools.lru_cache
    def double(x):
        return 2 * x

    numbers = {*range(60)}
    assert record({"it": Holder(cache=double, numbers=numbers)}).lost == []
    double(1)
    numbers -= {*range(50)}
    lost = record({"it": Holder(cache=double, numbers=numbers, texts={"a", "b"})}).lost
    assert lost == ["the cache of it.cache", "the order of it.numbers"]


def test_of_a_buffer_that_is_not_full_the_rest_takes_no_memory(tmp_path):
    """Told by a file in the place of memory, whose zeros take no room until they are written."""
    path = tmp_path / "memory"
    values, existing = np.zeros(10**6), np.memmap(path, np.float64, "w+", shape=10**6)
    values[:1000], values[5000] = 1.0, -0.0
    existing[2000:3000] = 2.0
    snapshot = record({"it": Holder(held=values)})
    restore(snapshot, {"it": Holder(held=existing)})
    existing.flush()
    assert existing.tobytes() == values.tobytes()
    if sys.platform == "linux":
        assert path.stat().st_blocks * 512 < values.nbytes / 2
    assert sum(array.nbytes for array in snapshot.arrays) == 0
