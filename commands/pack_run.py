"""``yardstick pack``: a finished run as a folder or a zip for others, with a card for model hubs.

From a checkout: ``python -m commands.pack_run logs/ppo/Warehouse-v0_1``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from commands.flag_values import filled
from commands.parsing import OneLineParser, called_as, run_command

EPILOG = """\
The pack holds the model, its settings and statistics, pictures, a film if a .gif or .mp4 lies in
the run folder, what came out, and the digest of each file. Paths of this machine are left out.
"""


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = OneLineParser(
        description="Pack a finished run for others: a folder or a zip, with a model card.",
        epilog=EPILOG,
    )
    add = parser.add_argument
    add("run", type=filled, metavar="RUN", help="run folder; with --check, a pack")
    add(
        "target",
        nargs="?",
        type=filled,
        metavar="TARGET",
        help="folder to make, or .zip to write (default: a folder named after agent, environment "
        "and seed)",
    )
    add("--check", action="store_true", help="compare every file of a pack with its digest instead")
    return parser


def main() -> int:
    """Parse the arguments and pack, or check; the exit code."""
    args = build_parser().parse_args()
    from commands.terminal import TextConsole
    from pipeline.errors import UserError
    from pipeline.packing.pack_files import check_pack, default_target, pack
    from pipeline.stopping import stops_noticed

    console, path = TextConsole(highlight=False), Path(args.run)
    if not path.exists():
        raise UserError(f"{path}: there is no such run folder or pack")
    if args.check:
        if args.target is not None:
            raise UserError(f"--check writes nothing: leave out {args.target}")
        told = f"{path}: {check_pack(path)} files, each as it was packed"
        console.print(told, soft_wrap=True)
        return 0
    if not path.is_dir():
        raise UserError(f"{path} is a file: name the folder of a run")
    with stops_noticed():
        target = pack(path, default_target(path) if args.target is None else Path(args.target))
    console.print(f"pack  {target}", soft_wrap=True)
    console.print(f"play  {called_as('enjoy')} {target}", soft_wrap=True)
    return 0


if __name__ == "__main__":
    run_command(main)
