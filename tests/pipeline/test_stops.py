"""What asks a process to stop, ends its workers or fills its disk: it is told and recorded."""

import ctypes
import errno
import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline import files, stopping
from pipeline.errors import UserError
from pipeline.runs import ROOM, ROOM_BYTES, Run
from pipeline.stopping import (
    SIGNALS,
    Stopped,
    close_environments,
    current,
    deaths_told,
    stops_noticed,
)

LONG = 30.0  # seconds: nothing here waits so long


@pytest.fixture(autouse=True)
def handlers_are_as_before():
    """And by default, whatever the tests were started under."""
    by_default = [
        signal.default_int_handler if n == signal.SIGINT else signal.SIG_DFL for n in SIGNALS
    ]
    before = [signal.signal(*pair) for pair in zip(SIGNALS, by_default, strict=True)]
    yield
    after = [signal.signal(*pair) for pair in zip(SIGNALS, before, strict=True)]
    assert after == by_default
    assert current().number is None


def send(number=signal.SIGTERM):
    os.kill(os.getpid(), number)


def stopped(work, *args):
    """What a stop was called, and the number of seconds until it was raised."""
    started = time.monotonic()
    with pytest.raises(Stopped) as caught:
        work(*args)
    return str(caught.value), time.monotonic() - started


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_stops_at_once(number):
    with stops_noticed() as stop:
        assert stopped(send, number)[0] == signal.Signals(number).name
        assert (stop.number, current()) == (number, stop)


def hold(stop):
    """It is told at the next safe moment."""
    with stop.held():
        with suppress(Stopped):
            send()
            held = stop.number
        assert held == signal.SIGTERM
        stop.raise_if_asked()


def wait_in_the_midst(stop):
    with stop.held(), stop.waiting(0.3):
        send()
        threading.Event().wait(LONG)


def ask_twice(stop):
    """The second signal waits for nothing but what is held."""
    with stop.waiting(LONG):
        send()
        with stop.held():
            send()
        assert stop.is_urgent
        time.sleep(LONG)


def begin_without_time(stop):
    with stop.held():
        send()
        with stop.waiting(0.0):
            pytest.fail("this is not begun")


def swallow(stop):
    """As a bare except in a user's environment."""
    with stop.waiting(0.0):
        with suppress(BaseException):
            send()
        time.sleep(LONG)


def lose_in_c(stop):
    """In Numba's compiler it is raised where C code has called Python, and is lost there."""
    with stop.waiting(0.0):
        ctypes.CFUNCTYPE(None)(send)()
        raise RuntimeError("no compiled object yet")


def turn_into_another(stop):
    with stop.waiting(0.0):
        try:
            send()
        except KeyboardInterrupt as error:
            raise ImportError("no module") from error


@pytest.mark.parametrize(
    ("work", "shortest"),
    [
        (hold, 0.0),
        (wait_in_the_midst, 0.3),
        (ask_twice, 0.0),
        (begin_without_time, 0.0),
        (swallow, 0.0),
        (lose_in_c, 0.0),
        (turn_into_another, 0.0),
    ],
)
def test_a_stop_comes_in_time_as_itself(work, shortest, monkeypatch, capsys):
    monkeypatch.setattr(stopping, "SECONDS_OF_ONE_REQUEST", 0.0)
    with stops_noticed() as stop:
        name, seconds = stopped(work, stop)
    assert name == "SIGTERM"
    assert shortest <= seconds < LONG
    assert capsys.readouterr().err == ""


def test_another_failure_is_itself():
    with stops_noticed() as stop:
        with pytest.raises(ValueError, match="its own"), stop.waiting(LONG):
            raise ValueError("its own")
        assert stop.number is None


def test_a_key_that_is_held_down_asks_once():
    with stops_noticed() as stop, stop.held():
        for _ in range(100):
            send(signal.SIGINT)
        assert stop.n_asked == 1


def test_in_a_thread_and_inside_another_there_is_nothing_new():
    def work():
        with stops_noticed() as inner:
            seen.append((inner.number, inner is outer, current() is outer))

    seen = []
    with stops_noticed() as outer, outer.held():
        send()
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        work()
    assert seen == [(None, False, False), (signal.SIGTERM, True, True)]


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda *_: None], ids=["ignored", "handled"])
def test_what_is_ignored_or_handled_already_stays_so(handler):
    previous = signal.signal(signal.SIGHUP, handler)
    try:
        with stops_noticed() as stop:
            send(signal.SIGHUP)
            assert stop.number is None
    finally:
        signal.signal(signal.SIGHUP, previous)


def test_a_stop_can_be_handed_to_another_process():
    assert pickle.loads(pickle.dumps(Stopped(signal.SIGHUP))).number == signal.SIGHUP


# --- the processes of environments ---------------------------------------------------------------

SCRIPT = """
import multiprocessing, os, signal, time
from pipeline.stopping import close_environments, shield_workers, stops_noticed

def work(pipe):
    pipe.send("there")
    time.sleep(60)

class Env:
    def close(self):
        worker.join()

if __name__ == "__main__":
    shield_workers()
    context = multiprocessing.get_context("forkserver")
    ours, theirs = context.Pipe()
    worker = context.Process(target=work, args=(theirs,), daemon=True)
    worker.start()
    assert ours.recv() == "there"
    with stops_noticed() as stop, stop.held():
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            os.killpg(0, number)
        time.sleep(0.2)
        print(worker.is_alive(), stop.number)
        close_environments(Env())
        print(worker.is_alive())
"""


def test_workers_outlive_a_signal_to_all_but_not_the_training(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    root = Path(stopping.__file__).parents[1]
    done = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
        start_new_session=True,
    )
    assert (done.stdout, done.stderr, done.returncode) == ("True 15\nFalse\n", "", 0)


def test_a_pipe_that_is_broken_is_an_error_unless_a_stop_was_asked_for():
    def fail():
        raise BrokenPipeError("a worker has ended")

    with pytest.raises(BrokenPipeError):
        close_environments(SimpleNamespace(close=fail))
    with stops_noticed() as stop, stop.held():
        send()
        close_environments(SimpleNamespace(close=fail))


def test_environments_that_do_not_close_hold_nobody_up(monkeypatch):
    monkeypatch.setattr(stopping, "SECONDS_FOR_CLOSING", 0.1)

    def work():
        with stop.held():
            send()
            close_environments(SimpleNamespace(close=lambda: time.sleep(LONG)))
        stop.raise_if_asked()

    with stops_noticed() as stop:
        assert stopped(work)[1] < LONG


@pytest.mark.parametrize("error", [EOFError, BrokenPipeError, ConnectionResetError])
@pytest.mark.parametrize(
    ("code", "how"), [("exec sleep 9", "SIGKILL"), ("exit 1", "exit code 1"), ("", "exit code 0")]
)
def test_a_process_that_has_ended_is_named(code, how, error):
    context = multiprocessing.get_context("fork")
    alive = context.Process(target=time.sleep, args=(LONG,))
    ended = context.Process(target=os.execlp, args=("sh", "sh", "-c", code))
    for process in (alive, ended):
        process.start()
    if how == "SIGKILL":
        ended.kill()
    said = f"environment 1 has ended: {how}$"
    env = SimpleNamespace(unwrapped=SimpleNamespace(processes=[alive, ended]))
    no_dead = SimpleNamespace(unwrapped=SimpleNamespace(processes=[alive]))
    with pytest.raises(UserError, match=said), deaths_told(env):
        raise error
    with pytest.raises(error), deaths_told(no_dead):  # where none has ended
        raise error
    alive.kill()
    alive.join()


# --- a full disk ---------------------------------------------------------------------------------


@pytest.fixture
def train_on_full_disk(type_in_own_folder, own_folder, monkeypatch):
    """Train while nothing can be written from a file of that name on, until room is made."""

    def train(name, room_helps=True):
        folder = own_folder / "logs" / "qlearning" / "FrozenLake-v1_1"
        put_in_place, full = files.put_in_place, []

        def put(draft, path, *opened):
            if path.name == name:
                assert (folder / ROOM).stat().st_size == ROOM_BYTES
                full.append(path)
            if full and not (room_helps and not (folder / ROOM).exists()):
                raise OSError(errno.ENOSPC, "No space left on device")
            put_in_place(draft, path, *opened)

        monkeypatch.setattr(files, "put_in_place", put)
        code, _, said = type_in_own_folder(
            *("train.py", "--env", "FrozenLake-v1", "--algo", "qlearning", "-n", "200"),
            *("--seed", "0", "--save-freq", "100", "--verbose", "0"),
        )
        monkeypatch.setattr(files, "put_in_place", put_in_place)
        assert said.count("\n") == (code != 0)
        return code, said, folder

    return train


@pytest.mark.parametrize(
    ("name", "n_steps", "kept"),
    [
        ("best_model.zip", 10, "no model"),
        ("rl_model_100_steps.zip", 100, "best_model.zip"),
        ("rl_model_200_steps.zip", 200, "best_model.zip and 1 checkpoint"),
        ("FrozenLake-v1.zip", 200, "best_model.zip and 2 checkpoints"),
        ("value_map.png", 200, "best_model.zip and 2 checkpoints"),
    ],
)
def test_the_file_and_what_is_kept_are_named_and_the_run_has_failed(
    train_on_full_disk, name, n_steps, kept
):
    code, said, folder = train_on_full_disk(name)
    assert code == 2
    assert f"{name}: No space left on device: the run has failed at step {n_steps}; " in said
    assert said.endswith(f"keeps {kept}\n")
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    assert record["state"] == "failed"
    assert name in record["reason"]
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]


def test_before_the_first_step_nothing_is_left(train_on_full_disk):
    code, said, folder = train_on_full_disk("config.yml")
    assert code == 2
    assert said.endswith("FrozenLake-v1/config.yml\n")
    assert not folder.parent.exists()


def test_the_record_stays_whole_where_not_even_that_can_be_written(train_on_full_disk):
    code, _, folder = train_on_full_disk("FrozenLake-v1.zip", room_helps=False)
    assert code == 2
    assert Run(folder, "FrozenLake-v1").read_info()["state"] == "running"


def test_a_run_that_ends_gives_its_room_back(train_on_full_disk):
    code, said, folder = train_on_full_disk("no such file")
    assert (code, said) == (0, "")
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]
