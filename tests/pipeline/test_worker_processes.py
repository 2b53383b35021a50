"""The processes of environments leave signals to the training, and are ended with it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline import stopping
from pipeline.errors import UserError
from pipeline.stopping import Stopped, close_environments, deaths_told, stops_noticed

SCRIPT = """
import multiprocessing, os, signal, time
from pipeline.stopping import Stopped, stops_noticed
from pipeline.stopping import close_environments, shield_workers

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
        os.killpg(0, signal.SIGTERM)
        os.killpg(0, signal.SIGHUP)
        os.killpg(0, signal.SIGINT)
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


class Env:
    def __init__(self, close):
        self.close = close


def fail():
    raise BrokenPipeError("a worker has ended")


def test_a_pipe_that_is_broken_is_an_error_unless_a_stop_was_asked_for():
    with pytest.raises(BrokenPipeError):
        close_environments(Env(fail))
    with stops_noticed() as stop, stop.held():
        os.kill(os.getpid(), signal.SIGTERM)
        close_environments(Env(fail))


def test_environments_that_do_not_close_hold_nobody_up(monkeypatch):
    monkeypatch.setattr(stopping, "SECONDS_FOR_CLOSING", 0.1)
    started = time.monotonic()
    with stops_noticed() as stop:
        with stop.held():
            os.kill(os.getpid(), signal.SIGTERM)
            close_environments(Env(lambda: time.sleep(30)))
        with pytest.raises(Stopped):
            stop.raise_if_asked()
    assert time.monotonic() - started < 10


class Pipes:
    """Stands for a SubprocVecEnv, one of whose processes has been killed."""

    def __init__(self, *exit_codes):
        self.unwrapped = self
        self.processes = [Ended(code) for code in exit_codes]


class Ended:
    def __init__(self, exitcode):
        self.exitcode = exitcode

    def join(self, seconds):
        assert seconds <= 1


@pytest.mark.parametrize(("code", "how"), [(-9, "SIGKILL"), (1, "exit code 1"), (0, "exit code 0")])
@pytest.mark.parametrize("error", [EOFError, BrokenPipeError, ConnectionResetError])
def test_a_process_that_has_ended_is_named(error, code, how):
    said = f"environment 1 has ended: {how}$"
    with pytest.raises(UserError, match=said), deaths_told(Pipes(None, code)):
        raise error


def test_where_none_has_ended_the_error_stays():
    with pytest.raises(EOFError), deaths_told(Pipes(None, None)):
        raise EOFError
