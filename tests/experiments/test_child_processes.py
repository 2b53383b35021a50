"""Work in child processes: what comes back, what is tried again, and what is left behind."""

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from experiments import child_processes
from experiments.child_processes import (
    StoppedError,
    TaskDiedError,
    TaskFailedError,
    local_executor,
    stop_all,
    supervise,
)
from experiments.run_limits import RunLimits

# What the children are to do; they import it by its name.
CHORES = """
import os, signal, time
from pathlib import Path

def add(first, second):
    return first + second, os.getpid()

def fail(folder, words):
    (Path(folder) / f"try_{os.getpid()}").touch()
    raise ValueError(words)

def die(folder, times):
    tries = len(list(Path(folder).glob("try_*")))
    (Path(folder) / f"try_{os.getpid()}").touch()
    if tries < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return tries

def leave(code):
    os._exit(code)

def wait(folder):
    (Path(folder) / f"waiting_{os.getpid()}").touch()
    time.sleep(600)

def interrupt_itself():
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(os.getpid(), number)
    time.sleep(0.05)
    return "still here"

def say_why_it_ends(kind, *words):
    raise {"exit": SystemExit, "interrupt": KeyboardInterrupt}[kind](*words)

def crash():
    import ctypes
    ctypes.string_at(0)

def hold_on():
    time.sleep(600)

def grow():
    kept = bytearray(b"x") * 800_000_000
    time.sleep(600)

def write_and_wait(folder, text):
    (Path(folder) / f"waiting_{os.getpid()}").touch()
    while not (Path(folder) / "go").exists():
        time.sleep(0.01)
    return text

def threads():
    return os.environ["OMP_NUM_THREADS"]

def clean_up(folder):
    with (Path(folder) / "cleaned").open("a") as file:
        file.write(".")
"""


@pytest.fixture(params=["forkserver", "spawn"], autouse=True)
def method(request, monkeypatch):
    """Children of Linux, and those of Windows and macOS."""
    context = multiprocessing.get_context(request.param)
    monkeypatch.setattr(child_processes, "context", context)
    # Another test may have stopped everything.
    monkeypatch.setattr(child_processes, "_stopping", threading.Event())
    return request.param


@pytest.fixture
def chores(tmp_path, monkeypatch):
    (tmp_path / "study_chores.py").write_text(CHORES)
    monkeypatch.syspath_prepend(tmp_path)
    import study_chores

    yield study_chores
    monkeypatch.delitem(sys.modules, "study_chores")


@pytest.fixture
def light_server(method, monkeypatch):
    """What children are forked from has imported nothing, for tests that end it."""
    if method == "spawn":
        yield
        return
    preloaded, heavy = child_processes.PRELOADED, child_processes.server_pid()
    child_processes.end_server()
    monkeypatch.setattr(child_processes, "PRELOADED", [])

    def is_there():
        child_processes.start_server()
        return child_processes.server_pid() != heavy

    wait_for(is_there)  # one with threads is not gone as soon as it is a zombie
    yield
    child_processes.end_server()
    multiprocessing.set_forkserver_preload(preloaded)


def nothing():
    pass


def test_the_value_comes_back_from_another_process(chores):
    with local_executor(2) as executor:
        futures = [executor.submit(supervise, chores.add, n, 1, clean_up=nothing) for n in range(4)]
        answers = [future.result() for future in futures]
    assert [value for value, _ in answers] == [1, 2, 3, 4]
    assert len({pid for _, pid in answers} | {os.getpid()}) == 5


def test_one_thread_in_each_process(chores):
    with local_executor(1) as executor:
        assert executor.submit(supervise, chores.threads, clean_up=nothing).result() == "1"


def test_an_exception_is_not_tried_again_and_its_traceback_is_kept(chores, tmp_path):
    clean_up = partial(chores.clean_up, str(tmp_path))
    with pytest.raises(TaskFailedError) as error:
        supervise(chores.fail, str(tmp_path), "too\n  hot", clean_up=clean_up, tries=3)
    assert str(error.value) == "too hot"
    assert "Traceback" in error.value.details
    assert "in fail" in error.value.details
    assert error.value.details.endswith("ValueError: too\n  hot\n")
    assert len(list(tmp_path.glob("try_*"))) == 1
    assert (tmp_path / "cleaned").read_text() == "."


def test_a_process_that_is_killed_costs_one_retry(chores, tmp_path):
    clean_up = partial(chores.clean_up, str(tmp_path))
    assert supervise(chores.die, str(tmp_path), 1, clean_up=clean_up) == 1
    assert len(list(tmp_path.glob("try_*"))) == 2
    assert (tmp_path / "cleaned").read_text() == ".."


def test_a_process_that_always_dies_fails_with_the_signals_name(chores, tmp_path):
    with pytest.raises(TaskFailedError, match=r"^its process died 2 times \(SIGKILL\)$"):
        supervise(chores.die, str(tmp_path), 9, clean_up=nothing)
    assert len(list(tmp_path.glob("try_*"))) == 2
    with pytest.raises(TaskFailedError, match=r"^its process died 1 times \(exit code 3\)$"):
        supervise(chores.leave, 3, clean_up=nothing, tries=1)


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def wait_for(condition, seconds=30):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_leaving_early_ends_the_children(chores, tmp_path):
    clean_up = partial(chores.clean_up, str(tmp_path))

    def run_and_leave():
        with local_executor(2) as executor:
            futures = [
                executor.submit(supervise, chores.wait, str(tmp_path), clean_up=clean_up)
                for _ in range(3)
            ]
            wait_for(lambda: len(list(tmp_path.glob("waiting_*"))) == 2)
            outcomes.extend(futures)
            raise KeyboardInterrupt

    outcomes = []
    with pytest.raises(KeyboardInterrupt):
        run_and_leave()
    pids = [int(path.name.partition("_")[2]) for path in tmp_path.glob("waiting_*")]
    assert not any(map(is_alive, pids))
    assert (tmp_path / "cleaned").read_text() == ".."
    assert [type(future.exception()) for future in outcomes[:2]] == [StoppedError] * 2
    assert outcomes[2].cancelled()
    # The next block starts afresh.
    with local_executor(1) as executor:
        assert executor.submit(supervise, chores.add, 1, 1, clean_up=nothing).result()[0] == 2


def test_nothing_is_started_after_the_end(chores):
    with local_executor(1) as executor:
        stop_all()
        future = executor.submit(supervise, chores.add, 1, 1, clean_up=nothing)
        assert isinstance(future.exception(), StoppedError)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("exit", "bye"), "SystemExit: bye"),
        (("exit", 0), "SystemExit: 0"),
        (("exit",), "SystemExit"),
        (("interrupt",), "KeyboardInterrupt"),
        (("interrupt", "from\n inside"), "KeyboardInterrupt: from inside"),
    ],
)
def test_what_ends_a_program_is_a_failure_like_others(chores, arguments, words):
    with pytest.raises(TaskFailedError) as error:
        supervise(chores.say_why_it_ends, *arguments, clean_up=nothing)
    assert str(error.value) == words
    assert "in say_why_it_ends" in error.value.details


def test_a_crash_leaves_its_traceback(chores):
    with pytest.raises(TaskDiedError, match=r"SIGSEGV") as error:
        supervise(chores.crash, clean_up=nothing, tries=1)
    assert "Fatal Python error: Segmentation fault" in error.value.details
    assert "in crash\n" in error.value.details
    assert "Extension modules" not in error.value.details


@pytest.mark.parametrize(
    ("chore", "limits", "reason"),
    [
        ("hold_on", RunLimits(seconds=0.5), "took longer than --run-timeout allows, 0.5 s"),
        ("grow", RunLimits(memory=700_000_000), "--run-memory allows 700 MB"),
    ],
)
def test_what_exceeds_a_limit_is_ended_where_it_is(chores, tmp_path, chore, limits, reason, method):
    if method == "spawn" and chore == "hold_on":
        limits, reason = RunLimits(seconds=5), "--run-timeout allows, 5 s"
    clean_up = partial(chores.clean_up, str(tmp_path))
    with pytest.raises(TaskFailedError) as error:
        supervise(getattr(chores, chore), clean_up=clean_up, limits=limits)
    assert reason in str(error.value)
    assert f"in {chore}\n" in error.value.details
    assert error.value.details.endswith(f"{error.value}\n")
    assert not isinstance(error.value, TaskDiedError)
    assert (tmp_path / "cleaned").read_text() == "."


def test_within_its_limits_a_task_is_left_alone(chores):
    limits = RunLimits(seconds=300, memory=10**12)
    assert supervise(chores.add, 1, 1, clean_up=nothing, limits=limits)[0] == 2


@pytest.mark.usefixtures("light_server")
def test_when_the_server_is_killed_all_go_on(chores, tmp_path, method, caplog):
    if method == "spawn":
        return
    with local_executor(2) as executor:
        first = executor.submit(
            supervise, chores.write_and_wait, str(tmp_path), "first", clean_up=nothing
        )
        wait_for(lambda: list(tmp_path.glob("waiting_*")))
        server = child_processes.server_pid()
        child_processes.end_server()
        wait_for(lambda: not is_alive(server) or is_zombie(server))
        assert executor.submit(supervise, chores.add, 1, 1, clean_up=nothing).result()[0] == 2
        (tmp_path / "go").touch()
        assert first.result() == "first"
    assert caplog.messages == [
        "the process that runs are forked from was killed; it is started anew"
    ]


def is_zombie(pid):
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


@pytest.mark.usefixtures("light_server")
def test_a_stop_does_not_wait_for_a_server_that_imports(chores, tmp_path, method, monkeypatch):
    """Where it is still at that, no child can be started, and the one who waits is let go."""
    if method == "spawn":
        return
    with local_executor(1) as executor:
        os.kill(child_processes.server_pid(), signal.SIGSTOP)
        future = executor.submit(supervise, chores.add, 1, 1, clean_up=nothing)
        wait_for(child_processes._lock.locked)
        began = time.monotonic()
        stop_all()
        assert isinstance(future.exception(), StoppedError)
        assert time.monotonic() - began < 2


def test_programs_that_a_task_starts_can_be_ended_as_usual(chores):
    assert supervise(subprocess.getoutput, "kill $$; echo still here", clean_up=nothing) == ""


def test_ctrl_c_does_not_reach_the_children(chores, tmp_path):
    """The terminal sends it to the whole group; what it means is decided above."""
    with local_executor(1) as executor:
        waiting = executor.submit(supervise, chores.wait, str(tmp_path), clean_up=nothing)
        wait_for(lambda: list(tmp_path.glob("waiting_*")))
        (path,) = tmp_path.glob("waiting_*")
        pid = int(path.name.partition("_")[2])
        os.kill(pid, signal.SIGINT)
        time.sleep(0.2)
        assert is_alive(pid)
        assert not waiting.done()
        stop_all()
        assert isinstance(waiting.exception(), StoppedError)


def test_a_child_works_through_ctrl_c(chores):
    assert supervise(chores.interrupt_itself, clean_up=nothing, tries=1) == "still here"


# A supervisor of its own, which is to be killed.
DRIVER = """
import multiprocessing, sys
from functools import partial
import study_chores
from experiments import child_processes

if __name__ == "__main__":
    method, folder = sys.argv[1:]
    child_processes.context = multiprocessing.get_context(method)
    child_processes.supervise(
        study_chores.wait, folder, clean_up=partial(study_chores.clean_up, folder)
    )
"""


def test_a_child_ends_with_its_supervisor_and_cleans_up(chores, tmp_path, method):
    driver = tmp_path / "driver.py"
    driver.write_text(DRIVER)
    paths = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    command = [sys.executable, str(driver), method, str(tmp_path)]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": paths}) as process:
        wait_for(lambda: list(tmp_path.glob("waiting_*")))
        process.kill()
    (path,) = tmp_path.glob("waiting_*")
    wait_for(lambda: not is_alive(int(path.name.partition("_")[2])))
    assert (tmp_path / "cleaned").read_text() == "."


@pytest.mark.parametrize(
    ("platform", "expected"), [("linux", "forkserver"), ("win32", "spawn"), ("darwin", "spawn")]
)
def test_only_linux_forks(monkeypatch, platform, expected):
    """Windows has no fork server, and the module must do without."""
    monkeypatch.setattr(sys, "platform", platform)
    if platform == "win32":
        monkeypatch.setitem(sys.modules, "multiprocessing.forkserver", None)
        monkeypatch.delattr(signal, "pthread_sigmask")
    loaded = runpy.run_path(child_processes.__file__)
    assert loaded["START_METHOD"] == expected
    assert loaded["context"].get_start_method() == expected
    if platform != "linux":
        loaded["start_server"]()
