"""A state is unpickled only if this user signed it: a table of what others may put in its place."""

import hashlib
import hmac
import io
import json
import os
import pickle

import numpy as np
import pytest

from pipeline import state_files
from pipeline.errors import UserError
from pipeline.state_files import (
    MAGIC,
    BadStateError,
    newest_state,
    read_state,
    save_state,
    user_key,
    write_state,
)
from pipeline.states import Pickled, pickled

KEY = b"k" * 32


class RunsCode:
    """Says so when it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("it was unpickled",))


def written(value, key=KEY, **note):
    file = io.BytesIO()
    file.fileno = lambda: 0
    with pytest.MonkeyPatch.context() as context:
        context.setattr(os, "fsync", lambda _: None)
        write_state(file, pickled({"it": value}), note, key)
    return file.getvalue()


def read(folder, content, key=KEY):
    (folder / "file").write_bytes(content)
    with (folder / "file").open("rb") as file:
        return read_state(file, key)


@pytest.fixture
def home(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path / "config"


@pytest.fixture(autouse=True)
def no_pickle_is_loaded(monkeypatch):
    """Reading and checking a file is not loading it."""
    monkeypatch.setattr(pickle, "Unpickler", lambda *_, **__: pytest.fail("it was unpickled"))
    monkeypatch.setattr(pickle, "loads", lambda *_, **__: pytest.fail("it was unpickled"))
    monkeypatch.setattr(pickle, "load", lambda *_, **__: pytest.fail("it was unpickled"))


def test_every_flipped_bit_is_noticed(tmp_path):
    content = bytearray(written([np.arange(1, 3), "a"]))
    for place in range(len(content)):
        content[place] ^= 1
        with pytest.raises(BadStateError):
            read(tmp_path, content)
        content[place] ^= 1
    assert read(tmp_path, content).note == {}


def test_every_truncation_and_every_appendix_is_noticed(tmp_path):
    content = written([np.arange(1, 3), "a"])
    for length in range(len(content)):
        with pytest.raises(BadStateError):
            read(tmp_path, content[:length])
    with pytest.raises(BadStateError, match="goes on after its end"):
        read(tmp_path, content + b"\0")


def test_a_header_that_promises_gigabytes_takes_none(tmp_path):
    with pytest.raises(BadStateError):
        read(tmp_path, MAGIC + bytes(32) + b"\xff" * 8 + b"{}")


def test_another_key_is_refused_before_anything_is_parsed(tmp_path, monkeypatch):
    content = written(1)
    monkeypatch.setattr(json, "loads", lambda *_: pytest.fail("it was parsed"))
    with pytest.raises(BadStateError, match="another user or machine made it"):
        read(tmp_path, content, b"x" * 32)


def strangers(content):
    """What somebody may put there who has no key, and knows a state of this user's."""
    evil = pickle.dumps(RunsCode())
    (length,) = np.frombuffer(content[48:56], "<u8")
    header = json.loads(content[56 : 56 + length])
    header["parts"] = [[len(evil), hashlib.sha256(evil).hexdigest(), len(evil), False]]
    text = json.dumps(header).encode()
    size = len(text).to_bytes(8, "little")
    by_no_key = hmac.digest(b"", MAGIC + size + text, "sha256")
    return {
        "a bare pickle": evil,
        "a pickle after the magic": MAGIC + evil,
        "a header signed with no key": MAGIC + by_no_key + size + text + evil,
        "a header signed with a key of theirs": written(RunsCode(), b"s" * 32),
        "a header under an old signature": content[:48] + size + text + evil,
        "another pickle under an old header": content[: 56 + int(length)] + evil,
        "another pickle before the old one": content[: 56 + int(length)] + evil + content[-9:],
        "the header of another state": written([2])[: 56 + int(length)]
        + content[56 + int(length) :],
        "a format of before": b"snapshot 3\n".ljust(16, b"\0") + content[16:],
        "nothing": b"",
    }


@pytest.mark.parametrize("attack", strangers(written([1])))
def test_a_strangers_file_is_refused_and_never_unpickled(tmp_path, home, attack):
    own = user_key(state_files.APPLICATION)
    folder = tmp_path / "state"
    folder.mkdir()
    (folder / "odd.state").write_bytes(strangers(written([1], own))[attack])
    with pytest.raises(UserError, match=r"odd\.state: it is .*; remove .* to begin the run again$"):
        newest_state(folder, pytest.fail)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda key: key.chmod(0o644), "mode 600"),
        (lambda key: key.chmod(0o660), "mode 600"),
        (lambda key: key.write_bytes(b"short"), "damaged"),
        (lambda key: (key.unlink(), os.mkfifo(key, 0o600)), "no regular file"),
        (lambda key: (key.unlink(), key.mkdir()), "no regular file"),
        (lambda key: (key.unlink(), key.symlink_to("/dev/null")), "no regular file"),
        (lambda key: (key.unlink(), key.symlink_to(key.with_name("gone"))), "No such file"),
        (lambda key: key.unlink(), "the key was replaced"),
    ],
    ids=["readable", "of a group", "short", "pipe", "folder", "device", "nowhere", "missing"],
)
def test_without_the_users_own_key_nothing_is_read(tmp_path, home, change, said):
    save_state(tmp_path / "state", 1, pickled({"it": 1}), {})
    change(home / "yardstick" / "snapshots.key")
    with pytest.raises(UserError, match=said):
        newest_state(tmp_path / "state", pytest.fail)


def test_a_pipe_in_the_place_of_a_state_is_not_waited_for(tmp_path, home):
    os.mkfifo(tmp_path / "odd.state")
    assert newest_state(tmp_path, pytest.fail) is None


def test_the_newest_of_two_counts_and_the_older_where_that_is_damaged(tmp_path, home):
    for number in (7, 8, 9):
        save_state(tmp_path, number, pickled({"it": number}), {})
    assert newest_state(tmp_path, pytest.fail).note["number"] == 9
    with (tmp_path / "odd.state").open("ab") as file:
        file.write(b"\0")
    told = []
    assert newest_state(tmp_path, told.append).note["number"] == 8
    assert len(told) == 1
    assert told[0].endswith("the state before it is taken")


def test_functions_of_another_python_are_refused_and_all_else_is_not(tmp_path, home, monkeypatch):
    for number, value in enumerate([lambda: 1, 1]):
        save_state(tmp_path / str(number), 1, pickled({"it": value}), {})
    monkeypatch.setattr("sys.implementation.cache_tag", "cpython-399")
    with pytest.raises(UserError, match=r"were compiled by cpython-3.*, another Python"):
        newest_state(tmp_path / "0", pytest.fail)
    assert newest_state(tmp_path / "1", pytest.fail) is not None


def test_without_room_on_the_disk_the_last_state_stays(tmp_path, home, monkeypatch):
    save_state(tmp_path, 1, pickled({"it": 1}), {})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(state_files, "write_state", full)
    with pytest.raises(OSError, match="No space"):
        save_state(tmp_path, 3, Pickled(b"", (), ()), {})
    assert newest_state(tmp_path, pytest.fail).note["number"] == 1


def test_the_note_is_there_before_anything_is_unpickled(tmp_path):
    assert read(tmp_path, written(1, spec="abc")).note == {"spec": "abc"}


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")
def test_a_link_to_a_state_elsewhere_is_judged_by_its_content(tmp_path, home):
    save_state(tmp_path / "mine", 1, pickled({"it": 1}), {})
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "odd.state").symlink_to(tmp_path / "mine" / "odd.state")
    assert newest_state(tmp_path / "other", pytest.fail).note["number"] == 1
