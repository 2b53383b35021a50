"""A file is there whole, or as it was before."""

import json
import threading

import pytest

from pipeline import files
from pipeline.files import replacing, write_json, write_text


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_made_and_replaced(tmp_path):
    path = tmp_path / "notes.txt"
    for text in ("first", "zweiter ± 1"):
        write_text(path, text)
        assert path.read_text(encoding="utf-8") == text
        assert names(tmp_path) == ["notes.txt"]


def test_json_comes_back(tmp_path):
    data = {"returns": [1.5, None], "name": "ä"}
    write_json(tmp_path / "run.json", data)
    assert json.loads((tmp_path / "run.json").read_text(encoding="utf-8")) == data


def test_the_draft_lies_beside_and_the_old_file_stays_until_the_end(tmp_path):
    path = tmp_path / "model.zip"
    path.write_text("old")
    with replacing(path) as draft:
        draft.write_text("new")
        # Only a file of the same folder can be renamed into place in one step.
        assert draft.parent == path.parent
        assert draft.name.startswith(".")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert names(tmp_path) == ["model.zip"]


@pytest.mark.parametrize("error", [OSError, ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("old", ["old", None])
def test_a_writer_that_fails_changes_nothing(tmp_path, error, old):
    path = tmp_path / "model.zip"
    if old is not None:
        path.write_text(old)
    with pytest.raises(error), replacing(path) as draft:  # noqa: PT012  # half of it is the point
        draft.write_text("half")
        raise error
    assert names(tmp_path) == ([] if old is None else ["model.zip"])
    assert old is None or path.read_text() == old


def test_a_disk_that_fails_changes_nothing(tmp_path, monkeypatch):
    path = tmp_path / "model.zip"
    path.write_text("old")

    def no_space(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", no_space)
    with pytest.raises(OSError, match="No space left"):
        write_text(path, "new")
    assert path.read_text() == "old"
    assert names(tmp_path) == ["model.zip"]


def test_what_cannot_be_json_leaves_the_old_file(tmp_path):
    path = tmp_path / "run.json"
    write_json(path, {"state": "running"})
    with pytest.raises(TypeError):
        write_json(path, {"state": object()})
    assert json.loads(path.read_text()) == {"state": "running"}
    assert names(tmp_path) == ["run.json"]


def test_a_writer_that_writes_nothing_is_an_error(tmp_path):
    path = tmp_path / "model.zip"
    path.write_text("old")
    with pytest.raises(FileNotFoundError), replacing(path):
        pass
    assert path.read_text() == "old"


def test_a_reader_never_meets_a_half_written_file(tmp_path):
    path = tmp_path / "evaluations"
    texts = ["a" * 200_000, "b" * 200_000]
    write_text(path, texts[0])
    met = set()
    done = threading.Event()

    def read():
        while not done.is_set():
            met.add(path.read_text(encoding="utf-8"))

    reader = threading.Thread(target=read)
    reader.start()
    for i in range(100):
        write_text(path, texts[i % 2])
    done.set()
    reader.join()
    assert met <= set(texts)
    assert met
