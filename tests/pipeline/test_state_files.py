"""A state is unpickled only if this user signed it; when it is saved, and what lies beside it."""

import gc
import hashlib
import hmac
import io
import json
import os
import pickle
import stat
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from stable_baselines3.common.logger import Logger

from agents import load_algorithm
from pipeline import state_files, state_saver
from pipeline.errors import UserError
from pipeline.runs import Run
from pipeline.state_saver import StateSaver, put_back, user_state
from pipeline.states import pickled, unpickled
from pipeline.unfinished_runs import SaveInterval, StateKeeping
from pipeline.user_modules import import_typed

KEY = b"k" * 32


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
    monkeypatch.setattr("pipeline.state_saver.time.monotonic", lambda: clock[0])
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
