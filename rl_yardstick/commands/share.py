"""``yardstick pack`` makes packs for others, and ``yardstick inspect`` checks files of others.

From a checkout: ``python -m commands.share pack logs/ppo/Warehouse-v0_1`` and
``python -m commands.share inspect model.zip``.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rl_yardstick.commands.cli import NAME, OneLineParser, filled, run_command
from rl_yardstick.pipeline.errors import UserError, one_line

SUSPICIOUS = 1  # exit code

ABOUT_PACKS = """\
The pack of a run holds the model, its settings and statistics, pictures, a film if a .gif or .mp4
is in the run folder, the results, modules of yours that it needs, and the digest of each file. The
pack of a study holds its page, tables, figures and settings, and the packs of its runs. Paths of
this machine are left out.
"""


def pack() -> int:
    """Pack a finished run or a study for others, or check a pack; return the exit code."""
    parser = OneLineParser(
        description="Pack a finished run, or a study, for others, with a card.",
        epilog=ABOUT_PACKS,
        formatter_class=argparse.HelpFormatter,
    )
    add = parser.add_argument
    add("run", type=filled, metavar="RUN", help="folder of a run or a study; with --check, a pack")
    add(
        "target",
        nargs="?",
        type=filled,
        metavar="TARGET",
        help="folder to make, or .zip to write (default: a folder named after agent, environment "
        "and seed; of a study, a zip with its name)",
    )
    add("--check", action="store_true", help="compare every file of a pack with its digest instead")
    args = parser.parse_args()
    from rl_yardstick.commands.terminal import TextConsole, say
    from rl_yardstick.pipeline.packs import check_pack
    from rl_yardstick.pipeline.stopping import stops_noticed

    console, path = TextConsole(highlight=False), Path(args.run)
    if not path.exists():
        raise UserError(f"{path}: there is no such run folder or pack")
    if args.check:
        if args.target is not None:
            raise UserError(f"--check writes nothing: leave out {args.target}")
        say(console, f"{path}: {check_pack(path)} files, each as it was packed")
        return 0
    if not path.is_dir():
        raise UserError(f"{path} is a file: name the folder of a run")
    with stops_noticed():
        _pack(path, None if args.target is None else Path(args.target), partial(say, console))
    return 0


def _pack(path: Path, target: Path | None, tell: Callable[[str], None]) -> None:
    """Pack a run or a study, and print the command that plays it on any machine."""
    from rl_yardstick.pipeline.model_card import to_type
    from rl_yardstick.pipeline.models.find import run_in
    from rl_yardstick.pipeline.packs import default_target, is_study, pack, pack_study
    from rl_yardstick.pipeline.user_modules import COPIES

    if is_study(path):
        target = target or Path(f"{path.resolve().name}.zip")
        made = pack_study(path, target, tell)
        runs = "1 run" if made.n_runs == 1 else f"{made.n_runs:,} runs"
        tell(f"pack  {target} ({runs}, {target.stat().st_size / 1e6:.1f} MB)")
        modules, names = made.modules, list(made.digests)
        place, inside = f"{target.name}/{made.first}", made.first
    else:
        target = pack(path, target or default_target(path))
        tell(f"pack  {target}")
        info = run_in(path).read_info()
        modules, names = to_type(info["spec"], info["files"]), list(info["files"])
        place, inside = target.name, "."
    flag = f" --gym-packages {shlex.join(modules)}" if modules else ""
    code = [name for name in names if name.startswith(f"{COPIES}/")]
    if code:
        tell(f"code of yours is in it: {' '.join(sorted(code))}")
        how = f"unzip {target.name}, and in its folder" if target.suffix == ".zip" else "in it"
        tell(f"play  {how}: {NAME} enjoy {shlex.quote(inside)}{flag}")
    else:
        tell(f"play  {NAME} enjoy {shlex.quote(place)}{flag}")


def inspect() -> int:
    """Print the contents of a model file and what is suspicious; return the exit code."""
    parser = OneLineParser(
        description="Print what a model zip contains and what is suspicious. Nothing in it is run.",
        epilog="Exit code: 0 if nothing is suspicious, 1 if something is, 2 if it is no model.",
        formatter_class=argparse.HelpFormatter,
    )
    parser.add_argument("model", metavar="ZIP", help="zip of an agent of Stable-Baselines3 or ours")
    path = Path(parser.parse_args().model)
    from rl_yardstick.commands.terminal import say, table_console
    from rl_yardstick.safe_files.models import inspect_model

    try:
        found = inspect_model(path)
    except FileNotFoundError:
        raise UserError(f"no such model file: {path}") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is no model: {one_line(error)}") from error
    suspicious = found.pop("suspicious")
    found["suspicious" if suspicious else "nothing in it is suspicious"] = suspicious
    console = table_console()
    for title, lines in found.items():
        width = max(map(len, lines), default=0)
        rows = [f"  {name:<{width}}  {text}".rstrip() for name, text in lines.items()]
        say(console, "\n".join([title, *rows]))
    return SUSPICIOUS if suspicious else 0


if __name__ == "__main__":
    parser = OneLineParser(prog="rl_yardstick.commands.share", epilog="Each has its own help.")
    parser.add_argument("command", choices=("pack", "inspect"))
    wanted = parser.parse_args(sys.argv[1:2]).command
    sys.argv = [f"{NAME} {wanted}", *sys.argv[2:]]
    run_command(pack if wanted == "pack" else inspect)
