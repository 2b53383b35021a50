"""What the commands share: how they are called, one-line errors, and exit codes."""

from __future__ import annotations

import argparse
import atexit
import codecs
import contextlib
import importlib.util
import io
import os
import re
import shlex
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from signal import SIGINT, Signals
from typing import Any, NoReturn

from commands.streams import standard_streams
from pipeline.errors import UserError, one_line, visible
from pipeline.exhaustion import exhaustion
from pipeline.stopping import default_for_signals, n_stops
from safe_files.files import UnsafeFileError

MISTAKE = 2

# The command that installing the project brings, and its own commands: the scripts of a checkout.
NAME = "yardstick"
COMMANDS = {
    "train": "train an agent on an environment",
    "enjoy": "watch a trained agent",
    "compare": "compare agents over seeds, and write a page",
    "tune": "search for an agent's settings, and test them on other seeds",
    "pack": "make a finished run, or a study, a zip for others, with a card",
    "inspect": "say what a model file holds, and run nothing of it",
}

_COLOURS = re.compile(r"\x1b\[[0-9;]*m")  # Gymnasium's warnings bring their own

# What stands for signs that a terminal's encoding lacks; a question mark for all others.
PLAIN = {"±": "+-", "…": "...", "∞": "inf", "×": "x", "–": "-", "━": "-"}  # noqa: RUF001
PLAIN |= {"α": "alpha", "γ": "gamma", "ε": "epsilon", "λ": "lambda", "κ": "kappa"}


def called_as(command: str) -> str:
    """How the user calls one of the commands: by the installed name, or as a script."""
    program = sys.argv[0]
    if program.startswith(f"{NAME} "):
        return f"{NAME} {command}"
    script = f"{command}.py"
    beside = Path(program).with_name(script) if Path(program).stem in COMMANDS else script
    return f"python {shlex.quote(str(beside))}"


def as_called(examples: str) -> str:
    """Examples that are written as for a checkout, as the user calls the commands."""
    for command in COMMANDS:
        examples = examples.replace(f"python {command}.py", called_as(command))
    return examples


def program_name() -> str:
    """The name of the running command, which its own messages begin with."""
    return os.path.basename(sys.argv[0])  # noqa: PTH119  # a name, not a path


MODULES_HELP = "modules of yours, with environments or agents: names or files"


class OneLineParser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line and name the nearest flag."""

    # What `parse_known_args` made of the rest, for the hints about what it could not place.
    _placed: argparse.Namespace | None = None

    def __init__(self, **kwargs: Any) -> None:
        # --seed for --seeds would mean something else, and be taken without a word.
        super().__init__(allow_abbrev=False, **kwargs)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse what is known, and keep it."""
        self._placed, rest = super().parse_known_args(args, namespace)
        return self._placed, rest

    def error(self, message: str) -> NoReturn:
        """Print the mistake and exit with code 2."""
        unknown = message.removeprefix("unrecognized arguments: ")
        if unknown != message:
            message = f"unknown argument {unknown or repr('')}{self._hint(unknown.split())}"
        self.exit(
            MISTAKE, f"{self.prog}: error: {visible(' '.join(message.split()))} (see --help)\n"
        )

    def _hint(self, words: list[str]) -> str:
        from commands.flag_hints import hint

        flags = [flag for action in self._actions for flag in action.option_strings]
        named = getattr(self._placed, "algos", None) or [getattr(self._placed, "algo", None)]
        text = hint(words, flags, [algo for algo in named if algo is not None])
        return f": {text}" if text else ""


def run_command(main: Callable[[], int]) -> NoReturn:
    """Run a command's ``main`` and exit with its code.

    A mistake of the user's, or a file system that refuses, ends in one line on stderr and exit
    code 2. A reader of the output who goes away is no mistake: see `commands.streams`.
    """
    print_on_any_terminal()
    warnings.formatwarning = _warning
    sys.excepthook = _tell_unforeseen
    codes: list[int] = []
    before = n_stops()
    atexit.register(_leave, codes)  # before the libraries', so that it is called after them
    try:
        code = _code_and_output(main)
    except KeyboardInterrupt:  # one more, while the last word was being said
        code = exit_code(SIGINT)
    # What is left to do would tell of one in a traceback. Not now: who calls this in a process of
    # their own, as tests do, have it for longer.
    atexit.register(default_for_signals)
    if n_stops() > before:
        codes.append(code)
    sys.exit(code)


def _code_and_output(main: Callable[[], int]) -> int:
    with standard_streams() as output:
        code = _exit_code(main)
        if output.failure is not None and not isinstance(output.failure, BrokenPipeError):
            code = code or MISTAKE
    return code


def _leave(codes: list[int]) -> None:
    """Leave at once where a signal asked for it: to take the libraries down costs a second."""
    if codes:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(codes[0])


def _exit_code(main: Callable[[], int]) -> int:
    program = program_name()
    try:
        return _run_to_the_last_word(main)
    except (UserError, UnsafeFileError) as error:
        message = str(error)
    except OSError as error:
        place = f": {error.filename}" if error.filename else ""
        message = f"{error.strerror or one_line(error)}{place}"
    except (MemoryError, RuntimeError, ImportError) as error:
        exhausted = exhaustion(error)
        if exhausted is None:
            raise
        message = exhausted
    except KeyboardInterrupt as stop:
        number = getattr(stop, "number", SIGINT)
        how = "interrupted" if number == SIGINT else f"ended by {Signals(number).name}"
        print(f"{program}: {how}", file=sys.stderr)
        return exit_code(number)
    print(f"{program}: error: {visible(message)}", file=sys.stderr)
    return MISTAKE


def exit_code(number: int | None) -> int:
    """The exit code that shells give a process that a signal has ended; None stands for Ctrl-C."""
    return 128 + (number or SIGINT)


def _run_to_the_last_word(main: Callable[[], int]) -> int:
    """Run ``main``, and write what is still to be written while mistakes are listened for."""
    try:
        code = main()
    except SystemExit as stop:  # argparse's, after --help
        code = stop.code if isinstance(stop.code, int) else 0
    sys.stdout.flush()
    return code


def check_tensorboard(wanted: object) -> None:
    """Make sure that a TensorBoard log can be written where one is wanted.

    Raises:
        UserError: if TensorBoard is not installed.
    """
    if wanted and importlib.util.find_spec("tensorboard") is None:
        raise UserError("-tb needs: pip install 'rl-yardstick[tensorboard]'")


def check_device(device: str) -> None:
    """Make sure that PyTorch has the device here.

    The library takes the processor without a word where it is asked for CUDA and there is none.

    Raises:
        UserError: if it has not.
    """
    if device in ("auto", "cpu"):
        return
    import torch as th

    try:
        th.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        raise UserError(
            f"--device: PyTorch has no {device!r} here: 'auto' takes the best that there is, "
            "'cpu' is always there"
        ) from error


def command_line() -> str:
    """The command as it was typed, ready to be typed again."""
    program, *arguments = sys.argv
    words = program.split() if program.startswith(f"{NAME} ") else ["python", program]
    return shlex.join([*words, *arguments])


def _warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """A library's warning in one line, as mistakes are told: what it quotes may be a stranger's."""
    text = _COLOURS.sub("", one_line(message) if isinstance(message, Warning) else message)
    return f"{program_name()}: warning: {visible(text)}\n"


def _tell_unforeseen(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    """A traceback, which may quote a stranger's texts too."""
    sys.stderr.write(visible("".join(traceback.format_exception(kind, error, trace))))


def print_on_any_terminal() -> None:
    """Let what is printed be simplified where the terminal's encoding has no such signs.

    On Windows, standard output that goes to a file or a pipe has the encoding of the country.
    """
    codecs.register_error(NAME, _plain)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors=NAME)


def _plain(error: UnicodeError) -> tuple[str, int]:
    assert isinstance(error, UnicodeEncodeError)
    signs = error.object[error.start : error.end]
    return "".join(PLAIN.get(sign, "?") for sign in signs), error.end
