"""One driver at a time: who is let in, who is turned away, and what the dead leave behind."""

import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time

import pytest

from pipeline import locks
from pipeline.digests import LOCK
from pipeline.errors import UserError
from pipeline.locks import FolderInUseError, folder_lock

FOREIGN = {**locks.mark(), "host": "elsewhere", "machine": "other", "boot": "other"}
FOREIGN |= {"token": "t", "since": "2026-01-01 00:00:00"}


def never(*words):
    pytest.fail(f"{words} was not expected")


def lock(root, on_loss=never, say=never):
    return folder_lock(root, on_loss, say)


def leave_lock(root, owner, seconds=0.0):
    """A lock whose owner gave its last sign so long ago."""
    root.mkdir(exist_ok=True)
    path = root / LOCK
    path.write_text(owner if isinstance(owner, str) else json.dumps(owner))
    then = path.stat().st_mtime - seconds
    os.utime(path, (then, then))
    return path


def test_inside_nobody_else_is_let_in_and_afterwards_nothing_is_left(tmp_path):
    root = tmp_path / "logs" / "study"
    for _ in range(2):
        with lock(root):
            assert [path.name for path in root.iterdir()] == [LOCK]
            who = re.escape(f"{root}: process {os.getpid()} on {locks.mark()['host']} is at wor")
            with (
                pytest.raises(FolderInUseError, match=f"^{who}k on it since 20..-"),
                lock(root),
            ):
                never()
            assert [path.name for path in root.iterdir()] == [LOCK]
        assert list(tmp_path.iterdir()) == []


def test_what_came_into_the_folder_stays(tmp_path):
    with lock(tmp_path / "study"):
        (tmp_path / "study" / "summary.csv").touch()
    assert [path.name for path in (tmp_path / "study").iterdir()] == ["summary.csv"]


def test_it_is_let_go_when_the_work_fails(tmp_path):
    with pytest.raises(KeyboardInterrupt), lock(tmp_path):
        raise KeyboardInterrupt
    with lock(tmp_path):
        pass


def test_a_dead_process_holds_nothing(tmp_path):
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        pass
    leave_lock(tmp_path, {**locks.mark(), "pid": process.pid, "began": 1, "token": "t"})
    with lock(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("owner", [FOREIGN, "", "{", "[]", '{"pid": "x"}'])
def test_of_what_is_elsewhere_the_signs_of_life_count(tmp_path, owner):
    leave_lock(tmp_path, owner, seconds=61)
    with lock(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_one_elsewhere_that_shows_itself_is_at_work(tmp_path, monkeypatch):
    path = leave_lock(tmp_path, FOREIGN, seconds=50)
    monkeypatch.setattr(time, "sleep", lambda seconds: os.utime(path))
    said = []
    with (
        pytest.raises(FolderInUseError, match="on elsewhere is at work"),
        lock(tmp_path, say=said.append),
    ):
        never()
    (line,) = said
    assert line.startswith("waiting for a sign of life: ")
    assert [entry.name for entry in tmp_path.iterdir()] == [LOCK]


def test_one_elsewhere_that_stays_silent_is_gone(tmp_path, monkeypatch):
    path = leave_lock(tmp_path, FOREIGN)
    monkeypatch.setattr(locks, "SECONDS_OF_SILENCE", 0.05)
    with lock(tmp_path):
        assert json.loads(path.read_text())["token"] != FOREIGN["token"]


def test_of_many_at_once_one_gets_the_lock_of_the_dead(tmp_path):
    """Whoever removes the dead one's lock must not remove the next one's."""
    leave_lock(tmp_path, FOREIGN, seconds=61)
    inside, refused, begin = [], [], threading.Barrier(8)
    most = []

    def drive():
        begin.wait()
        try:
            with lock(tmp_path):
                inside.append(1)
                most.append(len(inside))
                time.sleep(0.05)
                inside.pop()
        except FolderInUseError:
            refused.append(1)

    threads = [threading.Thread(target=drive) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(most) == {1}
    assert len(most) + len(refused) == 8
    assert list(tmp_path.iterdir()) == []


def test_who_was_killed_while_removing_a_lock_is_in_nobodys_way(tmp_path, monkeypatch):
    path = leave_lock(tmp_path, FOREIGN, seconds=61)

    def be_killed(folder):
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(locks.Path, "unlink", lambda path, **options: be_killed(path))
        patch.setattr(locks.Path, "rmdir", be_killed)
        with pytest.raises(SystemExit):
            locks._remove_dead(path, FOREIGN)
    (grave,) = tmp_path.glob("*.dead.tmp")
    assert path.exists()
    then = grave.stat().st_mtime - 9
    os.utime(grave, (then, then))
    with lock(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_what_the_killed_have_half_written_is_removed(tmp_path):
    half = f".summary.csv.{'0a' * 8}.tmp"
    names = [half, f".{'0a' * 8}.tmp", f"{LOCK}.{'0a' * 8}.tmp", f"figures/{half}", "figures/fresh"]
    kept = [".mine.tmp", f"runs/agent/{half}", f".new.{'0b' * 8}.tmp", "figures/fresh"]
    for name in {*names, *kept}:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        if "0b" not in name:
            os.utime(path, (1, 1))
    with lock(tmp_path):
        pass
    found = {
        path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()
    }
    assert found == set(kept)


def test_without_links_it_works_too(tmp_path, monkeypatch):
    def refuse(source, target):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    with lock(tmp_path), pytest.raises(FolderInUseError), lock(tmp_path):
        never()
    assert list(tmp_path.iterdir()) == []


def test_where_nothing_can_be_written_no_lock_is_left(tmp_path, monkeypatch):
    def full(path, *args, **options):
        if isinstance(path, locks.Path):
            path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(locks.os, "fdopen", full)
    monkeypatch.setattr(locks.Path, "open", full)
    with pytest.raises(OSError, match="No space left"), lock(tmp_path):
        never()
    assert list(tmp_path.iterdir()) == []


def test_who_was_taken_for_dead_learns_of_it(tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "SECONDS_BETWEEN_SIGNS", 0.01)
    lost = threading.Event()
    told = "on elsewhere is at work on it since .*: it took this one for dead$"

    def work():
        with lock(tmp_path, on_loss=lost.set):
            before = (tmp_path / LOCK).stat().st_mtime_ns
            wait_for(lambda: (tmp_path / LOCK).stat().st_mtime_ns > before)
            assert not lost.is_set()
            leave_lock(tmp_path, FOREIGN)
            assert lost.wait(10)

    with pytest.raises(FolderInUseError, match=told):
        work()
    # That of the other is left to it.
    assert json.loads((tmp_path / LOCK).read_text()) == FOREIGN


@pytest.mark.parametrize(
    ("remove", "told"),
    [
        (shutil.rmtree, "study: this folder is gone: somebody has removed or renamed it$"),
        (lambda root: root.rename(root.with_name("other")), "study: this folder is gone: "),
        (lambda root: (root / LOCK).unlink(), "lock: somebody has removed it, so others may be"),
    ],
)
def test_who_loses_the_folder_learns_of_it_once(tmp_path, monkeypatch, remove, told):
    """A stop that comes of it is told as that, and nothing is made anew."""
    monkeypatch.setattr(locks, "SECONDS_BETWEEN_SIGNS", 0.01)
    lost = []

    def work():
        with lock(tmp_path / "study", on_loss=lambda: lost.append(1)):
            remove(tmp_path / "study")
            wait_for(lambda: lost)
            time.sleep(0.1)  # ten more looks
            raise KeyboardInterrupt

    with pytest.raises(UserError, match=told):
        work()
    assert lost == [1]
    assert not (tmp_path / "study").exists()


def wait_for(condition):
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_lock_cannot_speak_to_the_terminal(tmp_path, monkeypatch):
    leave_lock(tmp_path, {**locks.mark(), "token": "\x1b[2J", "since": "\x1b]0;taken\x07"})
    with pytest.raises(FolderInUseError, match=r"since \\x1b\]0;taken\\x07$"), lock(tmp_path):
        never()
