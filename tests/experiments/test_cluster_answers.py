"""What a worker may answer, and what is refused before anything of it is written."""

import hashlib
import json
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.cluster import answers
from experiments.cluster.answers import Answer, RefusedAnswerError, files_in, packed, unpacked

FILES = {"run/run.json": b"{}", "run/a/b.zip": b"\0\1", "tensorboard/x": b""}


def raw(files, contents, **changes):
    head = {"kind": "done", "reason": "", "details": "", "files": files, **changes}
    text = json.dumps(head).encode()
    return struct.pack(">Q", len(text)) + text + contents


def entry(name, data):
    return [name, len(data), hashlib.sha256(data).hexdigest()]


@pytest.mark.parametrize(
    "answer",
    [
        Answer("done"),
        Answer("done", files={}),
        Answer("done", files=FILES),
        Answer("failed", "thin ice", "Traceback"),
        Answer("stopped"),
    ],
)
def test_what_is_packed_is_unpacked(answer):
    assert unpacked(packed(answer)) == answer


@given(st.binary(max_size=200))
def test_bytes_are_an_answer_or_refused(content):
    with pytest.raises(RefusedAnswerError):
        unpacked(content)


@given(st.data())
def test_a_bit_that_is_turned_is_noticed(data):
    content = bytearray(packed(Answer("done", files=FILES)))
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= 1 << data.draw(st.integers(0, 7))
    try:
        found = unpacked(bytes(content))
    except RefusedAnswerError:
        return
    # In the head, other words may be right by themselves: contents are not.
    assert sorted((found.files or {}).values()) in ([], sorted(FILES.values()))


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "run/../../x",
        "run/..",
        "run//x",
        "run/./x",
        "run/x/",
        "x",
        "",
        "run/a\\b",
        "run/a\0b",
        "run/a\nb",
        "run/c:x",
        "run/nul",
        "run/x.",
        "run/" + "d/" * 9 + "x",
        "run/" + "x" * 300,
    ],
)
def test_names_that_lead_elsewhere_are_refused(name):
    with pytest.raises(RefusedAnswerError):
        unpacked(raw([entry(name, b"x")], b"x"))


@pytest.mark.parametrize(
    ("files", "contents", "words"),
    [
        ([entry("run/x", b"y")], b"x", "digest"),
        ([entry("run/x", b"xx")], b"x", "digest"),
        ([["run/x", -1, ""]], b"", "something else"),
        ([["run/x", True, ""]], b"x", "something else"),
        ([["run/x", 1]], b"x", "something else"),
        ({}, b"", "no files"),
        ([entry("run/x", b"x")], b"xy", "follows"),
        ([entry("run/x", b"x"), entry("run/X", b"x")], b"xx", "twice"),
        ([entry("run/x", b"x"), entry("run/X/y", b"x")], b"xx", "folder too"),
    ],
)
def test_lies_about_files_are_refused(files, contents, words):
    with pytest.raises(RefusedAnswerError, match=words):
        unpacked(raw(files, contents))


@pytest.mark.parametrize(
    "changes", [{"kind": "fine"}, {"reason": 3}, {"details": None}, {"reason": "x" * 300_000}]
)
def test_heads_that_say_something_else_are_refused(changes):
    with pytest.raises(RefusedAnswerError):
        unpacked(raw(None, b"", **changes))


@pytest.mark.parametrize(
    "content", [None, "text", {"kind": "done"}, bytearray(packed(Answer("done")))]
)
def test_what_is_no_bytes_is_refused(content):
    with pytest.raises(RefusedAnswerError, match="not bytes"):
        unpacked(content)


def test_there_are_bounds_on_what_is_sent_and_taken(tmp_path, monkeypatch):
    (tmp_path / "x").write_bytes(bytes(100))
    (tmp_path / "link").symlink_to("/etc/passwd")
    assert files_in(tmp_path, "run/") == {"run/x": bytes(100)}
    content = packed(Answer("done", files={"run/x": bytes(100)}))
    monkeypatch.setattr(answers, "LARGEST", 99)
    with pytest.raises(ValueError, match="let it share"):
        files_in(tmp_path, "run/")
    with pytest.raises(RefusedAnswerError, match="too large"):
        unpacked(content)
