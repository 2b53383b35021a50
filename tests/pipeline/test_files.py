"""A file is there whole, or as it was before."""

import errno
import json
import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from pipeline import files
from pipeline.files import (
    json_text,
    naming,
    plain,
    portable_name,
    put_in_place,
    replacing,
    write_json,
    write_text,
)
from pipeline.locks import folder_lock


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_made_and_replaced(tmp_path):
    path = tmp_path / "notes.txt"
    for text in ("first", "zweiter ± 1"):
        write_text(path, text)
        assert path.read_text(encoding="utf-8") == text
    assert names(tmp_path) == ["notes.txt"]
    write_json(path, data := {"returns": [1.5, None], "name": "ä"})
    assert json.loads(path.read_text(encoding="utf-8")) == data
    with pytest.raises(TypeError):
        write_json(path, {"state": object()})
    assert json.loads(path.read_text(encoding="utf-8")) == data
    assert names(tmp_path) == ["notes.txt"]


def test_the_draft_lies_beside_and_the_old_file_stays_until_the_end(tmp_path):
    path = tmp_path / "model.zip"
    path.write_text("old")
    with replacing(path) as file:
        file.write(b"new")
        # Only a file of the same folder can be renamed into place in one step.
        draft, other = names(tmp_path)
        assert draft.startswith(".model.zip.")
        assert other == "model.zip"
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert names(tmp_path) == ["model.zip"]
    # Nobody can tell its name: a link there would lead what is written to another's file.
    with replacing(path), replacing(path):
        assert len({draft, *names(tmp_path)}) == 4


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
@pytest.mark.parametrize("old", ["old", None])
def test_a_writer_that_fails_changes_nothing(tmp_path, error, old):
    path = tmp_path / "model.zip"
    if old is not None:
        path.write_text(old)
    with pytest.raises(error), replacing(path) as file:  # noqa: PT012  # half of it is the point
        file.write(b"half")
        raise error
    assert names(tmp_path) == ([] if old is None else ["model.zip"])
    assert old is None or path.read_text() == old


def test_where_nothing_can_be_written_the_file_itself_is_named(tmp_path, monkeypatch):
    """Of its draft nobody knows, and a read-only disk refuses to remove that as well."""

    def refuse(path, *_, **__):
        raise OSError(30, "Read-only file system", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    monkeypatch.setattr(Path, "open", refuse)
    monkeypatch.setattr(os, "link", refuse)
    opened = os.open
    monkeypatch.setattr(
        os,
        "open",
        lambda path, flags, *r, **k: (refuse if flags & os.O_CREAT else opened)(
            path, flags, *r, **k
        ),
    )
    path = tmp_path / "model.zip"
    with pytest.raises(OSError, match="Read-only") as caught:
        write_text(path, "new")
    assert caught.value.filename == str(path)
    with pytest.raises(OSError, match="Read-only") as caught, folder_lock(tmp_path, list, list):
        pass
    assert caught.value.filename == str(tmp_path / ".lock")


def test_a_disk_that_fails_changes_nothing(tmp_path, monkeypatch):
    path = tmp_path / "model.zip"
    path.write_text("old")

    def no_space(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "replace", no_space)
    with pytest.raises(OSError, match="No space left") as caught:
        write_json(path, "new")
    assert caught.value.filename == str(path)
    assert path.read_text() == "old"
    assert names(tmp_path) == ["model.zip"]


def test_a_folder_that_cannot_be_flushed_is_passed_over_and_a_broken_disk_is_not(
    tmp_path, monkeypatch
):
    with pytest.raises(FileNotFoundError):
        files.sync(tmp_path / "missing", *[tmp_path] * 20)
    code = [errno.EINVAL]

    def fsync(_):
        raise OSError(code[0], "no")

    monkeypatch.setattr(os, "fsync", fsync)
    files.sync(tmp_path)
    code[0] = errno.EIO
    with pytest.raises(OSError, match="no"):
        files.sync(tmp_path)


def test_a_disk_that_is_full_is_named_and_another_error_is_left_alone(tmp_path):
    with pytest.raises(OSError, match="full") as caught, naming(tmp_path):
        raise OSError(errno.ENOSPC, "full")
    assert caught.value.filename == str(tmp_path)
    with pytest.raises(BrokenPipeError) as caught, naming(tmp_path):
        raise BrokenPipeError(errno.EPIPE, "gone")
    assert caught.value.filename is None


@pytest.fixture
def refusals(monkeypatch):
    """How often Windows still refuses to rename; and what was tried."""
    left, tried, replace = [0], [], os.replace

    def refusing(path, target, **folders):
        tried.append(target)
        if left[0]:
            left[0] -= 1
            raise PermissionError(errno.EACCES, "is being used by another process")
        return replace(path, target, **folders)

    monkeypatch.setattr(os, "replace", refusing)
    monkeypatch.setattr(files.time, "sleep", lambda seconds: None)
    return left, tried


@pytest.mark.parametrize(
    ("n", "platform", "tries"), [(0, "linux", 1), (0, "win32", 1), (3, "win32", 4)]
)
def test_what_a_scanner_holds_is_renamed_soon(tmp_path, monkeypatch, refusals, n, platform, tries):
    monkeypatch.setattr(sys, "platform", platform)
    left, tried = refusals
    left[0] = n
    (tmp_path / "draft").write_text("new")
    put_in_place(tmp_path / "draft", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "new"
    assert len(tried) == tries


@pytest.mark.parametrize(("platform", "n"), [("linux", 1), ("win32", 6)])
def test_what_stays_refused_is_an_error(tmp_path, monkeypatch, refusals, platform, n):
    monkeypatch.setattr(sys, "platform", platform)
    left, tried = refusals
    left[0] = 99
    with pytest.raises(PermissionError):
        put_in_place(tmp_path / "draft", tmp_path / "file")
    assert len(tried) == n


# --- names ---------------------------------------------------------------------------------------

DEVICES = {"CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$"}
DEVICES |= {f"{port}{digit}" for port in ("COM", "LPT") for digit in "0123456789¹²³"}
NAMES = st.text(st.characters(exclude_categories=["Cs"])) | st.sampled_from(
    [*DEVICES, "con", "Nul.txt", "aux .zip", "com1.a.b", "a.", "a ", ".", "..", "a:b", "a/b", "a?b"]
)


def is_acceptable(name):
    """The rules of Windows, which are the strictest, and Linux's for the length."""
    base = name.partition(".")[0].rstrip(" ").upper()
    return (
        0 < len(name.encode()) <= 255
        and not set(name) & {*'<>:"/\\|?*', *map(chr, range(32))}
        and not name.endswith((" ", "."))
        and base not in DEVICES
    )


@given(NAMES | st.text(min_size=100, max_size=400))
@example("COM¹.x")
def test_a_name_is_one_that_every_system_takes(name):
    portable = portable_name(name)
    assert is_acceptable(portable)
    assert portable_name(portable) == portable
    assert len(portable.encode()) <= 100
    if is_acceptable(name) and len(name.encode()) <= 100:
        assert portable == name


@given(NAMES, NAMES)
@example("CON", "con")
@example("a:", "a?")
@example("a.", "a")
@example("x" * 150, "x" * 151)
def test_two_names_stay_two(first, second):
    assume(first != second)
    a, b = portable_name(first), portable_name(second)
    # Names that a system takes as they are may differ in upper and lower case alone.
    assert a != b
    if (a, b) != (first, second):
        assert a.casefold() != b.casefold()


def test_a_folder_that_is_gone_is_not_made_anew(tmp_path):
    """Some libraries would do that in `write`, and leave a run in two places."""
    path = tmp_path / "gone" / "a.zip"
    with pytest.raises(FileNotFoundError, match="its folder is gone"), replacing(path) as draft:
        draft.parent.mkdir()
    assert not path.parent.exists()


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
