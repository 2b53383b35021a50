"""What the commands share: one-line errors, exit codes, and lists of ``key:value``."""

from __future__ import annotations

import argparse
import importlib.util
import os
import shlex
import sys
from collections.abc import Callable
from typing import Any, NoReturn

from pipeline.errors import UserError, one_line

MISTAKE = 2
INTERRUPT = 130


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
        self.exit(MISTAKE, f"{self.prog}: error: {' '.join(message.split())} (see --help)\n")

    def _hint(self, words: list[str]) -> str:
        from commands.flag_hints import hint

        flags = [flag for action in self._actions for flag in action.option_strings]
        named = getattr(self._placed, "algos", None) or [getattr(self._placed, "algo", None)]
        text = hint(words, flags, [algo for algo in named if algo is not None])
        return f": {text}" if text else ""


def run_command(main: Callable[[], int]) -> NoReturn:
    """Run a command's ``main`` and exit with its code.

    A mistake of the user's, or a file system that refuses, ends in one line on stderr and exit
    code 2.
    """
    program = os.path.basename(sys.argv[0])  # noqa: PTH119  # a name, not a path
    try:
        sys.exit(main())
    except UserError as error:
        message = str(error)
    except OSError as error:
        place = f": {error.filename}" if error.filename else ""
        message = f"{error.strerror or one_line(error)}{place}"
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        sys.exit(INTERRUPT)
    print(f"{program}: error: {message}", file=sys.stderr)
    sys.exit(MISTAKE)


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
    return shlex.join(["python", *sys.argv])
