"""The user's key: one for all processes, and for nobody else."""

import stat
from concurrent.futures import ThreadPoolExecutor

import pytest

from snapshots.user_key import user_key


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
