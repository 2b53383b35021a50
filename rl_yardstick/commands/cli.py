"""What the commands' flags have in common: the parser, readers of values, shared flags, names.

`main` is the command without a name: ``yardstick --help`` and ``--version``.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shlex
import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, NoReturn

from rl_yardstick.commands import COMMANDS, NAME, SCRIPTS
from rl_yardstick.pipeline.errors import OTHER_NAMES, UserError, did_you_mean, shown, unknown
from rl_yardstick.pipeline.files import portable_name, write_json

# --- names of the commands ------------------------------------------------------------------------


def main() -> int:
    """Print the help or the version; refuse what is no command."""
    from importlib.metadata import version

    word = sys.argv[1] if len(sys.argv) > 1 else ""
    if word == "--version":
        sys.stdout.write(f"{version('rl-yardstick')}\n")
    elif word in ("-h", "--help"):
        lines = "".join(f"  {NAME} {each:<10}{summary}\n" for each, summary in COMMANDS.items())
        sys.stdout.write(f"usage: {NAME} [-h] [--version] COMMAND ...\n\ncommands:\n{lines}")
    elif not word:
        raise UserError(f"which command? {', '.join(COMMANDS)}")
    else:
        raise unknown("unknown command", word, COMMANDS)
    return 0


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


def to_copy(command: str, *words: object, typed: Sequence[str] = ()) -> str:
    """A command to copy into a shell, with the modules that were typed; a long one is wrapped."""
    words = (*words, "--gym-packages", *typed) if typed else words
    quoted = [shlex.quote(str(word)).replace(" ", "\0") for word in words]
    whole: Any = {"break_long_words": False, "break_on_hyphens": False}
    lines = textwrap.wrap(" ".join([called_as(command), *quoted]), 74, **whole)
    return " \\\n    ".join(lines).replace("\0", " ")


def command_line() -> str:
    """The command as it was typed, ready to be typed again."""
    program, *arguments = sys.argv
    words = program.split() if program.startswith(f"{NAME} ") else ["python", program]
    return shlex.join([*words, *arguments])


# --- the parser -----------------------------------------------------------------------------------

# The names of a flag, and argparse's options.
Flag = tuple[list[str], dict[str, Any]]
Flags = Mapping[str, Sequence[Flag]]  # by the title of their group


def flag(names: str, words: str, reader: Any = None, default: Any = None, **options: Any) -> Flag:
    """A flag: its names with spaces between them, its help, and the reader of its value."""
    read = {} if reader is None else {"type": reader, "metavar": "N"}
    return names.split(), {"help": words, "default": default, **read, **options}


def switch(names: str, words: str, **options: Any) -> Flag:
    """A flag without a value."""
    return names.split(), {"help": words, "action": "store_true", **options}


def several(names: str, words: str, metavar: Any = "KEY:VALUE", **options: Any) -> Flag:
    """A flag with one value or more; each has its own list, or args.yml would get anchors."""
    return flag(names, words, **{"nargs": "+", "default": [], "metavar": metavar, **options})


class OneLineParser(argparse.ArgumentParser):
    """A parser of groups of flags, by their titles, whose errors are one line."""

    def __init__(self, description: str, epilog: str, flags: Flags | None = None) -> None:
        for command in COMMANDS:
            for typed in (f"python {command}.py", f"python -m rl_yardstick {command}"):
                epilog = epilog.replace(typed, called_as(command))
        super().__init__(
            prog=os.path.basename(sys.argv[0]),  # noqa: PTH119  # a name
            description=textwrap.fill(description, 79),
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,  # --seed would be taken for --seeds, which means something else
        )
        for title, members in (flags or {}).items():
            group = self.add_argument_group(title) if title else self
            for names, options in members:
                group.add_argument(*names, **options)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse's; the words are kept for hints."""
        self.typed = sys.argv[1:] if args is None else list(args)
        return super().parse_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Raise the mistake as `UserError`."""
        surplus = message.removeprefix("unrecognized arguments: ")
        if surplus != message:
            flags = [name for action in self._actions for name in action.option_strings]
            words = surplus.split()
            if words and words[0] in self.typed:  # with a value that was taken for a model
                words = self.typed[self.typed.index(words[0]) :]
            text = hint(words, flags)
            message = f"unknown argument {surplus}{': ' if text else ''}{text}"
        raise UserError(f"{message} (see --help)")


_SEARCH = "hyperparameters are searched by another command: see tune --help"
# Flags of rl_zoo3's train and enjoy that do not exist here, and why.
_INSTEAD: Mapping[str, str] = {
    **dict.fromkeys(("-optimize", "--optimize-hyperparameters", "--n-trials"), _SEARCH),
    **dict.fromkeys(("--sampler", "--pruner", "--n-startup-trials", "--max-total-trials"), _SEARCH),
    "--optimization-log-path": _SEARCH,
    "--storage": "tune stores the trials in trials.log, in the folder of the search",
    **dict.fromkeys(("-yaml", "--yaml-file"), "did you mean '--conf-file'?"),
    "--n-evaluations": "give the steps between evaluations: --eval-freq",
    "--trial-id": "tune writes a file for --conf-file, winner.yml",
}


def hint(words: Sequence[str], flags: Sequence[str]) -> str:
    """A hint about unknown ``words``, a flag first, by the flags that there are; or no text."""
    from rl_yardstick.pipeline.components import known_names

    typed, _, value = "".join(words[:1]).partition("=")
    name = typed.lstrip("-").replace("-", "_").lower()
    if typed in _INSTEAD:
        return _INSTEAD[typed]
    settings = [one for one in (name, *OTHER_NAMES.get(name, ())) if one in known_names()]
    if not settings:
        return did_you_mean(typed, flags)
    value = value or next((word for word in words[1:2] if not word.startswith("-")), "VALUE")
    where = "go behind -params" if "--hyperparams" in flags else "can only be set in train"
    return f"hyperparameters {where}: -params {settings[0]}:{value}"


# --- readers of values ----------------------------------------------------------------------------

LARGEST = 10**12


def whole_number(
    least: int, most: int = LARGEST, besides: Mapping[int, str] | None = None
) -> Callable[[str], int]:
    """A reader of whole numbers such as ``1e5``; ``besides`` maps further ones to meanings."""
    meanings = besides or {}

    def read(text: str) -> int:
        with suppress(InvalidOperation):
            number = Decimal(text)
            if number == number.to_integral_value() and abs(number) <= LARGEST:
                found = int(number)
                if least <= found <= most or found in meanings:
                    return found
        others = "".join(f", or {key} ({meaning})" for key, meaning in meanings.items())
        bounds = f"from {least:,} to {most:,}{others}"
        raise argparse.ArgumentTypeError(f"must be a whole number {bounds}, not {text!r}")

    return read


def seconds(text: str) -> float:
    """A time such as ``90``, ``90s``, ``10m`` or ``2h``."""
    from rl_yardstick.experiments.study import seconds as read

    try:
        return read(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def folder_name(text: str) -> str:
    """The name of one folder."""
    if portable_name(text) != text:
        raise argparse.ArgumentTypeError(f"must be the name of one folder, not {shown(text)}")
    return text


COUNT = whole_number(1)
BUDGET = whole_number(1, besides={-1: "as in the hyperparameters"})  # as in rl_zoo3
INTERVAL = whole_number(-LARGEST)  # below 1 for never, as in rl_zoo3
VERBOSITY = whole_number(0, 2)
LOG_INTERVAL = whole_number(1, besides={-1: "the library's default", -2: "no log"})
SEED = whole_number(0, 2**32 - 1, besides={-1: "a random one"})  # NumPy's generator takes 32 bits
FIRST_SEED = whole_number(0, 2**31)
THREADS = whole_number(1, 1024, besides={-1: "PyTorch's own choice", 0: "likewise"})
JOBS = whole_number(1, 4096, besides={-1: "all cores", 0: "likewise"})


# --- flags of several commands --------------------------------------------------------------------


_SHARED: Sequence[Flag] = (
    several("-params --hyperparams", "hyperparameters to change, e.g. learning_rate:0.01"),
    flag("-conf --conf-file", "hyperparameters from another file", Path, metavar="YAML"),
    several("--env-kwargs", "environment arguments"),
    several("--gym-packages", "your modules with environments or agents, or files", "MODULE"),
    flag(
        "--engine",
        "auto (compiled code where that is possible and the budget is worth it), compiled, "
        "library (Stable-Baselines3's own loop; the default of dqn, ppo and a2c), or for "
        "tables interpreted; the default of all others is auto",
        choices=("auto", "compiled", "library", "interpreted"),
    ),
    flag(
        "--vec-normalize",
        "VecNormalize's statistics of the model, or none (default: those of its run)",
        Path,
        metavar="FILE",
    ),
    flag("--device", "torch device (default: auto)", default="auto"),
    flag("--num-threads", "torch threads (1); -1 leaves it to torch", THREADS, 1),
    flag("-n --n-timesteps", "environment steps of each run", COUNT),
    flag("--n-episodes", "episodes instead of steps", COUNT),
    flag("-j --jobs", "runs at once (default: all cores)", JOBS, 0),
    flag(
        "--cluster",
        "do runs on a cluster that shares the folder: a Dask scheduler's address or file, a "
        "YAML of dask-jobqueue, or local:N",
        metavar="WHERE",
    ),
    flag("--run-timeout", "end a run after this time, e.g. 10m", seconds, metavar="TIME"),
    flag(
        "--model",
        "where none is published, find the environment's exact model in its code: auto (at most "
        "10 s and 100,000 states), none, or the most states",
        lambda text: text if text in {"auto", "none"} else str(COUNT(text)),
        "auto",
        dest="exact_model",
    ),
    flag("--json", "also write the result to this file", Path, metavar="FILE"),
    switch(
        "--diagnose",
        "compare values, advantages and gradients with the exact ones at each evaluation",
    ),
)


def shared(*names: str, **changes: Any) -> list[Flag]:
    """Flags that several commands have; ``changes`` are options that differ in this command."""
    table = {known[-1]: (known, options) for known, options in _SHARED}
    return [(table[name][0], {**table[name][1], **changes}) for name in names]


def import_typed(args: argparse.Namespace) -> None:
    """Import the modules of ``--gym-packages``, ``--env module:Id-v0`` and ``--algo module:Class``.

    ``args.env`` is one id, a list of ids, or None, and is left without modules; classes, also of
    ``--env``, are named ``module.Class``.
    """
    from rl_yardstick.pipeline.components import class_name, import_modules, split_id

    for key in [key for key in ("env", "algo", "algos") if getattr(args, key, None)]:
        given = getattr(args, key)
        words = given if isinstance(given, list) else [given]
        typed = [split_id(word)[0] if key == "env" else word for word in words if ":" in word]
        args.gym_packages = [*args.gym_packages, *filter(None, typed)]
        names = [split_id(word)[1] if key == "env" else class_name(word) for word in words]
        setattr(args, key, names if isinstance(given, list) else names[0])
    import_modules(args.gym_packages)
    if "exact_model" in args:
        from rl_yardstick.envs import found_models

        found_models.limit(args.exact_model or "auto")


def check_alone(
    parser: OneLineParser, beside: Collection[str], what: str = "--resume: the run has its own"
) -> None:
    """Refuse what is typed beside ``--resume`` or logs, but for flags whose ``dest`` is given."""
    for action in parser._actions:
        action.default = argparse.SUPPRESS  # only typed flags remain, also typed defaults
    typed = vars(parser.parse_args())
    for action in parser._actions:
        if action.dest in typed and action.dest not in beside:
            name = next(reversed(action.option_strings), action.dest)
            raise UserError(f"{name} cannot be given with {what}")


# --- what several flags mean ----------------------------------------------------------------------


def given(args: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    """The values of those of the flags that are given, by name; lists as tuples."""
    values = {name: getattr(args, name, None) for name in names}
    return {k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if v is not None}


def typed_settings(args: argparse.Namespace, name: str) -> dict[str, Any]:
    """The settings that the flags give to every agent; ``name`` is that of ``--hyperparams``."""
    from rl_yardstick.pipeline.settings import BUDGETS, layered, parse_assignments

    found: dict[str, Any] = parse_assignments(args.hyperparams, name)
    for key in ("env_kwargs", "eval_env_kwargs"):
        if words := getattr(args, key, None):
            named = parse_assignments(words, f"--{key.replace('_', '-')}")
            found = layered(found, {key: named})
    return found | {key: n for key, n in given(args, BUDGETS).items() if n > 0}


def write_result(args: argparse.Namespace, data: Any) -> None:
    """Write the result to the file of ``--json``, if one is given."""
    if args.json is not None:
        write_json(args.json, data)


def check_installed(wanted: object, what: str, extra: str, *modules: str) -> None:
    """Raise `UserError` if something is wanted whose modules are not installed."""
    if wanted and not all(map(importlib.util.find_spec, modules)):
        raise UserError(f"{what} needs: pip install 'rl-yardstick[{extra}]'")


def check_device(device: str) -> None:
    """Raise `UserError` if PyTorch lacks the device; the library would silently use the CPU."""
    if device not in ("auto", "cpu"):
        import torch as th

        try:
            th.zeros(1, device=device).item()
        except (RuntimeError, AssertionError) as error:
            raise UserError(f"--device: PyTorch has no {device!r} here") from error


def with_engine(algo: str, settings: Mapping[str, Any], word: str | None) -> dict[str, Any]:
    """The typed settings of an agent, with the value of ``--engine``, if given."""
    from rl_yardstick.pipeline.components import arguments_of

    if word is None:
        return dict(settings)
    said = settings.get("engine", word)
    if said != word:
        raise UserError(f"--engine {word} and -params engine:{said} disagree: give one of them")
    if word in ("auto", "library") and "engine" not in arguments_of(algo):
        return dict(settings)  # there is one engine
    return {**settings, "engine": word}
