"""One driver at a time: who is let in, who is turned away, and what the dead leave behind."""

import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from rl_yardstick.pipeline import locks
from rl_yardstick.pipeline.digests import LOCK
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.models.find import model_of
from rl_yardstick.pipeline.runs import INTERRUPTED, RUNNING, Run

FOREIGN = {**locks.mark(), "host": "elsewhere", "machine": "other", "boot": "other"}
FOREIGN |= {"token": "t", "since": "2026-01-01 00:00:00"}
SHOW_MARK = (
    "import json; from rl_yardstick.pipeline.locks import mark; "
    "print(json.dumps(mark()), flush=True)"
)


def never(*words):
    pytest.fail(f"{words} was not expected")


def lock(root, on_loss=never, say=never):
    return locks.folder_lock(root, on_loss, say)


def leave_lock(root, owner, seconds=0.0):
    """A lock whose owner gave its last sign so long ago."""
    root.mkdir(exist_ok=True)
    path = root / LOCK
    path.write_text(owner if isinstance(owner, str) else json.dumps(owner))
    then = path.stat().st_mtime - seconds
    os.utime(path, (then, then))
    return path


def assert_taken(root, told, say=never):
    with pytest.raises(locks.FolderInUseError, match=told), lock(root, say=say):
        never()


def tree(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


@pytest.fixture(scope="module")
def dead():
    """The mark of a process that is no more."""
    done = subprocess.run([sys.executable, "-c", SHOW_MARK], capture_output=True, check=True)
    return json.loads(done.stdout)


def test_inside_nobody_else_is_let_in_and_afterwards_nothing_is_left(tmp_path):
    root = tmp_path / "logs" / "study"
    who = re.escape(f"{root}: process {os.getpid()} on {locks.mark()['host']} is at work")
    with lock(root):
        assert_taken(root, f"^{who} on it since 20..-")
        assert tree(root) == [LOCK]
    assert list(tmp_path.iterdir()) == []


OWNERS = {"dead": None, "silent": FOREIGN, "half": "{"}


@pytest.mark.parametrize("owner", OWNERS.values(), ids=OWNERS)
def test_the_dead_and_the_silent_hold_nothing(tmp_path, owner, dead):
    """A process of this machine is looked for; of what is elsewhere the signs of life count."""
    if owner is None:
        leave_lock(tmp_path, {**dead, "token": "t"})
    else:
        leave_lock(tmp_path, owner, seconds=61)
    with lock(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


def test_one_elsewhere_that_shows_itself_is_at_work(tmp_path, monkeypatch):
    path, said = leave_lock(tmp_path, FOREIGN, seconds=50), []
    monkeypatch.setattr(time, "sleep", lambda seconds: os.utime(path))  # its sign of life
    assert_taken(tmp_path, "on elsewhere is at work", said.append)
    assert [line.partition(":")[0] for line in said] == ["waiting for a sign of life"]
    assert tree(tmp_path) == [LOCK]
    monkeypatch.undo()
    monkeypatch.setattr(locks, "SECONDS_OF_SILENCE", 0.05)  # it says no more
    leave_lock(tmp_path, FOREIGN)
    with lock(tmp_path):
        assert json.loads(path.read_text())["token"] != FOREIGN["token"]


def replace_lock(root):
    before = (root / LOCK).stat().st_mtime_ns
    wait_for(lambda: (root / LOCK).stat().st_mtime_ns > before)  # the owner's sign of life
    leave_lock(root, FOREIGN)


def wait_for(condition):
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.parametrize(
    ("lose", "told", "left"),
    [
        (replace_lock, "on elsewhere is at work on it since .*: it has taken over the lock$", True),
        (shutil.rmtree, "study: this folder is gone: somebody has removed or renamed it$", False),
    ],
    ids=["taken for dead", "removed"],
)
def test_who_loses_the_folder_learns_of_it_once(tmp_path, monkeypatch, lose, told, left):
    """A stop that comes of it is told as that, and nothing is made anew."""
    monkeypatch.setattr(locks, "SECONDS_BETWEEN_SIGNS", 0.01)
    lost, root = [], tmp_path / "study"

    def work():
        with lock(root, on_loss=lambda: lost.append(1)):
            lose(root)
            wait_for(lambda: lost)
            time.sleep(0.05)  # more looks
            raise KeyboardInterrupt

    with pytest.raises(UserError, match=told):
        work()
    assert lost == [1]
    assert root.exists() == left
    if left:  # that of the other is left to it
        assert json.loads((root / LOCK).read_text()) == FOREIGN


# --- half-written files --------------------------------------------------------------------------

HALF = f".summary.csv.{'0a' * 8}.tmp"


def test_what_the_killed_have_half_written_is_removed_and_all_else_stays(tmp_path):
    gone = [HALF, f".{'0a' * 8}.tmp", f"{LOCK}.{'0a' * 8}.tmp", f"figures/{HALF}"]
    kept = [f".new.{'0b' * 8}.tmp", "figures/mine.tmp", f"runs/agent/{HALF}"]
    for name in (*gone, *kept):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        if "0b" not in name:  # the one that may be being written
            os.utime(path, (1, 1))
    with lock(tmp_path):
        pass
    assert tree(tmp_path) == sorted([*kept, "figures", "runs", "runs/agent"])


# --- who is alive --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"began": 1}, False),  # its number is another's now
        ({"boot": "earlier"}, False),
        ({"boot": "earlier", "host": "elsewhere"}, None),
    ],
)
def test_a_number_alone_names_no_process(changes, expected):
    assert locks.is_alive({**locks.mark(), **changes}) is expected


# --- runs ----------------------------------------------------------------------------------------


def run_of(folder, process, **info):
    run = Run.claim(folder, "sarsa", "Taxi-v4")
    run.info_path.write_text(json.dumps({"state": RUNNING, "process": process, **info}))
    return run


def test_a_run_whose_process_is_gone_was_interrupted(tmp_path, dead):
    marks = (dead, locks.mark(), {**dead, "boot": "x", "host": "elsewhere"}, None)
    states = [run_of(tmp_path, process).state for process in marks]
    assert states == [INTERRUPTED, RUNNING, RUNNING, RUNNING]
    for state in ("finished", "failed"):
        assert run_of(tmp_path, dead, state=state).state == state
    assert Run(tmp_path, "Taxi-v4").state is None
    with pytest.raises(UserError, match="its training was cut off before it was written"):
        model_of(run_of(tmp_path, dead))


def test_of_many_at_once_one_gets_the_lock_of_the_dead(tmp_path):
    """Whoever removes the dead one's lock must not remove the next one's."""
    leave_lock(tmp_path, FOREIGN, seconds=61)
    inside, most, begin = [], [], threading.Barrier(8)

    def drive(_):
        begin.wait()
        with suppress(locks.FolderInUseError), lock(tmp_path):
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.05)
            inside.pop()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(drive, range(8)))
    assert set(most) == {1}
    assert list(tmp_path.iterdir()) == []
