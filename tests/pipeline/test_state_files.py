"""What a state keeps of objects, that only this user's are unpickled, and when it is saved."""

import collections
import dataclasses
import datetime
import decimal
import enum
import gc
import hashlib
import hmac
import io
import json
import logging
import os
import pickle
import random
import re
import stat
import sys
import threading
import types
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import Logger

from rl_yardstick.agents import load_algorithm
from rl_yardstick.pipeline import state_files, state_saver
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.runs import Run
from rl_yardstick.pipeline.state_files import read_state, write_state
from rl_yardstick.pipeline.state_saver import StateSaver, put_back, user_state
from rl_yardstick.pipeline.states import NotKeepableError, pickled, unpickled
from rl_yardstick.pipeline.unfinished_runs import SaveInterval, StateKeeping
from rl_yardstick.pipeline.user_modules import import_typed

KEY = b"k" * 32


class Holder:
    """Anything, by name."""

    def __init__(self, **held):
        vars(self).update(held)

    def two(self):
        return 2


class World(gym.Env):
    """Of those objects that are filled in, as functions that are running hold them."""

    def __init__(self, **held):
        vars(self).update(held)


class Side(enum.Flag):
    LEFT = 1
    RIGHT = 2


class Point(NamedTuple):
    x: int
    y: list


@dataclasses.dataclass(frozen=True)
class Frozen:
    values: list


class Forgetful(Holder):
    """Says in `__getstate__` what a model file needs, which is not all."""

    def __getstate__(self):
        return {"name": "forgotten"}

    def __setstate__(self, state):
        raise AssertionError("nobody asks")


def counting():
    count = 1

    def add():
        nonlocal count
        count += 1
        return count

    return [add, lambda: count]


class Everything(gym.Env):
    """One of each kind, a way to change them all, and what is to be seen of each."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.other_rng = np.random.Generator(self.rng.bit_generator)
        self.old_rng = np.random.RandomState(seed)
        self.python_rng = random.Random(seed)  # noqa: S311
        self.torch_rng = th.Generator().manual_seed(seed)
        self.draws = [random.Random(1).random, np.random.default_rng(1).random]  # noqa: S311
        self.scalars = [1, -0.0, float("nan"), float("-inf"), "a", None, True, 2**100, 1 + 2j]
        self.tuple = (1, [2], Point(3, [4]))
        self.dict = {"a": np.arange(3.0), (1, "b"): {4, 5}, Side.LEFT: Side.RIGHT}
        self.queue = collections.deque([1, 2], maxlen=4)
        self.counts = collections.defaultdict(float, a=1.0)
        self.net = th.nn.Sequential(th.nn.Linear(3, 4), th.nn.BatchNorm1d(4))
        self.optimizer = th.optim.Adam(self.net.parameters())
        self.frozen_net = th.nn.Linear(2, 2)
        self.frozen_net.weight.requires_grad_(False)
        self.frozen = Frozen([seed])
        self.same = self.frozen.values
        self.cycle = self
        self.record = np.zeros(2, np.dtype([("a", np.int8), ("b", np.float64)], align=True))
        self.objects = np.array([{"a": 1}, None], dtype=object)
        self.rewards = [float(i) for i in range(1500)]
        self.space = gym.spaces.Box(0.0, 1.0, (2,), seed=seed)
        self.function, self.closures = (lambda: seed), counting()
        self.forgetful = Forgetful(position=3)
        self.reference, self.dead = weakref.ref(self.forgetful), weakref.ref(Holder())
        self.lock, self.event = threading.Lock(), threading.Event()
        self.event.set()
        # A row of a table, and one that cannot be written; tensors and arrays of one memory.
        self.table = np.arange(6).reshape(3, 2)
        self.row, self.back = self.table[2], self.table[::-1, 1]
        self.back.flags.writeable = False
        self.tensor = th.zeros(4)
        self.seen, self.rest = self.tensor.numpy(), self.tensor[1:]
        # A sum runs through it in the order in which it lies in memory, and rounds accordingly.
        self.fortran = np.asfortranarray(np.arange(6.0).reshape(2, 3))

    def step(self):
        self.optimizer.zero_grad()
        (self.net(th.rand(5, 3, generator=self.torch_rng)) ** 2).mean().backward()
        self.optimizer.step()
        self.queue.append(self.rng.normal() + self.other_rng.random())
        self.scalars += [self.python_rng.random(), *(draw() for draw in self.draws)]
        self.scalars += [self.rng.spawn(1)[0].random(), self.closures[0]()]
        self.dict["new", len(self.dict)] = self.old_rng.rand(2)
        self.counts[str(len(self.counts))] += self.space.sample()[0]
        self.same.append(1)
        self.record["b"] += 1
        self.objects[0]["a"] += 1
        self.rewards.append(-1.0)
        self.tuple[2].y.append(self.rng.integers(5))
        self.row += 10
        self.tensor[1] += 5.0

    def figures(self):
        kept = {name: repr(vars(self)[name]) for name in PLAINLY_SHOWN.split()}
        return kept | {
            "weights": [p.tolist() for p in self.net.parameters()],
            "moments": [s["exp_avg_sq"].tolist() for s in self.optimizer.state.values()],
            "frozen": [p.requires_grad for p in self.frozen_net.parameters()],
            "memory": [self.fortran.strides, self.back.flags.writeable, self.row.flags.writeable],
            "functions": [self.closures[1](), self.function()],
            "references": [self.reference() is self.forgetful, self.dead()],
            "position": self.forgetful.position,
            "threads": [self.lock.locked(), self.event.is_set()],
            "the same": [self.same is self.frozen.values, self.cycle is self],
        }


PLAINLY_SHOWN = "scalars tuple dict queue counts same record objects rewards table row back tensor "
PLAINLY_SHOWN += "seen rest fortran"


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


def test_everything_goes_on_as_it_would_have_and_saving_changes_nothing(tmp_path):
    original, other = Everything(1), Everything(1)
    for _ in range(3):
        original.step()
    before = original.figures()
    first, second = (bytes(pickled({"it": original}).pickled) for _ in range(2))
    assert first == second
    assert original.figures() == before
    found = gone_through(original, other, tmp_path)
    assert found is other
    assert found.figures() == before
    for thing in (original, found):
        for _ in range(4):
            thing.step()
    assert found.figures() == original.figures() != before


VALUES = [
    *(Path("/a/b"), re.compile("a+", re.IGNORECASE), np.dtype("int16"), th.float64, th.strided),
    *(th.device("cpu"), th.Size([2, 3]), slice(1, None, 2), ..., decimal.Decimal("1.50")),
    datetime.datetime(2026, 11, 22, 7, 30, 0, 1, tzinfo=datetime.UTC),
    *(datetime.timedelta(3, 4, 5), logging.getLogger("a name"), np.mean, np.add, th.tanh),
    *(types.MappingProxyType({"a": 1}), collections.Counter("aab"), range(1, 9, 2)),
    *(collections.OrderedDict(b=1, a=2), Side.LEFT | Side.RIGHT, Side(0)),
]


def test_values(tmp_path):
    for value, found in zip(VALUES, again(VALUES, tmp_path), strict=True):
        assert (type(found), found) == (type(value), value)


SEEN = "now"


def test_functions_see_their_module_and_shared_generators_stay_shared(tmp_path, monkeypatch):
    shared = [random.random, np.random.mtrand._rand, th.default_generator]
    see, draw, numpy, torch = again([lambda: SEEN, *shared], tmp_path)
    monkeypatch.setitem(globals(), "SEEN", "later")
    assert see() == "later"
    assert draw.__self__ is random.random.__self__
    assert (numpy is shared[1], torch is shared[2]) == (True, True)


def test_an_environment_is_filled_in_and_not_made_anew(tmp_path):
    """What was added since goes; what no state keeps stays as it was built; methods go along."""

    class Working(World):
        excluded_from_states = ("room",)

    inner, other = World(position=3), World(position=0)
    original = Working(a=1, room="old", envs=[inner])
    original.now = Holder.two.__get__(original)
    built = Working(a=0, room="new", more=2, envs=[other])
    found = gone_through(original, built, tmp_path)
    assert found is built
    assert (found.a, found.room, hasattr(found, "more")) == (1, "new", False)
    assert found.envs[0] is other
    assert other.position == 3
    assert (found.now(), found.now.__self__ is found) == (2, True)
    added = gone_through(World(envs=[inner]), World(envs=[]), tmp_path)
    assert added.envs[0].position == 3


def test_texts_and_paths_follow_a_folder_that_was_moved(tmp_path):
    original = Holder(held=["/a/b", "/a/b/c", "/a/bc", Path("/a/b/d"), "x" * 300, ("/a/b",)])
    found = gone_through(original, Holder(), tmp_path, {"/a/b": "/z"})
    assert found.held == ["/z", "/z/c", "/a/bc", Path("/z/d"), "x" * 300, ("/z",)]
    buffer = np.zeros((1000, 100))
    buffer[2, 3] = 1.0  # the zeros at its end take no room
    assert np.array_equal(again(buffer, tmp_path), buffer)
    assert (tmp_path / "state").stat().st_size < 4000


# --- what belongs to the process, and what lies outside of it ------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        random.SystemRandom,
        lambda: (i for i in range(3)),
        lambda: Path(__file__).open(),  # noqa: SIM115
    ],
    ids=["entropy", "generator", "file"],
)
def test_what_cannot_be_kept_is_refused_by_its_place(make):
    value = make()
    with pytest.raises(NotKeepableError, match=r"^it\.held\[0\]: "):
        pickled({"it": Holder(held=[value])})
    getattr(value, "close", lambda: None)()


class RunsCode:
    """Says so when it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("it was unpickled",))


def written(value, key=KEY, **note):
    file = io.BytesIO()
    file.fileno = lambda: 0
    with pytest.MonkeyPatch.context() as context:
        context.setattr(os, "fsync", lambda _: None)  # which memory cannot do
        state_files.write_state(file, pickled({"it": value}), note, key)
    return file.getvalue()


def read(folder, content, key=KEY):
    (folder / "file").write_bytes(content)
    with (folder / "file").open("rb") as file:
        return state_files.read_state(file, key)


@pytest.fixture
def home(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path / "config"


@pytest.fixture
def no_pickle_is_loaded(monkeypatch):
    """Reading and checking a file is not loading it."""
    for name in ("Unpickler", "loads", "load"):
        monkeypatch.setattr(pickle, name, lambda *_, **__: pytest.fail("it was unpickled"))


@pytest.mark.usefixtures("no_pickle_is_loaded")
def test_every_flipped_bit_every_truncation_and_every_appendix_is_noticed(tmp_path):
    content = bytearray(written([np.arange(1, 3), "a"], spec="abc"))
    for place in range(len(content)):
        content[place] ^= 1
        with pytest.raises(state_files.BadStateError):
            read(tmp_path, content)
        content[place] ^= 1
        with pytest.raises(state_files.BadStateError):
            read(tmp_path, content[:place])
    with pytest.raises(state_files.BadStateError, match="bytes follow its end"):
        read(tmp_path, content + b"\0")
    assert read(tmp_path, content).note == {"spec": "abc"}  # without unpickling


@pytest.mark.usefixtures("no_pickle_is_loaded")
def test_another_key_is_refused_before_anything_is_parsed(tmp_path, monkeypatch):
    content = written(1)
    monkeypatch.setattr(json, "loads", lambda *_: pytest.fail("it was parsed"))
    with pytest.raises(state_files.BadStateError, match="another user or machine made it"):
        read(tmp_path, content, b"x" * 32)


def strangers(content):
    """What somebody may put there who has no key, and knows a state of this user's."""
    evil = pickle.dumps(RunsCode())
    (length,) = np.frombuffer(content[48:56], "<u8")
    head = content[: 56 + int(length)]
    header = json.loads(head[56:])
    header["parts"] = [[len(evil), hashlib.sha256(evil).hexdigest(), len(evil), False]]
    text = json.dumps(header).encode()
    text = len(text).to_bytes(8, "little") + text
    by_no_key = hmac.digest(b"", state_files.MAGIC + text, "sha256")
    return {
        "a header signed with no key": state_files.MAGIC + by_no_key + text + evil,
        "a header under an old signature": content[:48] + text + evil,
        "another pickle under an old header": head + evil,
        "nothing": b"",
    }


@pytest.mark.usefixtures("no_pickle_is_loaded", "home")
@pytest.mark.parametrize("attack", strangers(written([1])))
def test_a_strangers_file_is_refused_and_never_unpickled(tmp_path, attack):
    own = state_files.user_key(state_files.APPLICATION)
    folder = tmp_path / "state"
    folder.mkdir()
    (folder / "odd.state").write_bytes(strangers(written([1], own))[attack])
    with pytest.raises(UserError, match=r"odd\.state: it is .*; remove .* to begin the run again$"):
        state_files.newest_state(folder, pytest.fail)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda key: key.chmod(0o640), "mode 600"),
        (lambda key: key.write_bytes(b"short"), "damaged"),
        (lambda key: key.unlink(), "the key was replaced"),
    ],
    ids=["readable", "short", "missing"],
)
def test_without_the_users_own_key_nothing_is_read(tmp_path, home, change, said):
    state_files.save_state(tmp_path / "state", 1, pickled({"it": 1}), {})
    path = home / state_files.APPLICATION / "snapshots.key"
    change(path)
    with pytest.raises(UserError, match=said):
        state_files.newest_state(tmp_path / "state", pytest.fail)
    assert list(path.parent.iterdir()) == [path]


def test_a_key_is_one_for_all_processes_and_for_nobody_else(home):
    with ThreadPoolExecutor(16) as pool:
        (key,) = set(pool.map(lambda _: state_files.user_key("a"), range(64)))
    assert len(key) == 32
    assert state_files.user_key("b") != key
    path = home / "a" / "snapshots.key"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(path.parent.iterdir()) == [path]


def test_without_room_on_the_disk_the_last_state_stays(tmp_path, home, small_disk):
    state_files.save_state(tmp_path, 1, pickled({"it": 1}), {})
    noise = np.random.default_rng(0).bytes(100_000)
    with small_disk(10_000), pytest.raises(OSError, match="File too large"):
        state_files.save_state(tmp_path, 3, pickled({"it": noise}), {})
    assert state_files.newest_state(tmp_path, pytest.fail).note["number"] == 1


# --- how often -----------------------------------------------------------------------------------


def test_saving_by_time_takes_its_share(tmp_path, monkeypatch):
    """A state takes half a second here: the next is saved fifty times as long after it."""
    clock = [0.0]
    monkeypatch.setattr("rl_yardstick.pipeline.state_saver.time.monotonic", lambda: clock[0])
    model = load_algorithm("qlearning")("QTablePolicy", "FrozenLake-v1")
    model.set_logger(Logger(None, []))

    def write(*_):
        assert not gc.isenabled()  # a search through all that libraries hold takes longer
        clock[0] += 0.5

    monkeypatch.setattr(state_saver, "save_state", write)  # the disk
    run = Run.claim(tmp_path, "a", "X-v0")
    saver = StateSaver(run, StateKeeping(SaveInterval(0.0)), pytest.fail)
    saver.init_callback(model)
    begun = saver.saved_at
    for pause in (2.5, 25.0):
        assert saver.pause == pause
        clock[0] = begun + pause - 0.1
        assert not saver.wants_position()
        clock[0] = begun + pause + 0.1
        assert saver.wants_position()
        saver.save()
        begun = clock[0]
    assert gc.isenabled()


# --- files that are only appended to, and what the user's modules hold ---------------------------


SOURCE = """
import random

steps = 0
seen = []
rng = random.Random(1)

class Thing:
    made = 0

    def step(self):
        global steps
        steps += 1
        seen.append(rng.random())
        Thing.made += 1
"""


def test_globals_of_the_users_modules_go_back(tmp_path, monkeypatch):
    path = tmp_path / "things_with_globals.py"
    path.write_text(SOURCE)
    monkeypatch.setattr(sys, "path", [*sys.path])
    modules = import_typed([str(path)])
    module = sys.modules["things_with_globals"]
    thing = module.Thing()
    assert pickled({"it": user_state(modules)}).lost == []
    assert user_state(import_typed(["json"])) == {}  # what is installed is left alone
    thing.step()
    held = pickled({"it": user_state(modules)})
    saved = replace(
        held, pickled=bytes(held.pickled), memories=[memory.copy() for memory in held.memories]
    )
    thing.step()
    after = list(module.seen)
    put_back(modules, unpickled(saved, {"it": user_state(modules)})["it"])
    assert (module.steps, module.Thing.made) == (1, 1)
    assert module.seen == after[:1]
    thing.step()
    assert module.seen == after
    assert module.Thing is type(thing)
    del sys.modules["things_with_globals"]
