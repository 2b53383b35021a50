"""``rate``: how good Q-tables, models and own policies are, against the exact optimum."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import OneLineParser, flag, several, shared
from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from rl_yardstick.rating.ratings import Rating

# Suffixes of the files below a folder that are rated.
SUFFIXES = (".npy", ".npz", ".pkl", ".pickle", ".json", ".csv", ".pt", ".pth", ".zip")

EPILOG = """\
examples:
  python -m rl_yardstick rate q_table.npy --env FrozenLake-v1
  python -m rl_yardstick rate q.pkl --env FrozenLake-v1 --env-kwargs map_name:8x8
  python -m rl_yardstick rate homework/ --env Taxi-v4 --table marks.csv
  python -m rl_yardstick rate script.py:policy --env Blackjack-v1   # its code runs

Files are read as data; a script runs, because you typed its name. Exit code: 0, also if some of
several files cannot be rated; 2 if the only one cannot.
"""


def build_parser() -> OneLineParser:
    """The flags."""
    words = "Rate Q-tables, models and policies against the exact optimum."
    told = "table, model zip or run folder; a folder of those; or script.py:policy"
    bins = "of observations, as in bins:10 low:[-2,-3] high:[2,3]"
    flags = (
        flag("files", told, nargs="+", metavar="FILE"),
        flag("--env", "environment id (default: as in the file or run folder)"),
        flag("--algo", "agent in a zip that lies in no run folder"),
        *shared("--env-kwargs", "--gym-packages"),
        several("--bins", bins),
        flag("--table --csv", "also write the table to this file", Path, metavar="FILE"),
        *shared("--json"),
    )
    return OneLineParser(words, EPILOG, {"": flags})


def main() -> int:
    """Rate files."""
    args = build_parser().parse_args()
    cli.import_typed(args)
    from rl_yardstick.commands.terminal import say, table_console
    from rl_yardstick.pipeline.files import write_json, write_text

    console = table_console()
    with console.status("rating"):
        rated = _ratings(args)
    _print_table(console, rated)
    for one in rated.values():
        if len(rated) == 1 and not isinstance(one, str):
            say(console, "\n".join(_details(one)))
    if args.table is not None:
        import pandas as pd

        rows = pd.DataFrame([_row(name, one) for name, one in rated.items()])
        write_text(args.table, rows.to_csv(index=False, lineterminator="\n"))
    if args.json is not None:
        found = {
            name: one if isinstance(one, str) else one.as_data() for name, one in rated.items()
        }
        write_json(args.json, found)
    return 0


def _ratings(args: Any) -> dict[str, Rating | str]:
    """The ratings by name, or why something could not be rated."""
    from rl_yardstick.pipeline.settings import parse_assignments
    from rl_yardstick.rating.ratings import is_model, rated_file, rated_model
    from rl_yardstick.rating.worlds import World, world_of

    kwargs = parse_assignments(args.env_kwargs, "--env-kwargs")
    bins = parse_assignments(args.bins, "--bins")

    made = cache(lambda env_id: world_of(env_id, kwargs, bins))

    def world(named: str | None) -> World:
        if not (args.env or named):
            raise UserError("names no environment: add --env ID")
        found: World = made(args.env or named)
        return found

    if args.env:
        made(args.env)
    found: dict[str, Rating | str] = {}
    paths = [path for typed in args.files for path in _below(Path(typed))]
    if not paths:
        suffixes = ", ".join(SUFFIXES)
        raise UserError(f"{args.files[0]} holds no file to rate: none ends in {suffixes}")
    for path in paths:
        try:
            if _is_script(path):
                found[str(path)] = _rated_script(str(path), world(None))
            elif is_model(path):
                wanted = {"env_id": args.env or None, "env_kwargs": kwargs, "algo": args.algo}
                wanted |= {"typed": args.gym_packages}
                found[str(path)] = rated_model(path, wanted, len(paths) == 1)
            else:
                found |= rated_file(path, world, len(paths) == 1)
        except UserError as error:
            fault = str(error).removeprefix(f"{path} ").removeprefix(f"{path}: ")
            if len(paths) == 1:
                raise UserError(f"{path}: {fault}") from error
            found[str(path)] = fault
    return found


def _below(path: Path) -> Iterator[Path]:
    """A path, or the files and run folders below a folder that is no run."""
    from rl_yardstick.rating.ratings import is_model

    if not path.is_dir() or is_model(path):
        yield path
        return
    for member in sorted(path.iterdir()):
        if member.name.startswith((".", "__")) or (member.is_dir() and member.is_symlink()):
            continue
        if member.is_dir() or member.suffix.lower() in SUFFIXES:
            yield from _below(member)


def _is_script(path: Path) -> bool:
    module, colon, name = str(path).rpartition(":")
    return bool(colon and module and name.isidentifier() and not path.exists())


def _rated_script(typed: str, world: Any) -> Rating:
    """The rating of something in a module of the user, which is imported."""
    from rl_yardstick.pipeline.components import import_modules, module_name
    from rl_yardstick.rating.ratings import acting, rated_function

    module, _, name = typed.rpartition(":")
    try:
        import_modules([module])
    except UserError as error:
        raise UserError(str(error).replace(f"--gym-packages {module}", typed)) from error
    found = getattr(sys.modules[module_name(module)], name, None)
    act = acting(found() if isinstance(found, type) else found)
    if act is None:
        raise UserError(f"{typed} is no function, and has no act, predict or get_action")
    rated = rated_function(act, world, typed)
    return replace(rated, notes=(*rated.notes, "its own code ran"))


# --- what is shown --------------------------------------------------------------------------------


def _row(name: str, rated: Rating | str) -> dict[str, Any]:
    """The row of the tables."""
    row: dict[str, Any] = {"file": name}
    row |= dict.fromkeys(("return", "optimum", "score", "success", "environment", "note"), "")
    if isinstance(rated, str):
        return {**row, "note": rated}
    row |= {"environment": rated.environment, "note": "; ".join(rated.notes[:2])}
    numbers = {"return": rated.mean_return, "optimum": rated.optimum, "score": rated.score}
    numbers["success"] = rated.success_rate
    return row | {key: number for key, number in numbers.items() if number is not None}


def _print_table(console: Any, rated: dict[str, Rating | str]) -> None:
    from rich.table import Table

    from rl_yardstick.commands.terminal import figures
    from rl_yardstick.rating.ratings import floored

    rows = [_row(name, one) for name, one in rated.items()]
    environments = sorted({row["environment"] for row in rows} - {""})
    table = Table(title=", ".join(environments), title_justify="left")
    table.add_column("file", overflow="fold", max_width=26)
    for name in ("return", "optimum", "score"):
        table.add_column(name, justify="right", no_wrap=True)
    if len(rows) > 1:
        table.add_column("note", overflow="fold")
    for row in rows:
        known = [row[key] for key in ("return", "optimum") if row[key] != ""]
        numbers = [*figures(*known), "", ""][:2]
        score = "" if row["score"] == "" else floored(row["score"])
        table.add_row(*[row["file"], *numbers, score, row["note"]][: len(table.columns)])
    console.print(table)
    if n_failed := sum(isinstance(one, str) for one in rated.values()):
        console.print(f"{n_failed} of {len(rated)} could not be rated")


def _details(rating: Rating) -> Iterator[str]:
    """The scale, the notes, the map, and where it loses."""
    from rl_yardstick.commands.terminal import result_lines
    from rl_yardstick.report.words import why_lines

    yield from result_lines(rating.evaluation)
    yield from rating.notes
    yield from filter(None, [rating.map])
    if rating.explanation is not None:
        yield from why_lines(rating.explanation)
