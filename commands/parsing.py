"""What the commands share: one-line errors, exit codes, and lists of ``key:value``."""

from __future__ import annotations

import argparse
import importlib.util
import os
import shlex
import sys
from collections.abc import Callable
from typing import NoReturn

from commands.streams import standard_streams
from pipeline.errors import UserError, did_you_mean, one_line

MISTAKE = 2
INTERRUPT = 130


class OneLineParser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line and name the nearest flag."""

    def error(self, message: str) -> NoReturn:
        """Print the mistake and exit with code 2."""
        unknown = message.removeprefix("unrecognized arguments: ")
        if unknown != message:
            flags = [flag for action in self._actions for flag in action.option_strings]
            message = f"unknown argument {unknown}: {did_you_mean(unknown.split()[0], flags)}"
        self.exit(MISTAKE, f"{self.prog}: error: {message} (see --help)\n")


def run_command(main: Callable[[], int]) -> NoReturn:
    """Run a command's ``main`` and exit with its code.

    A mistake of the user's, or a file system that refuses, ends in one line on stderr and exit
    code 2. A reader of the output who goes away is no mistake: see `commands.streams`.
    """
    with standard_streams() as output:
        code = _exit_code(main)
        if output.failure is not None and not isinstance(output.failure, BrokenPipeError):
            code = code or MISTAKE
    sys.exit(code)


def _exit_code(main: Callable[[], int]) -> int:
    program = os.path.basename(sys.argv[0])  # noqa: PTH119  # a name, not a path
    try:
        return _run_to_the_last_word(main)
    except UserError as error:
        message = str(error)
    except OSError as error:
        place = f": {error.filename}" if error.filename else ""
        message = f"{error.strerror or one_line(error)}{place}"
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return INTERRUPT
    print(f"{program}: error: {message}", file=sys.stderr)
    return MISTAKE


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


def command_line() -> str:
    """The command as it was typed, ready to be typed again."""
    return shlex.join(["python", *sys.argv])
