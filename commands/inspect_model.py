"""``yardstick inspect``: what a model file holds, and what in it is suspicious; none of it is run.

From a checkout: ``python -m commands.inspect_model model.zip``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from commands.parsing import OneLineParser, run_command
from commands.terminal import table_console
from pipeline.errors import UserError, one_line

SUSPICIOUS = 1


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = OneLineParser(
        description="Print what a model zip contains and what is suspicious. Nothing in it is run.",
        epilog="Exit code: 0 if nothing is suspicious, 1 if something is, 2 if it is no model.",
    )
    parser.add_argument("model", metavar="ZIP", help="zip of an agent of Stable-Baselines3 or ours")
    return parser


def main() -> int:
    """Parse the arguments and print what the file holds; the exit code."""
    path = Path(build_parser().parse_args().model)
    from safe_files import inspect_model

    try:
        report = inspect_model(path)
    except FileNotFoundError:
        raise UserError(f"no such model file: {path}") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is no model: {one_line(error)}") from error
    _print("members", {name: f"{size:,} bytes" for name, size in report.sizes.items()})
    _print("weights", {name: str(shape) for name, shape in report.weights.items()})
    _print("settings", report.settings)
    if not report.suspicious:
        _print("nothing in it is suspicious", {})
        return 0
    _print("suspicious", dict.fromkeys(report.suspicious, ""))
    return SUSPICIOUS


def _print(title: str, lines: Mapping[str, str]) -> None:
    width = max(map(len, lines), default=0)
    rows = [f"  {name:<{width}}  {text}".rstrip() for name, text in lines.items()]
    table_console().print("\n".join([title, *rows]), highlight=False, soft_wrap=True)


if __name__ == "__main__":
    run_command(main)
