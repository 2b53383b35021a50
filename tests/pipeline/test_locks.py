"""One driver at a time: who is let in, who is turned away, and what the dead leave behind."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from pipeline import locks
from pipeline.digests import LOCK
from pipeline.errors import UserError
from pipeline.locks import FolderInUseError, folder_lock, is_alive, mark, remove_remains
from pipeline.models.find import model_of
from pipeline.runs import INTERRUPTED, RUNNING, Run, remove_leftovers

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


REMAINS = f".x.{16 * '0'}.tmp"
GRAVE = f".lock.{32 * 'a'}.dead.tmp"


def long_ago(path):
    os.utime(path, (1, 1))


def test_old_remains_go_and_all_else_stays(tmp_path):
    (tmp_path / "run").mkdir()
    for folder in (tmp_path, tmp_path / "run"):
        (folder / REMAINS).touch()
        (folder / "kept.tmp").touch()
        (folder / f".new.{16 * '1'}.tmp").touch()
        for name in (REMAINS, "kept.tmp"):
            long_ago(folder / name)
    (tmp_path / GRAVE).mkdir()
    long_ago(tmp_path / GRAVE)
    remove_remains(tmp_path)
    left = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*"))
    new = f".new.{16 * '1'}.tmp"
    assert left == sorted(["run", "kept.tmp", new, "run/kept.tmp", f"run/{new}"])


def test_a_folder_may_go_while_it_is_looked_through(tmp_path, monkeypatch):
    """As the grave of a lock does, when another process has dug it."""
    (tmp_path / GRAVE).mkdir()
    list_all = Path.iterdir

    def going(folder):
        found = list(list_all(folder))
        if tmp_path / GRAVE in found:
            (tmp_path / GRAVE).rmdir()
        return iter(found)

    monkeypatch.setattr(Path, "iterdir", going)
    remove_remains(tmp_path)
    remove_remains(tmp_path / "nowhere")
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def dead():
    """The mark of a process that is no more."""
    code = "import json; from pipeline.locks import mark; print(json.dumps(mark()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    return json.loads(done.stdout)


def test_this_process_is_alive_and_one_that_has_ended_is_not(dead):
    assert is_alive(json.loads(json.dumps(mark()))) is True
    assert is_alive(dead) is False


def test_one_that_has_ended_and_is_not_yet_waited_for_is_not():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        record = {**mark(), "pid": process.pid, "began": locks._ticks_at_begin(process.pid)}
        assert is_alive(record) is True
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert is_alive(record) is False


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"began": 1}, False),  # its number is another's now
        ({"began": None}, True),
        ({"boot": "earlier"}, False),
        ({"boot": "earlier", "host": "elsewhere"}, None),
        ({"boot": "earlier", "machine": "another of that name"}, None),
        ({"boot": "earlier", "machine": None}, None),
        ({"boot": None}, None),
        ({"host": "renamed"}, True),
        ({"namespace": "pid:[another container]", "pid": 1}, None),
        ({"pid": "7"}, None),
        ({"pid": True}, None),
        ({"pid": -1}, None),
        ({"pid": 0}, None),
        ({"pid": 2**40}, None),
    ],
)
def test_a_number_alone_names_no_process(changes, expected):
    assert is_alive({**mark(), **changes}) is expected


@pytest.mark.parametrize("record", [None, [], "7", {}, {"pid": 7}])
def test_of_what_is_no_mark_nothing_is_known(record):
    assert is_alive(record) is None


def test_a_process_that_is_hidden_is_asked_for_by_its_number(dead, monkeypatch):
    monkeypatch.setattr(locks, "_ticks_at_begin", lambda pid: None)
    assert (is_alive({**mark(), "began": 5}), is_alive(dead)) == (True, False)


def test_without_proc_host_and_number_have_to_do(dead, monkeypatch):
    monkeypatch.setattr(locks, "_BOOT", "/nowhere")
    assert is_alive(mark()) is True
    assert is_alive({**mark(), "pid": dead["pid"]}) is False
    assert is_alive({**mark(), "host": "elsewhere"}) is None
    assert is_alive(dead) is None


def test_a_name_with_brackets_and_spaces_is_read_over(tmp_path):
    program = tmp_path / "a) Z (b"
    program.symlink_to(sys.executable)
    with subprocess.Popen([str(program), "-c", "input()"], stdin=subprocess.PIPE) as process:
        assert locks._ticks_at_begin(process.pid) > 0
        process.communicate(b"\n")


# --- runs -----------------------------------------------------------------------------------------


def run_of(folder, process, **info):
    run = Run.claim(folder, "sarsa", "Taxi-v4")
    run.info_path.write_text(json.dumps({"state": RUNNING, "process": process, **info}))
    return run


def test_a_run_whose_process_is_gone_was_interrupted(tmp_path, dead):
    marks = (dead, mark(), {**dead, "boot": "x", "host": "elsewhere"}, None)
    states = [run_of(tmp_path, process).state for process in marks]
    assert states == [INTERRUPTED, RUNNING, RUNNING, RUNNING]
    for state in ("finished", "failed"):
        assert run_of(tmp_path, dead, state=state).state == state
    assert Run(tmp_path, "Taxi-v4").state is None


DRAFT = f".run.json.{'0' * 16}.tmp"


def test_a_set_up_that_was_killed_is_cleared_away(tmp_path, dead):
    """But not one that is at work, may be, or holds anything else."""
    elsewhere = {**dead, "boot": "x", "host": "elsewhere"}
    gone = run_of(tmp_path, dead)
    for name in ("0.monitor.csv", "Taxi-v4/config.yml", "Taxi-v4/command.txt", DRAFT):
        (gone.path / name).touch()
    (gone.path / "modules").mkdir()
    (gone.path / "modules" / "mine.py").touch()
    claimed = Run(tmp_path / "sarsa" / f".Taxi-v4.{'a' * 16}.tmp", "Taxi-v4")
    claimed.params_path.mkdir(parents=True)
    claimed.info_path.write_text(json.dumps({"state": RUNNING, "process": dead}))
    kept = [run_of(tmp_path, process) for process in (mark(), elsewhere, None)]
    kept += [run_of(tmp_path, dead, spec={"algo": "sarsa"})]
    for name in ("notes.txt", "best_model.zip", "Taxi-v4/mine.yml", "modules/sub"):
        kept.append(run_of(tmp_path, dead))
        (kept[-1].path / "modules").mkdir()
        (kept[-1].path / name).mkdir()
    kept.append(run_of(tmp_path, dead))
    (kept[-1].path / "0.monitor.csv").symlink_to(tmp_path)
    before = {path for run in kept for path in run.path.rglob("*")}
    remove_leftovers(tmp_path, "sarsa", "Taxi-v4")
    assert not gone.path.exists()
    assert sorted((tmp_path / "sarsa").iterdir()) == sorted(run.path for run in kept)
    assert {path for run in kept for path in run.path.rglob("*")} == before


def test_half_written_files_go_where_nobody_can_be_writing_them(tmp_path, dead):
    runs = [run_of(tmp_path, process, spec={"a": 1}) for process in (dead, mark(), None)]
    for run in runs:
        run.model_path.touch()
        for name in (DRAFT, f"Taxi-v4/{DRAFT}", ".mine.tmp", "mine.tmp"):
            (run.path / name).touch()
    remove_leftovers(tmp_path, "sarsa", "Taxi-v4")
    assert [len(list(run.path.rglob("*.tmp"))) for run in runs] == [2, 4, 4]


def test_a_damaged_record_and_a_missing_folder_are_left_alone(tmp_path, dead):
    run = run_of(tmp_path, dead)
    run.info_path.write_text("{")
    remove_leftovers(tmp_path, "sarsa", "Taxi-v4")
    remove_leftovers(tmp_path / "nowhere", "sarsa", "Taxi-v4")
    assert run.info_path.exists()


def test_a_training_that_was_killed_is_known_as_interrupted(tmp_path):
    """By its process: nothing else says so."""
    code = (
        "import os, signal, sys; from pathlib import Path; from pipeline.runs import Run\n"
        "Run.claim(Path(sys.argv[1]), 'sarsa', 'Taxi-v4').update_info(spec={'algo': 'sarsa'})\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert Run.find(tmp_path, "sarsa", "Taxi-v4").state == INTERRUPTED
    with pytest.raises(UserError, match="its training was cut off before it was written"):
        model_of(Run.find(tmp_path, "sarsa", "Taxi-v4"))
