"""What the commands' flags have in common: the parser, readers of values, shared flags, names."""

from __future__ import annotations

import argparse
import importlib.util
import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, NoReturn

from rl_yardstick.commands import COMMANDS, NAME, SCRIPTS
from rl_yardstick.pipeline.errors import OTHER_NAMES, UserError, did_you_mean, shown
from rl_yardstick.pipeline.files import portable_name

# --- names of the commands ------------------------------------------------------------------------


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


def command_line() -> str:
    """The command as it was typed, ready to be typed again."""
    program, *arguments = sys.argv
    words = program.split() if program.startswith(f"{NAME} ") else ["python", program]
    return shlex.join([*words, *arguments])


# --- the parser -----------------------------------------------------------------------------------


class OneLineParser(argparse.ArgumentParser):
    """An argument parser whose errors are one line that names the nearest flag."""

    def __init__(self, epilog: str = "", **kwargs: Any) -> None:
        kwargs.setdefault("prog", os.path.basename(sys.argv[0]))  # noqa: PTH119  # a name
        for command in COMMANDS:
            for typed in (f"python {command}.py", f"python -m rl_yardstick {command}"):
                epilog = epilog.replace(typed, called_as(command))
        # No abbreviations: --seed would be taken for --seeds, which means something else.
        kind = argparse.RawDescriptionHelpFormatter
        super().__init__(allow_abbrev=False, formatter_class=kind, epilog=epilog, **kwargs)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse's; the words are kept for hints."""
        self._typed = sys.argv[1:] if args is None else list(args)
        return super().parse_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Raise the mistake as `UserError`."""
        unknown = message.removeprefix("unrecognized arguments: ")
        if unknown != message:
            flags = [flag for action in self._actions for flag in action.option_strings]
            words = unknown.split()
            if words and words[0] in self._typed:  # with a value that was taken for a model
                words = self._typed[self._typed.index(words[0]) :]
            text = hint(words, flags)
            message = f"unknown argument {unknown}{': ' if text else ''}{text}"
        raise UserError(f"{message} (see --help)")


_SEARCH = "hyperparameters are searched by another command: see tune --help"
_NO_WANDB = "Weights & Biases is not supported; -tb DIR writes TensorBoard logs"
# Flags of rl_zoo3's train and enjoy that do not exist here, and why.
_INSTEAD: Mapping[str, str] = {
    **dict.fromkeys(("-optimize", "--optimize-hyperparameters", "--n-trials"), _SEARCH),
    **dict.fromkeys(("--sampler", "--pruner", "--n-startup-trials", "--max-total-trials"), _SEARCH),
    **dict.fromkeys(("--study-name", "--optimization-log-path"), _SEARCH),
    "--storage": "tune stores the trials in trials.db, in the folder of the search",
    **dict.fromkeys(("--track", "--wandb-project-name", "--wandb-entity"), _NO_WANDB),
    "--n-evaluations": "give the steps between evaluations: --eval-freq",
    "--trial-id": "tune writes a file for --conf-file, winner.yml",
    "--trust": "it is not needed: every file is read as data",
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


def hint(words: Sequence[str], flags: Sequence[str]) -> str:
    """A hint about an unknown flag; empty if no flag or hyperparameter is similar.

    Args:
        words: the unknown arguments, the flag first.
        flags: those of the command.
    """
    flag, _, value = "".join(words[:1]).partition("=")
    name = flag.lstrip("-").replace("_", "-").lower()
    if flag in _INSTEAD:
        return _INSTEAD[flag]
    for ours, typed in _TYPED_FOR.items():
        if name in typed.split() and ours in flags:
            return f"did you mean {ours!r}?"
    if setting := _hyperparameter(name.replace("-", "_")):
        value = value or next((word for word in words[1:2] if not word.startswith("-")), "VALUE")
        if "--hyperparams" in flags:
            return f"hyperparameters go behind -params: -params {setting}:{value}"
        return f"hyperparameters can only be set in train: -params {setting}:{value}"
    return did_you_mean(flag, flags)


def _hyperparameter(name: str) -> str:
    """The hyperparameter with this name, or with this as another name; empty for none."""
    from rl_yardstick.pipeline.components import known_names

    return next((one for one in (name, *OTHER_NAMES.get(name, ())) if one in known_names()), "")


# --- readers of values ----------------------------------------------------------------------------

LARGEST = 10**12


def whole_number(
    least: int, most: int = LARGEST, besides: Mapping[int, str] | None = None
) -> Callable[[str], int]:
    """A reader of whole numbers for argparse: ``100000``, ``100_000`` or ``1e5``.

    It accepts numbers from ``least`` to ``most``, and the keys of ``besides`` (with meanings).
    """
    meanings = besides or {}

    def read(text: str) -> int:
        try:
            number = Decimal(text)
            if number == number.to_integral_value() and abs(number) <= LARGEST:
                found = int(number)
                if least <= found <= most or found in meanings:
                    return found
        except InvalidOperation:
            pass
        bounds = f" of at least {least:,}" if least > -LARGEST else ""
        bounds += f" and at most {most:,}" if most < LARGEST else ""
        others = "".join(f", or {key} ({meaning})" for key, meaning in meanings.items())
        raise argparse.ArgumentTypeError(f"must be a whole number{bounds}{others}, not {text!r}")

    return read


def seconds(text: str) -> float:
    """A time such as ``90``, ``90s``, ``10m`` or ``2h``."""
    unit = {"s": 1.0, "m": 60.0, "h": 3600.0}.get(text[-1:])
    try:
        number = float(text if unit is None else text[:-1]) * (unit or 1.0)
    except ValueError:
        number = -1.0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a time such as 90s, 10m or 2h, not {text!r}")
    return number


def filled(text: str) -> str:
    """A text that is not empty."""
    if not text.strip():
        raise argparse.ArgumentTypeError("must not be empty")
    return text


def folder_name(text: str) -> str:
    """The name of one folder."""
    is_name = text.strip() not in ("", ".", "..") and set("/\\\0\n").isdisjoint(text)
    if not is_name or portable_name(text) != text:
        raise argparse.ArgumentTypeError(f"must be the name of one folder, not {shown(text)}")
    return text


COUNT = whole_number(1)
BUDGET = whole_number(1, besides={-1: "as in the hyperparameters"})  # as in rl_zoo3
INTERVAL = whole_number(-LARGEST)  # below 1 for never, as in rl_zoo3
LOG_INTERVAL = whole_number(1, besides={-1: "the library's default", -2: "no log"})
SEED = whole_number(0, 2**32 - 1, besides={-1: "a random one"})  # NumPy's generator takes 32 bits
THREADS = whole_number(1, 1024, besides={-1: "PyTorch's own choice", 0: "likewise"})
JOBS = whole_number(1, 4096, besides={-1: "all cores", 0: "likewise"})
VERBOSITY = whole_number(0, 2)


def assignments() -> Mapping[str, Any]:
    """Options of flags that assign values; each with its own list, or args.yml gets anchors."""
    return {"nargs": "+", "default": [], "metavar": "KEY:VALUE"}


# Flags that several commands have: their names, argparse options, and help.
SHARED: Sequence[tuple[str, Mapping[str, Any], str]] = (
    ("-params --hyperparams", assignments(), ""),
    ("-conf --conf-file", {"type": Path, "metavar": "YAML"}, "hyperparameters from another file"),
    ("--env-kwargs", assignments(), "environment arguments"),
    (
        "--gym-packages",
        {"nargs": "+", "type": filled, "default": [], "metavar": "MODULE"},
        "modules of yours, with environments or agents: names or files",
    ),
    (
        "--engine",
        {"choices": ("auto", "compiled", "library", "interpreted")},
        (
            "auto (compiled code where that is possible and the budget is worth it), compiled, "
            "library (Stable-Baselines3's own loop; the default of dqn, ppo and a2c), or for "
            "tables interpreted; the default of all others is auto"
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
            "do runs on a cluster that shares the folder: a Dask scheduler's address or file, a "
            "YAML of dask-jobqueue, or local:N"
        ),
    ),
    ("--run-timeout", {"type": seconds, "metavar": "TIME"}, "end a run after this time, e.g. 10m"),
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
            f"--device: PyTorch has no {device!r} here: 'auto' takes the best one, 'cpu' is "
            "always there"
        ) from error


def with_engine(algo: str, settings: Mapping[str, Any], word: str | None) -> dict[str, Any]:
    """The typed settings of an agent, with the value of ``--engine``, if given."""
    from rl_yardstick.pipeline.components import arguments_of

    if word is None:
        return dict(settings)
    said = settings.get("engine", word)
    if said != word:
        raise UserError(f"--engine {word} and -params engine:{said} disagree: give one of them")
    engines = [kind[1:] for kind in arguments_of(algo).get("engine", []) if kind.startswith("=")]
    if word in engines:
        return {**settings, "engine": word}
    if not engines and word in ("auto", "library"):
        return dict(settings)
    has = f"the engines {', '.join(engines)}" if engines else "one engine, which auto means"
    raise UserError(f"--engine {word}: {algo} has {has}")
