"""``yardstick pack``: a finished run, or a study, for others, with a card.

From a checkout: ``python -m commands.pack_run logs/ppo/Warehouse-v0_1``.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path

from commands.flag_values import filled
from commands.parsing import NAME, OneLineParser, run_command

EPILOG = """\
The pack of a run holds the model, its settings and statistics, pictures, a film if a .gif or .mp4
lies in the run folder, what came out, modules of yours that it needs, and the digest of each file.
That of a study holds its page, tables, figures and settings, and the packs of its runs. Paths of
this machine are left out.
"""


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = OneLineParser(
        description="Pack a finished run, or a study, for others, with a card.",
        epilog=EPILOG,
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
    return parser


def main() -> int:
    """Parse the arguments and pack, or check; the exit code."""
    args = build_parser().parse_args()
    from commands.terminal import TextConsole
    from pipeline.errors import UserError
    from pipeline.packing.pack_files import check_pack
    from pipeline.stopping import stops_noticed

    console, path = TextConsole(highlight=False), Path(args.run)
    say = partial(console.print, soft_wrap=True)
    if not path.exists():
        raise UserError(f"{path}: there is no such run folder or pack")
    if args.check:
        if args.target is not None:
            raise UserError(f"--check writes nothing: leave out {args.target}")
        say(f"{path}: {check_pack(path)} files, each as it was packed")
        return 0
    if not path.is_dir():
        raise UserError(f"{path} is a file: name the folder of a run")
    with stops_noticed():
        _pack(path, None if args.target is None else Path(args.target), say)
    return 0


def _pack(path: Path, target: Path | None, say: Callable[[str], object]) -> None:
    """Pack a run or a study, and say how it is played on any machine."""
    from pipeline.models.find import run_in
    from pipeline.module_records import COPIES
    from pipeline.packing.model_card import to_type
    from pipeline.packing.pack_files import default_target, pack
    from pipeline.packing.study_packs import is_study, pack_study

    if is_study(path):
        target = target or Path(f"{path.resolve().name}.zip")
        made = pack_study(path, target, say)
        runs = "1 run" if made.n_runs == 1 else f"{made.n_runs:,} runs"
        say(f"pack  {target} ({runs}, {target.stat().st_size / 1e6:.1f} MB)")
        modules, names = made.modules, list(made.digests)
        place, inside = f"{target.name}/{made.first}", made.first
    else:
        target = pack(path, target or default_target(path))
        say(f"pack  {target}")
        info = run_in(path).read_info()
        modules, names = to_type(info["spec"], info["files"]), list(info["files"])
        place, inside = target.name, "."
    flag = f" --gym-packages {shlex.join(modules)}" if modules else ""
    code = [name for name in names if name.startswith(f"{COPIES}/")]
    if code:
        say(f"code of yours is in it: {' '.join(sorted(code))}")
        how = f"unzip {target.name}, and in its folder" if target.suffix == ".zip" else "in it"
        say(f"play  {how}: {NAME} enjoy {shlex.quote(inside)}{flag}")
    else:
        say(f"play  {NAME} enjoy {shlex.quote(place)}{flag}")


if __name__ == "__main__":
    run_command(main)
