"""The user's key: one for all processes, and for nobody else."""

import os
import stat
from concurrent.futures import ThreadPoolExecutor

import pytest

from pipeline.state_files import user_key


@pytest.fixture(autouse=True)
def home(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path / "config"


def test_it_stays(home):
    key = user_key("a")
    assert len(key) == 32
    assert user_key("a") == key
    assert user_key("b") != key
    assert stat.S_IMODE((home / "a" / "snapshots.key").stat().st_mode) == 0o600
    assert [path.name for path in (home / "a").iterdir()] == ["snapshots.key"]


def test_processes_that_make_it_at_once_get_the_same():
    with ThreadPoolExecutor(16) as pool:
        assert len(set(pool.map(lambda _: user_key("a"), range(64)))) == 1


def test_one_that_others_may_read_is_refused(home):
    user_key("a")
    (home / "a" / "snapshots.key").chmod(0o644)
    with pytest.raises(OSError, match="mode 600"):
        user_key("a")


def test_a_damaged_one_is_refused(home):
    user_key("a")
    (home / "a" / "snapshots.key").write_bytes(b"short")
    with pytest.raises(OSError, match="damaged"):
        user_key("a")


@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_what_is_no_file_is_refused_at_once(home, kind):
    """A pipe would be waited for, and a device has no end."""
    path = home / "a" / "snapshots.key"
    path.parent.mkdir(parents=True)
    if kind == "pipe":
        os.mkfifo(path, 0o600)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/null")
    with pytest.raises(OSError, match="no regular file"):
        user_key("a")


def test_a_link_to_a_key_is_followed_and_one_to_nowhere_makes_none(home):
    key, path = user_key("a"), home / "a" / "snapshots.key"
    elsewhere = path.rename(home / "elsewhere")
    path.symlink_to(elsewhere)
    assert user_key("a") == key
    elsewhere.unlink()
    with pytest.raises(FileNotFoundError):
        user_key("a")
    assert list(path.parent.iterdir()) == [path]
