"""What all commands share: parsing flags, one-line errors, exit codes, and standard output."""

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

from experiments import run_limits
from pipeline.errors import OTHER_NAMES, UserError, did_you_mean, one_line, shown, visible
from pipeline.failures import OwnExit, exhaustion
from pipeline.files import portable_name
from pipeline.stopping import default_for_signals, n_stops
from safe_files.files import UnsafeFileError

if TYPE_CHECKING:
    from pipeline.unfinished_runs import SaveInterval

MISTAKE = 2  # exit code

# The command that installing the project brings, and its own commands: the scripts of a checkout.
NAME = "yardstick"

COMMANDS = {
    "train": "train an agent on an environment",
    "enjoy": "watch a trained agent",
    "explain": "say where an agent loses what it stays behind the optimum",
    "shaping": "say what other rewards in training cost, and whether they change the optimum",
    "compare": "compare agents over seeds, and write a page",
    "tune": "search for an agent's settings, and test them on other seeds",
    "audit": "say whether an algorithm is right, or which fault it has",
    "pack": "make a finished run, or a study, a zip for others, with a card",
    "inspect": "say what a model file holds, and run nothing of it",
}


# --- how the commands are called ------------------------------------------------------------------


def program_name() -> str:
    """The name of the running command, which its own messages begin with."""
    return os.path.basename(sys.argv[0])  # noqa: PTH119  # a name, not a path


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


def command_line() -> str:
    """The command as it was typed, ready to be typed again."""
    program, *arguments = sys.argv
    words = program.split() if program.startswith(f"{NAME} ") else ["python", program]
    return shlex.join([*words, *arguments])


# --- the parser -----------------------------------------------------------------------------------


class OneLineParser(argparse.ArgumentParser):
    """An argument parser whose complaints are one line and name the nearest flag."""

    # What `parse_known_args` made of the rest, for the hints about what it could not place.
    _placed: argparse.Namespace | None = None

    def __init__(self, epilog: str, **kwargs: Any) -> None:
        kwargs.setdefault("prog", program_name())
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        # Without abbreviations: --seed for --seeds would mean something else, and be taken.
        super().__init__(allow_abbrev=False, epilog=as_called(epilog), **kwargs)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse what is known, and keep it."""
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


# --- hints about flags that there are not ---------------------------------------------------------


_SEARCH = "hyperparameters are not searched for here, but by the command tune: see tune --help"
_NO_WANDB = "Weights & Biases is not supported; -tb DIR writes TensorBoard logs"
_SEARCH_FLAGS = ["-optimize", "--optimize-hyperparameters", "--n-trials", "--no-optim-plots"]
_SEARCH_FLAGS += ["--n-jobs", "--sampler", "--pruner", "--n-startup-trials", "--storage"]
_SEARCH_FLAGS += ["--optimization-log-path", "--study-name", "--max-total-trials"]
_WANDB_FLAGS = ["--track", "--wandb-project-name", "--wandb-entity", "--wandb-group"]
_WANDB_FLAGS += ["-tags", "--wandb-tags"]

# Flags of rl_zoo3's train and enjoy that are not here, and why.
INSTEAD: Mapping[str, str] = {
    **dict.fromkeys(_SEARCH_FLAGS, _SEARCH),
    "--n-evaluations": "they are not counted here: give the steps between them, --eval-freq",
    "--trial-id": "trials are not read here: tune writes a file for --conf-file, winner.yml",
    **dict.fromkeys(_WANDB_FLAGS, _NO_WANDB),
    "--trust": "it is not needed: every file is read as data, and nothing in it is run",
    "--truncate-last-trajectory": "it cannot be changed: it is always true, the library's default",
}

# Flags of ours, and what people type for them; the first that the command has is named.
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
    """What to do about a flag that there is not, in a sentence; empty where nothing is near.

    ``words`` are what the parser could not place, the flag first; ``algos`` the agents typed.
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
    """The hyperparameter that ``name`` is, or is another name of; empty for none."""
    from agents import ALGORITHMS, load_algorithm
    from pipeline.settings.hyperparams import SPECIAL_KEYS
    from pipeline.settings.values import RANGES

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
    """Arguments of the agents' constructors, read from their sources: to import all takes seconds.

    A constructor is an agent's if it begins with ``policy``, as Stable-Baselines3's do, or hands
    on what it is given.
    """
    names = set()
    for package in ("agents", "stable_baselines3", "sb3_contrib"):
        spec = importlib.util.find_spec(package)
        for folder in (spec and spec.submodule_search_locations) or ():
            for path in Path(folder).rglob("*.py"):
                for found in _CONSTRUCTOR.finditer(path.read_text(encoding="utf-8")):
                    names |= set(re.findall(r"\b(\w+): ", found[1]))
    return names - SET_BY_FLAGS - {"args", "kwargs"}


# --- what flags take ------------------------------------------------------------------------------

LARGEST = 10**12
LONGEST_FOLDER_NAME = 200  # bytes
Amount = TypeVar("Amount", int, float)


def whole_number(
    least: int, most: int = LARGEST, besides: Mapping[int, str] | None = None
) -> Callable[[str], int]:
    """A reader of whole numbers for argparse: ``100000``, ``100_000`` or ``1e5``.

    Beside those from ``least`` to ``most`` it takes the keys of ``besides``, which says what for.
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
    """The number, cut off beyond anything that a flag takes; None where it is no whole one."""
    try:
        # Exact, where the detour by way of a float would not be.
        number = Decimal(text)
    except decimal.InvalidOperation:
        return None
    if not number.is_finite():
        return None
    # Before it is made an int: 1e999999999 has a billion digits.
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
    """A reader of amounts with units, of one that raises ValueError; for argparse."""

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
            f"must be a name that every system takes, not {shown(text)}"
        )
    return text


def save_interval(text: str) -> SaveInterval:
    """How often to save a state: ``30s``, ``5m``, ``5000`` steps, ``auto`` or ``never``."""
    from pipeline.unfinished_runs import SaveInterval

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
    """What flags take that assign values; each has a list of its own, or args.yml has anchors."""
    return {"nargs": "+", "default": [], "metavar": "KEY:VALUE"}


_MODULES: Mapping[str, Any] = {"nargs": "+", "type": filled, "default": [], "metavar": "MODULE"}

# Flags that several commands have: their names, what they take, and what is said of them.
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
        "also on a cluster without TLS: anybody who can connect to it can run code",
    ),
    (
        "--run-timeout",
        {"type": RUN_TIMEOUT, "metavar": "TIME"},
        "end a run after this time, e.g. 10m",
    ),
    (
        "--run-memory",
        {"type": RUN_MEMORY, "metavar": "SIZE"},
        "end a run that takes more, e.g. 4GB",
    ),
)


def add_shared(group: argparse._ActionsContainer, *flags: str, **changes: Any) -> None:
    """Add flags that several commands have, in which this one may change something."""
    for flag in flags:
        names, options, words = next(each for each in SHARED if flag in each[0].split())
        group.add_argument(*names.split(), **{"help": words, **options, **changes})


# --- checks of values -----------------------------------------------------------------------------


def check_tensorboard(wanted: object) -> None:
    """Raise `UserError` if a TensorBoard log is wanted and TensorBoard is not installed."""
    if wanted and importlib.util.find_spec("tensorboard") is None:
        raise UserError("-tb needs: pip install 'rl-yardstick[tensorboard]'")


def check_device(device: str) -> None:
    """Raise `UserError` if PyTorch has no such device; the library would silently take the CPU."""
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

    A mistake of the user's, or a file system that refuses, ends in one line on stderr and exit
    code 2. A reader of the output who goes away is no mistake: see `Output`.
    """
    # On Windows, standard output that goes to a file or a pipe has the encoding of the country.
    codecs.register_error(NAME, _plain)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors=NAME)
    warnings.formatwarning = _warning
    sys.excepthook = _tell_unforeseen
    codes: list[int] = []
    before = n_stops()
    atexit.register(_leave, codes)  # before the libraries', so that it is called after them
    try:
        with standard_streams() as output:
            code = _exit_code(main)
            if output.failure is not None and not isinstance(output.failure, BrokenPipeError):
                code = code or MISTAKE
    except KeyboardInterrupt:  # one more, while the last word was being said
        code = exit_code(SIGINT)
    # What is left to do would tell of one in a traceback. Not now: who calls this in a process of
    # their own, as tests do, have it for longer.
    atexit.register(default_for_signals)
    if n_stops() > before:
        codes.append(code)
    sys.exit(code)


def _leave(codes: list[int]) -> None:
    """Leave at once where a signal asked for it: to take the libraries down costs a second."""
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
    """The exit code that shells give a process that a signal has ended; None stands for Ctrl-C."""
    return 128 + (number or SIGINT)


def _warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """A library's warning in one line, as mistakes are told: what it quotes may be a stranger's."""
    text = one_line(message) if isinstance(message, Warning) else message
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)  # Gymnasium's warnings bring colours of their own
    return f"{program_name()}: warning: {visible(text)}\n"


def _tell_unforeseen(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    """A traceback, which may quote a stranger's texts too."""
    sys.stderr.write(visible("".join(traceback.format_exception(kind, error, trace))))


# --- standard output and error --------------------------------------------------------------------

# What stands for signs that a terminal's encoding lacks; a question mark for all others.
PLAIN = {"±": "+-", "…": "...", "∞": "inf", "×": "x", "–": "-", "━": "-"}  # noqa: RUF001
PLAIN |= {"α": "alpha", "γ": "gamma", "ε": "epsilon", "λ": "lambda", "κ": "kappa"}


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Simplify signs that the encoding lacks; for `codecs.register_error`."""
    assert isinstance(error, UnicodeEncodeError)
    signs = error.object[error.start : error.end]
    return "".join(PLAIN.get(sign, "?") for sign in signs), error.end


class Output:
    """A standard stream, and what happens once it takes nothing more.

    The file below is replaced then, so that the interpreter's last flush does not complain either.
    """

    def __init__(self, stream: TextIO, *, goes_on: bool) -> None:
        self._stream = stream
        self.goes_on = goes_on  # lose what cannot be written, and go on
        self.failure: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write; if the reader has gone, as ``head`` does, and the work was for him, exit."""
        self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Hand on what was written; what is raised is as in `write`."""
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
        # Anything may stand in for a standard stream, also what has no file below.
        with contextlib.suppress(OSError, ValueError, AttributeError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
        if self.goes_on and self is sys.stdout and not isinstance(error, BrokenPipeError):
            reason = f"what it prints is lost: {error.strerror}"
            sys.stderr.write(f"{program_name()}: {reason}\n")


@contextlib.contextmanager
def standard_streams() -> Iterator[Output]:
    """Put an `Output` in the place of both standard streams; yields that of standard output."""
    _open_closed_ones()
    before = sys.stdout, sys.stderr
    output = Output(sys.stdout, goes_on=False)
    sys.stdout, sys.stderr = output, Output(sys.stderr, goes_on=True)
    try:
        yield output
    finally:
        sys.stdout, sys.stderr = before


def go_on_unread() -> None:
    """From now on the work counts, and not what is printed of it."""
    if isinstance(sys.stdout, Output):
        sys.stdout.goes_on = True


def _open_closed_ones() -> None:
    """Open the standard streams that this process was started without, on nothing.

    Otherwise the next file that is opened would get their number, and what is printed.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123  # until the exit
            setattr(sys, name, nowhere)
