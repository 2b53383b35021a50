"""Where trials are kept, as --storage says it."""

import json
import sys

import pytest

from pipeline.errors import UserError
from tuning import trial_storage
from tuning.trial_storage import failing_in_a_line, kind_of, open_storage, without_secret


@pytest.mark.parametrize(
    ("given", "kind"),
    [
        ("trials.log", "journal"),
        ("journal:a/trials.log", "journal"),
        ("sqlite:///x.db", "database"),
        ("postgresql+psycopg://u@h/db", "database"),
        ("grpc://head:13000", "proxy"),
    ],
)
def test_the_kinds(given, kind):
    assert kind_of(given) == kind


def test_what_is_no_storage_is_refused_without_its_password():
    with pytest.raises(UserError, match=r"'redis://u:\*\*\*@h' is no storage: a file for a "):
        kind_of("redis://u:secret@h")


def test_a_database_that_cannot_be_reached_is_refused_without_its_password():
    with pytest.raises(UserError) as error:
        open_storage(None, "postgresql://u:secret@127.0.0.1:1/db")
    assert "secret" not in str(error.value)
    assert "postgresql://u:***@127.0.0.1:1/db" in str(error.value)


@pytest.mark.parametrize("text", ["tune.py --storage postgresql://u:se%40cret@h/db -j 2", "no://x"])
def test_passwords_are_left_out_of_commands(text):
    assert without_secret(text) == text.replace("se%40cret", "***")


def test_a_folder_of_any_name_keeps_its_own_file(tmp_path):
    root = tmp_path / "a {b} %20 c?d"
    root.mkdir()
    storage = open_storage(root, None)
    storage.create_new_study([1], "s")
    assert (root / "trials.db").stat().st_size


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ("journal:", r"journal:FILE: \. is no file"),
        ("notes.txt", r"notes\.txt: is there already, and no journal of trials"),
        ("cut.log", r"cut\.log: its last line is cut off: remove that line"),
        ("sqlite://", "names no file"),
        ("sqlite:///:memory:", "names no file"),
        ("postgresql://h:port/db", "cannot be opened: invalid literal"),
        ("grpc://127.0.0.1:99999", "there is no proxy: Port out of range"),
        ("grpc://127.0.0.1:1", "there is no proxy: "),
        ("grpc://:1", "which machine"),
    ],
)
def test_storages_that_are_none_are_refused_in_a_line(tmp_path, monkeypatch, given, complaint):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trial_storage, "SECONDS_TO_CONNECT", 0.2)
    monkeypatch.setattr(trial_storage, "_SECONDS_BETWEEN_TRIES", 0.0)
    files = {"notes.txt": "hello\n", "cut.log": '{"op_code":0}\n{"op'}
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    with pytest.raises(UserError, match=complaint) as error:
        open_storage(tmp_path, given)
    assert "\n" not in str(error.value)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == files


def test_a_database_without_its_package_says_which(monkeypatch):
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(UserError, match="it needs the package of psycopg: install that"):
        open_storage(None, "postgresql://u@h/db")


def test_a_storage_that_goes_while_it_is_used_is_one_line(tmp_path):
    storage = open_storage(tmp_path, None)
    (tmp_path / "trials.db").write_bytes(b"no database any more")
    expected = r"^trials\.db: .*; what is done stays, and the same"
    with pytest.raises(UserError, match=expected), failing_in_a_line(None):
        storage.create_new_study([1], "s")
    with pytest.raises(UserError, match=r"^trials\.db is damaged: "), failing_in_a_line(None):
        json.loads("[1")
    with pytest.raises(KeyError), failing_in_a_line(None):  # not the storage's
        raise KeyError("x")
