"""The commands. `run_command` is the only place that catches `UserError`."""

from __future__ import annotations

import gc
import io
import os
import sys
from contextlib import suppress
from typing import NoReturn

NAME, MISTAKE = "yardstick", 2
SCRIPTS = ("train", "enjoy", "compare", "tune")  # a checkout has a script for each of these
COMMANDS = {
    "train": "train an agent on an environment",
    "enjoy": "watch a trained agent",
    "compare": "compare agents over seeds, and write a page",
    "tune": "search for an agent's settings, and test them on other seeds",
    "explain": "show where an agent loses return against the optimum",
    "optimum": "compute the optimum of an environment",
    "rate": "rate Q-tables, models and policies against the exact optimum",
    "check-env": "check an environment for mistakes, without training",
    "shaping": "show whether other rewards in training change the optimum, and their cost",
    "audit": "test an implementation for known bugs",
    "inspect": "list the content of a model file without running any of it",
}


def main() -> NoReturn:
    """``yardstick COMMAND`` and ``python -m rl_yardstick COMMAND``."""
    command = sys.argv[1] if len(sys.argv) > 1 else ""
    if command not in COMMANDS:
        run_command("cli")
    sys.argv = [f"{NAME} {command}", *sys.argv[2:]]
    run_command(command)


def run_command(name: str) -> NoReturn:
    """Run ``main`` of a command's module and leave the process.

    Exit codes: 0; 1 if a study has runs that failed; 2 after a mistake or an error of the user's
    own code, told in one line; 128 + the number of a signal.
    """
    gc.set_threshold(100_000)  # importing the libraries makes many objects that stay
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal may know ASCII alone
    leave, own = os._exit, os.getpid()
    # Until the work is done nothing ends this process with 0, such as os._exit in an environment.
    os._exit = lambda status: leave(status or int(os.getpid() == own))
    code = _exit_code(name)
    os._exit = leave
    with suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    gc.freeze()  # else the end of the process looks through all of them
    sys.exit(code)


def _exit_code(name: str) -> int:
    from importlib import import_module

    from rl_yardstick.pipeline.errors import Stopped, UserError, one_line, own_calls, visible

    example, module = "", name.replace("-", "_")
    try:
        return int(import_module(f"rl_yardstick.commands.{module}").main() or 0)
    except UserError as error:
        message, example = str(error), error.example
    except BrokenPipeError:  # such as ``| head``
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # no space, no permission
        message = f"{error.filename or 'a file'}: {(error.strerror or str(error)).lower()}"
    except MemoryError as error:
        message = f"not enough memory: {one_line(error)}"
    except Stopped as stopped:
        return 128 + stopped.number
    except KeyboardInterrupt:
        return 130
    except SystemExit as stop:  # argparse's, after --help
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except Exception as error:  # noqa: BLE001  # of the user's own code, or a bug
        import traceback

        if not (calls := own_calls(error)):
            traceback.print_exc()
            return 1
        print(*traceback.format_list(calls), sep="", end="", file=sys.stderr)  # noqa: T201
        where = getattr(error, "__notes__", [])
        message = ": ".join([*where, type(error).__name__, one_line(error)])
    print(f"{os.path.basename(sys.argv[0])}: error: {visible(message)}", file=sys.stderr)  # noqa: PTH119, T201
    if example:
        print(example, file=sys.stderr)  # noqa: T201
    return MISTAKE
