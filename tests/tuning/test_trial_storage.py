"""Where trials are kept, as --storage says it."""

import pytest

from pipeline.errors import UserError
from tuning.trial_storage import kind_of, open_storage, without_secret


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
