"""Shared by all commands: parsing flags, one-line errors, exit codes, and standard output."""

from __future__ import annotations

import argparse
import atexit
import codecs
import contextlib
import decimal
import importlib.util
import inspect
import io
import math
import os
import re
import shlex
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from signal import SIGINT, Signals
from typing import TYPE_CHECKING, Any, NoReturn, TextIO, TypeVar

from rl_yardstick.experiments import run_limits
from rl_yardstick.pipeline.errors import (
    OTHER_NAMES,
    UserError,
    did_you_mean,
    one_line,
    shown,
    visible,
)
from rl_yardstick.pipeline.failures import OwnExit, exhaustion
from rl_yardstick.pipeline.files import portable_name
from rl_yardstick.pipeline.stopping import default_for_signals, n_stops
from rl_yardstick.safe_files.files import UnsafeFileError

if TYPE_CHECKING:
    from rl_yardstick.pipeline.unfinished_runs import SaveInterval

MISTAKE = 2  # exit code

# The installed command, and its subcommands: those are scripts in a checkout.
NAME = "yardstick"

SCRIPTS = ("train", "enjoy", "compare", "tune")
COMMANDS = {
    "train": "train an agent on an environment",
    "enjoy": "watch a trained agent",
    "explain": "say where an agent loses return against the optimum",
    "shaping": "say whether other rewards in training change the optimum, and what they cost",
    "compare": "compare agents over seeds, and write a page",
    "tune": "search for an agent's settings, and test them on other seeds",
    "audit": "say whether an algorithm is right, or which fault it has",
    "pack": "pack a finished run or a study for others, with a card",
    "inspect": "say what a model file contains, without running any of it",
}


# --- names of the commands ------------------------------------------------------------------------


def program_name() -> str:
    """The name of the running command, which begins its messages."""
    return os.path.basename(sys.argv[0])  # noqa: PTH119  # a name, not a path


def called_as(command: str) -> str:
    """A command as the user types it: by the installed name, or as a script."""
    program = sys.argv[0]
    if program.startswith(f"{NAME} "):
        return f"{NAME} {command}"
    if command not in SCRIPTS:
        return f"python -m rl_yardstick {command}"
    script = f"{command}.py"
    beside = Path(program).with_name(script) if Path(program).stem in COMMANDS else script
    return f"python {shlex.quote(str(beside))}"


def as_called(examples: str) -> str:
    """Rewrite examples for a checkout to the names that the user types."""
    for command in COMMANDS:
        for typed in (f"python {command}.py", f"python -m rl_yardstick {command}"):
            examples = examples.replace(typed, called_as(command))
    return examples


def command_line() -> str:
    """The command as it was typed, ready to be typed again."""
    program, *arguments = sys.argv
    words = program.split() if program.startswith(f"{NAME} ") else ["python", program]
    return shlex.join([*words, *arguments])


# --- the parser -----------------------------------------------------------------------------------


class OneLineParser(argparse.ArgumentParser):
    """An argument parser with one-line errors that name the nearest flag."""

    # The parsed arguments, for hints about an unknown one.
    _placed: argparse.Namespace | None = None

    def __init__(self, epilog: str, **kwargs: Any) -> None:
        kwargs.setdefault("prog", program_name())
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        # No abbreviations: --seed would be taken for --seeds, which means something else.
        super().__init__(allow_abbrev=False, epilog=as_called(epilog), **kwargs)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the known arguments, and keep the result for hints."""
        self._placed, rest = super().parse_known_args(args, namespace)
        return self._placed, rest

    def error(self, message: str) -> NoReturn:
        """Print the mistake and exit with code 2."""
        unknown = message.removeprefix("unrecognized arguments: ")
        if unknown != message:
            flags = [flag for action in self._actions for flag in action.option_strings]
            named = getattr(self._placed, "algos", None) or [getattr(self._placed, "algo", None)]
            algos = [algo for algo in named if algo is not None]
            text = hint(unknown.split(), flags, algos)
            message = f"unknown argument {unknown or repr('')}{': ' if text else ''}{text}"
        message = visible(" ".join(message.split()))
        self.exit(MISTAKE, f"{self.prog}: error: {message} (see --help)\n")


# --- hints about unknown flags --------------------------------------------------------------------


_SEARCH = "hyperparameters are not searched for here, but by the command tune: see tune --help"
_NO_WANDB = "Weights & Biases is not supported; -tb DIR writes TensorBoard logs"
_SEARCH_FLAGS = ["-optimize", "--optimize-hyperparameters", "--n-trials", "--no-optim-plots"]
_SEARCH_FLAGS += ["--n-jobs", "--sampler", "--pruner", "--n-startup-trials", "--storage"]
_SEARCH_FLAGS += ["--optimization-log-path", "--study-name", "--max-total-trials"]
_WANDB_FLAGS = ["--track", "--wandb-project-name", "--wandb-entity", "--wandb-group"]
_WANDB_FLAGS += ["-tags", "--wandb-tags"]

# Flags of rl_zoo3's train and enjoy that do not exist here, and why.
INSTEAD: Mapping[str, str] = {
    **dict.fromkeys(_SEARCH_FLAGS, _SEARCH),
    "--n-evaluations": "they are not counted here: give the steps between them, --eval-freq",
    "--trial-id": "trials are not read here: tune writes a file for --conf-file, winner.yml",
    **dict.fromkeys(_WANDB_FLAGS, _NO_WANDB),
    "--trust": "it is not needed: every file is read as data, and nothing in it is run",
    "--truncate-last-trajectory": "it cannot be changed: it is always true, the library's default",
}

# Our flags, and words that people type for them; a hint names the first flag the command has.
_TYPED_FOR: Mapping[str, str] = {
    "--algo": "algorithm agent model agents algorithms",
    "--algos": "agents algorithms algorithm agent model",
    "--env": "environment env-id env-name game envs",
    "--n-timesteps": "timesteps total-timesteps steps num-timesteps max-steps n-steps",
    "--n-episodes": "episodes num-episodes",
    "--render": "render-mode mode",
    "--record": "video gif film record-video save-video",
    "--device": "gpu cuda cpu",
    "--verbose": "quiet silent",
    "--log-folder": "logdir log-dir output out save-dir folder",
    "--folder": "logdir log-dir output out save-dir log-folder",
    "--trained-agent": "continue load pretrained",
    "--jobs": "workers n-jobs num-workers parallel",
    "--seeds": "seed n-seeds num-seeds",
    "--conf-file": "config conf yaml yaml-file",
    "--hyperparams": "params hyperparameters kwargs",
    "--load-best": "best",
    "--load-checkpoint": "checkpoint",
}

# Arguments of constructors that are flags.
SET_BY_FLAGS = {"env", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model"}
_CONSTRUCTOR = re.compile(
    r"def __init__\(\s*self,\s*((?:policy: (?:Union\[)?str\b|\*args).*?)\)(?: -> None)?:\n",
    re.DOTALL,
)


def hint(words: Sequence[str], flags: Iterable[str], algos: Sequence[str]) -> str:
    """A hint about an unknown flag, in a sentence; empty if no flag or setting is similar.

    ``words`` are the unknown arguments, the flag first; ``algos`` are the agents typed.
    """
    flags = list(flags)
    flag, _, value = "".join(words[:1]).partition("=")
    name = flag.lstrip("-").replace("_", "-").lower()
    setting = _hyperparameter(name.replace("-", "_"), algos)
    ours = next(
        (ours for ours, typed in _TYPED_FOR.items() if name in typed.split() and ours in flags),
        None,
    )
    if ours is not None and setting != name.replace("-", "_"):
        return f"did you mean {ours!r}?"
    if flag in INSTEAD:
        return INSTEAD[flag]
    if setting:
        value = value or next(iter(words[1:2]), "")
        value = value if value and not value.startswith("-") else "VALUE"
        if setting == "policy_kwargs":
            value = '"dict(net_arch=[64, 64])"'
        if "--hyperparams" in flags:
            return f"hyperparameters go behind -params: -params {setting}:{value}"
        return f"hyperparameters are a matter of training: train with -params {setting}:{value}"
    return did_you_mean(flag, flags)


def _hyperparameter(name: str, algos: Sequence[str]) -> str:
    """The hyperparameter with this name, or with this as another name; empty for none."""
    from rl_yardstick.agents import ALGORITHMS, load_algorithm
    from rl_yardstick.pipeline.settings.hyperparams import SPECIAL_KEYS
    from rl_yardstick.pipeline.settings.values import RANGES

    names = {*SPECIAL_KEYS, *RANGES, *(each for others in OTHER_NAMES.values() for each in others)}
    names |= constructor_arguments()
    meant = [other for other in (name, *OTHER_NAMES.get(name, ())) if other in names]
    if not meant or not algos:
        return "".join(meant[:1])
    known = set(SPECIAL_KEYS)
    for algo in algos:
        if algo in ALGORITHMS and ALGORITHMS[algo].is_installed:
            known |= set(inspect.signature(load_algorithm(algo)).parameters)
    return next((other for other in meant if other in known), "")


def constructor_arguments() -> set[str]:
    """Arguments of the agents' constructors, read from source: importing all takes seconds.

    A constructor counts as an agent's if its first argument is ``policy``, as in
    Stable-Baselines3, or ``*args``.
    """
    names = set()
    for package in ("rl_yardstick.agents", "stable_baselines3", "sb3_contrib"):
        spec = importlib.util.find_spec(package)
        for folder in (spec and spec.submodule_search_locations) or ():
            for path in Path(folder).rglob("*.py"):
                for found in _CONSTRUCTOR.finditer(path.read_text(encoding="utf-8")):
                    names |= set(re.findall(r"\b(\w+): ", found[1]))
    return names - SET_BY_FLAGS - {"args", "kwargs"}


# --- readers of values ----------------------------------------------------------------------------

LARGEST = 10**12
LONGEST_FOLDER_NAME = 200  # bytes
Amount = TypeVar("Amount", int, float)


def whole_number(
    least: int, most: int = LARGEST, besides: Mapping[int, str] | None = None
) -> Callable[[str], int]:
    """A reader of whole numbers for argparse: ``100000``, ``100_000`` or ``1e5``.

    It accepts numbers from ``least`` to ``most``, and the keys of ``besides`` (with meanings).
    """
    meanings = besides or {}

    def read(text: str) -> int:
        number = _whole(text)
        if number is not None and (least <= number <= most or number in meanings):
            return number
        bounds = f" of at least {least:,}" if least > -LARGEST else ""
        if number is not None and number > most:
            bounds = f" of at most {most:,}"
        others = "".join(f", or {key} ({meaning})" for key, meaning in meanings.items())
        raise argparse.ArgumentTypeError(f"must be a whole number{bounds}{others}, not {text!r}")

    return read


def _whole(text: str) -> int | None:
    """The integer, clipped beyond the range of all flags; None if it is no whole number."""
    try:
        # A Decimal is exact, unlike a float.
        number = Decimal(text)
    except decimal.InvalidOperation:
        return None
    if not number.is_finite():
        return None
    # Clip before the conversion to int: 1e999999999 has a billion digits.
    number = max(min(number, Decimal(LARGEST + 1)), Decimal(-LARGEST - 1))
    return int(number) if number == number.to_integral_value() else None


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def number_at_least_zero(text: str) -> float:
    """A finite number that is not below 0."""
    number = _float(text)
    if not 0 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number of at least 0, not {text!r}")
    return number


def quantity(read: Callable[[str], Amount]) -> Callable[[str], Amount]:
    """Turn a reader of amounts with units that raises ValueError into one for argparse."""

    def read_flag(text: str) -> Amount:
        try:
            return read(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return read_flag


def filled(text: str) -> str:
    """A text that is not empty."""
    if not text.strip():
        raise argparse.ArgumentTypeError("must not be empty")
    return text


def folder_name(text: str) -> str:
    """The name of one folder."""
    if text.strip() in ("", ".", "..") or not set("/\\\0\n").isdisjoint(text):
        raise argparse.ArgumentTypeError(f"must be the name of one folder, not {shown(text)}")
    if portable_name(text, LONGEST_FOLDER_NAME) != text:
        raise argparse.ArgumentTypeError(
            f"must be a name that every system allows, not {shown(text)}"
        )
    return text


def save_interval(text: str) -> SaveInterval:
    """How often to save a state: ``30s``, ``5m``, ``5000`` steps, ``auto`` or ``never``."""
    from rl_yardstick.pipeline.unfinished_runs import SaveInterval

    if text in ("auto", "never"):
        return SaveInterval(is_off=text == "never")
    unit = {"s": 1.0, "m": 60.0, "h": 3600.0}.get(text[-1:])
    if unit is not None:
        seconds = _float(text[:-1]) * unit
        if 0 < seconds < math.inf:
            return SaveInterval(seconds=seconds)
    elif (steps := _whole(text)) is not None and 1 <= steps <= LARGEST:
        return SaveInterval(steps=steps)
    raise argparse.ArgumentTypeError(
        f"must be seconds as 30s, minutes as 5m, steps as 5000, auto or never, not {shown(text)}"
    )


COUNT = whole_number(1)
COUNT_OR_NONE = whole_number(0)
BUDGET = whole_number(1, besides={-1: "what the hyperparameters say"})  # as in rl_zoo3
INTERVAL = whole_number(-LARGEST)  # below 1 for never, as in rl_zoo3
LOG_INTERVAL = whole_number(1, besides={-1: "the library's default", -2: "no log"})
SEED = whole_number(0, 2**32 - 1, besides={-1: "a random one"})  # NumPy's generator takes 32 bits
THREADS = whole_number(1, 1024, besides={-1: "PyTorch's own choice", 0: "likewise"})
VERBOSITY = whole_number(0, 2)
RUN_TIMEOUT = quantity(run_limits.seconds)
RUN_MEMORY = quantity(run_limits.memory)
JOBS = whole_number(1, 4096, besides={-1: "all cores", 0: "likewise"})
FIRST_SEED = whole_number(0, 2**31)


def assignments() -> Mapping[str, Any]:
    """Options of flags that assign values; each with its own list, or args.yml gets anchors."""
    return {"nargs": "+", "default": [], "metavar": "KEY:VALUE"}


_MODULES: Mapping[str, Any] = {"nargs": "+", "type": filled, "default": [], "metavar": "MODULE"}

# Flags that several commands have: their names, argparse options, and help.
SHARED: Sequence[tuple[str, Mapping[str, Any], str]] = (
    ("-params --hyperparams", assignments(), ""),
    ("-conf --conf-file", {"type": filled, "metavar": "YAML"}, "hyperparameters from another file"),
    ("--env-kwargs", assignments(), "environment arguments"),
    ("--gym-packages", _MODULES, "modules of yours, with environments or agents: names or files"),
    (
        "--engine",
        {"choices": ("auto", "compiled", "library", "interpreted")},
        (
            "what trains: auto (compiled code where that is possible and the budget is worth it), "
            "compiled, library (Stable-Baselines3's own loop; the default of dqn, ppo and a2c), or "
            "for tables interpreted; the default of all others is auto"
        ),
    ),
    ("--device", {"default": "auto"}, "torch device (default: auto)"),
    ("--num-threads", {"type": THREADS, "default": 1}, "torch threads (1); -1 leaves it to torch"),
    ("-n --n-timesteps", {"type": COUNT, "metavar": "N"}, "environment steps of each run"),
    ("--n-episodes", {"type": COUNT, "metavar": "N"}, "episodes instead of steps"),
    ("-f --log-folder", {"type": filled}, ""),
    (
        "-j --jobs",
        {"type": JOBS, "default": 0, "metavar": "N"},
        "runs at once (default: all cores)",
    ),
    (
        "--cluster",
        {"type": filled, "metavar": "WHERE"},
        (
            "do runs on a cluster: a Dask scheduler's address or file, a YAML of dask-jobqueue, "
            "or local:N"
        ),
    ),
    (
        "--insecure-cluster",
        {"action": "store_true"},
        "allow a cluster without TLS, where anybody who can connect can run code",
    ),
    (
        "--run-timeout",
        {"type": RUN_TIMEOUT, "metavar": "TIME"},
        "end a run after this time, e.g. 10m",
    ),
    (
        "--run-memory",
        {"type": RUN_MEMORY, "metavar": "SIZE"},
        "end a run that uses more, e.g. 4GB",
    ),
)


def add_shared(group: argparse._ActionsContainer, *flags: str, **changes: Any) -> None:
    """Add shared flags; ``changes`` are argparse options that differ in this command."""
    for flag in flags:
        names, options, words = next(each for each in SHARED if flag in each[0].split())
        group.add_argument(*names.split(), **{"help": words, **options, **changes})


# --- checks of values -----------------------------------------------------------------------------


def check_tensorboard(wanted: object) -> None:
    """Raise `UserError` if a TensorBoard log is wanted and TensorBoard is not installed."""
    if wanted and importlib.util.find_spec("tensorboard") is None:
        raise UserError("-tb needs: pip install 'rl-yardstick[tensorboard]'")


def check_device(device: str) -> None:
    """Raise `UserError` if PyTorch lacks the device; the library would silently use the CPU."""
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


# --- exit codes -----------------------------------------------------------------------------------


def run_command(main: Callable[[], int]) -> NoReturn:
    """Run a command's ``main`` and exit with its code.

    A mistake of the user, or an error of the file system, ends in one line on stderr and exit
    code 2. A closed pipe of the output is no mistake: see `Output`.
    """
    # On Windows, standard output to a file or a pipe has the local encoding.
    codecs.register_error(NAME, _plain)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors=NAME)
    warnings.formatwarning = _warning
    sys.excepthook = _tell_unforeseen
    codes: list[int] = []
    before = n_stops()
    atexit.register(_leave, codes)  # first, so that it is called after the libraries' handlers
    try:
        with standard_streams() as output:
            code = _exit_code(main)
            if output.failure is not None and not isinstance(output.failure, BrokenPipeError):
                code = code or MISTAKE
    except KeyboardInterrupt:  # another one, during the last message
        code = exit_code(SIGINT)
    # At exit an interrupt would print a traceback. The signals get their default action at exit
    # only, because a caller such as a test may keep the process.
    atexit.register(default_for_signals)
    if n_stops() > before:
        codes.append(code)
    sys.exit(code)


def _leave(codes: list[int]) -> None:
    """Exit at once after a signal: to shut the libraries down takes a second."""
    if codes:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(codes[0])


def _exit_code(main: Callable[[], int]) -> int:
    """Run ``main``, and flush its output while errors are still caught."""
    try:
        try:
            code = main()
        except SystemExit as stop:  # argparse's, after --help
            code = stop.code if isinstance(stop.code, int) else 0
        sys.stdout.flush()
        return code
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
        print(f"{program_name()}: {how}", file=sys.stderr)
        return exit_code(number)
    print(f"{program_name()}: error: {visible(message)}", file=sys.stderr)
    return MISTAKE


def exit_code(number: int | None) -> int:
    """The exit code that shells give a process ended by a signal; None means Ctrl-C."""
    return 128 + (number or SIGINT)


def _warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """A library's warning in one line, with control characters of quoted texts made visible."""
    text = one_line(message) if isinstance(message, Warning) else message
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)  # Gymnasium's warnings contain colour codes
    return f"{program_name()}: warning: {visible(text)}\n"


def _tell_unforeseen(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    """Print a traceback, with control characters of quoted texts made visible."""
    sys.stderr.write(visible("".join(traceback.format_exception(kind, error, trace))))


# --- standard output and error --------------------------------------------------------------------

# Replacements of characters that a terminal's encoding lacks; all others become a question mark.
PLAIN = {"±": "+-", "…": "...", "∞": "inf", "×": "x", "–": "-", "━": "-"}  # noqa: RUF001
PLAIN |= {"α": "alpha", "γ": "gamma", "ε": "epsilon", "λ": "lambda", "κ": "kappa"}


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Replace characters that the encoding lacks; for `codecs.register_error`."""
    assert isinstance(error, UnicodeEncodeError)
    signs = error.object[error.start : error.end]
    return "".join(PLAIN.get(sign, "?") for sign in signs), error.end


class Output:
    """A standard stream that handles failed writes.

    After a failure the file below it is the null device, so the interpreter's last flush works.
    """

    def __init__(self, stream: TextIO, *, goes_on: bool) -> None:
        self._stream = stream
        self.goes_on = goes_on  # drop the output after a failure instead of raising
        self.failure: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write; a closed pipe, as by ``head``, ends the command unless ``goes_on``."""
        self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush; failures are handled as in `write`."""
        self._attempt(self._stream.flush)

    def _attempt(self, action: Any, *args: str) -> None:
        if self.failure is None:
            try:
                action(*args)
            except OSError as error:
                self._give_up(error)
        if self.failure is None or self.goes_on:
            return
        is_main = threading.current_thread() is threading.main_thread()
        if isinstance(self.failure, BrokenPipeError) and is_main:  # else it would end that thread
            raise OwnExit(0)
        raise self.failure

    def _give_up(self, error: OSError) -> None:
        self.failure = error
        # A replacement of a standard stream may have no file below.
        with contextlib.suppress(OSError, ValueError, AttributeError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
        if self.goes_on and self is sys.stdout and not isinstance(error, BrokenPipeError):
            reason = f"what it prints is lost: {error.strerror}"
            sys.stderr.write(f"{program_name()}: {reason}\n")


@contextlib.contextmanager
def standard_streams() -> Iterator[Output]:
    """Replace both standard streams by an `Output`; yield that of standard output."""
    _open_closed_ones()
    before = sys.stdout, sys.stderr
    output = Output(sys.stdout, goes_on=False)
    sys.stdout, sys.stderr = output, Output(sys.stderr, goes_on=True)
    try:
        yield output
    finally:
        sys.stdout, sys.stderr = before


def go_on_unread() -> None:
    """Go on working from now on, even if the output can no longer be written."""
    if isinstance(sys.stdout, Output):
        sys.stdout.goes_on = True


def _open_closed_ones() -> None:
    """Open missing standard streams of this process on the null device.

    Otherwise the next opened file would get their file descriptor, and the printed output.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free file descriptor
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123  # until the exit
            setattr(sys, name, nowhere)
