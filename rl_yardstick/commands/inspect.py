"""``yardstick inspect``: the content of a model file, read without running any of it."""

from __future__ import annotations

from pathlib import Path

from rl_yardstick.commands.cli import OneLineParser
from rl_yardstick.commands.terminal import say, table_console
from rl_yardstick.pipeline.errors import UserError, as_user_error


def main() -> int:
    """Print the content of a model file and what is suspicious; return the exit code."""
    words = "List the content of a model zip and what is suspicious. Nothing in it is run."
    codes = "Exit code: 0 if nothing is suspicious, 1 if something is, 2 if it is no model."
    parser = OneLineParser(words, codes)
    parser.add_argument("model", type=Path, metavar="ZIP", help="zip of an agent")
    path = parser.parse_args().model

    from rl_yardstick.safe_files.models import inspect_model

    if not path.exists():
        raise UserError(f"no such model file: {path}")
    with as_user_error(f"{path} is no model", OSError, ValueError):
        found = inspect_model(path)
    suspicious = found.pop("suspicious")
    found["suspicious" if suspicious else "nothing in it is suspicious"] = suspicious
    console = table_console()
    for title, lines in found.items():
        width = max(map(len, lines), default=0)
        rows = [f"  {name:<{width}}  {text}".rstrip() for name, text in lines.items()]
        say(console, "\n".join([title, *rows]))
    return int(bool(suspicious))
