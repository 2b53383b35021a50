"""Runs commands that signal to themselves at a named moment, each in a process of its own.

A request is a line of JSON on standard input, the answer one on standard output. The processes are
forked from this one, which has imported the libraries once: a run costs no more than its own work.
"""

import functools
import json
import os
import signal
import sys
import time
from contextlib import suppress
from importlib import import_module
from pathlib import Path


def do(words, plan, ignored=()):
    """Run a command in this process, which sends itself signals.

    Args:
        words: the command's name, and its arguments.
        plan: for each moment that is to be hit the signals to send then, by name.
        ignored: names of signals that are ignored from outside.
    """
    from commands.cli import run_command
    from pipeline import stopping

    stopping.SECONDS_OF_ONE_REQUEST = 0.0  # here they are meant one by one
    for number in stopping.SIGNALS:  # whatever the tests were started under
        is_ignored = number.name in ignored
        default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if is_ignored else default)
    for moment, (owner, name, condition) in moments().items():
        if moment in plan:
            signalling(owner, name, condition, list(plan[moment]))
    sys.argv = words
    run_command(import_module(words[0].removesuffix(".py")).main)


def moments():
    """What is called at each moment: its owner, its name, and on which of the calls."""
    from agents.compiled import engine
    from pipeline import files, preparation, training
    from pipeline.runs import Run
    from pipeline.state_saver import StateSaver

    calls = iter(range(10**9))
    return {
        "set-up": (preparation, "make_evaluation_env", always),
        "compiling": (engine, "run_block", always),
        "training": (StateSaver, "_on_step", lambda *_: next(calls) == 3),
        "saving": (files, "put_in_place", lambda draft, path, *_: path.name == "FrozenLake-v1.zip"),
        "judging": (training, "_judge", always),
        "drawing": (training, "draw_learning_curve", always),
        "recording": (Run, "end", always),
    }


def always(*args):
    return True


def signalling(owner, name, condition, signals):
    """Let the function send the signals before it begins, the first time that it is its turn."""
    function = getattr(owner, name)

    @functools.wraps(function)
    def send(*args, **kwargs):
        if signals and condition(*args):
            with open("signalled", "a", encoding="utf-8") as file:  # noqa: PTH123
                file.write(f"{time.monotonic()}\n")
            while signals:
                signal.raise_signal(signal.Signals[signals.pop(0)])
        return function(*args, **kwargs)

    setattr(owner, name, send)


def in_fork(folder, **request):
    """Do a request in a forked process; its exit code and how long after the signal it ended."""
    pid = os.fork()
    if not pid:
        code = 99
        try:
            os.chdir(folder)
            for number, name in enumerate(("nothing", "out", "err")):
                os.dup2(os.open(name, os.O_RDWR | os.O_CREAT, 0o600), number)
            do(**request)
        except SystemExit as stop:
            code = stop.code
            with suppress(OSError):
                sys.stdout.flush()
                sys.stderr.flush()
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    signalled = Path(folder, "signalled")
    since = float(signalled.read_text().split()[0]) if signalled.exists() else None
    return {"code": code, "seconds": None if since is None else time.monotonic() - since}


def main():
    """Answer requests until there are no more."""
    # What takes long.
    import matplotlib.backends.backend_agg
    import matplotlib.figure  # noqa: F401

    import pipeline.training  # noqa: F401

    for line in sys.stdin:
        print(json.dumps(in_fork(**json.loads(line))), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
