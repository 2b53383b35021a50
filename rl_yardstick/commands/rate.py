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
from rl_yardstick.commands.terminal import result_lines, say, table_console
from rl_yardstick.pipeline.errors import UserError, unknown

if TYPE_CHECKING:
    from rl_yardstick.rating.ratings import Rating

SUFFIXES = (".npy", ".npz", ".pkl", ".pickle", ".json", ".csv", ".txt", ".pt", ".pth", ".zip")
COLUMNS = ("file", "return", "optimum", "score", "success", "environment", "note")

EPILOG = """\
examples:
  python -m rl_yardstick rate q_table.npy --env FrozenLake-v1
  python -m rl_yardstick rate q.pkl --env FrozenLake-v1 --env-kwargs map_name:8x8
  python -m rl_yardstick rate homework/ --env Taxi-v4 --table marks.csv
  python -m rl_yardstick rate script.py:policy --env Blackjack-v1   # its code runs

Files are read as data; a script runs, because you typed its name. Exit code: 0, also if some of
several files cannot be rated; 2 if none can.
"""


def build_parser() -> OneLineParser:
    """The flags."""
    words = "Rate Q-tables, models and policies against the exact optimum."
    told = "table, model zip or run folder; a folder of those; or script.py:policy"
    flags = (
        flag("files", told, nargs="+", metavar="FILE"),
        flag("--env", "environment id (default: as in the file or run folder)"),
        flag("--algo", "agent in a zip that lies in no run folder"),
        *shared("--env-kwargs", "--gym-packages"),
        several("--bins", "of observations, as in bins:10 low:[-2,-3] high:[2,3]"),
        flag("--table --csv", "also write the table to this file", Path, metavar="FILE"),
        *shared("--model", "--json"),
    )
    return OneLineParser(words, EPILOG, {"": flags})


def main() -> int:
    """Rate files; return 2 if none could be rated."""
    args = build_parser().parse_args()
    cli.import_typed(args)
    from rl_yardstick.pipeline.files import write_text
    from rl_yardstick.report.words import why_lines

    console = table_console()
    with console.status("rating"):
        rated = _ratings(args)
    rows = [_row(name, one) for name, one in rated.items()]
    if len(rows) > 1:
        _print_table(console, rows)
    elif not isinstance(one := next(iter(rated.values())), str):
        where = [] if one.explanation is None else why_lines(one.explanation)
        more = [] if one.exact else [f"standard error {one.std_return / one.n_episodes**0.5:.2g}"]
        lines = [*result_lines(one.evaluation, *more), *one.notes, *filter(None, [one.map]), *where]
        say(console, "\n".join([f"{one.name} on {one.environment}", *lines]))
    if args.table is not None:
        import pandas as pd

        frame = pd.DataFrame(rows, columns=COLUMNS)
        write_text(args.table, frame.to_csv(index=False, lineterminator="\n"))
    told = {k: one if isinstance(one, str) else one.as_data() for k, one in rated.items()}
    cli.write_result(args, told)
    return 2 * all("environment" not in row for row in rows)


def _ratings(args: Any) -> dict[str, Rating | str]:
    """The ratings by name, or why something could not be rated."""
    from rl_yardstick.pipeline.components import import_modules, module_name, split_class
    from rl_yardstick.pipeline.settings import parse_assignments
    from rl_yardstick.rating.ratings import content_of, is_model, rate, rated_model, rated_tables
    from rl_yardstick.rating.worlds import world_of

    kwargs = parse_assignments(args.env_kwargs, "--env-kwargs")
    bins = parse_assignments(args.bins, "--bins")
    world = cache(lambda named: world_of(args.env or named, kwargs, bins))
    if args.env:
        world(None)
    found: dict[str, Rating | str] = {}
    paths = [path for typed in args.files for path in _below(Path(typed))]
    if not paths:
        raise UserError(f"{args.files[0]} holds no file that ends in {', '.join(SUFFIXES)}")
    for path in paths:
        module, name = split_class(typed := str(path))
        try:
            if name and not path.exists():
                import_modules([module])
                if name not in (inside := vars(sys.modules[module_name(module)])):
                    raise unknown(f"{module} has no", name, inside)
                one = rate(inside[name], args.env, bins=bins, **kwargs)
                found[typed] = replace(one, name=typed, notes=(*one.notes, "its own code ran"))
            elif is_model(path):
                wanted = {"env_id": args.env, "env_kwargs": kwargs, "algo": args.algo}
                found[typed] = rated_model(path, {**wanted, "typed": args.gym_packages})
            else:
                found |= rated_tables(content_of(path), world, typed)
        except UserError as error:
            if len(paths) == 1:
                raise
            found[typed] = str(error).removeprefix(typed).lstrip(": ")
    return found


def _below(path: Path) -> Iterator[Path]:
    """A path, or the files with `SUFFIXES` and run folders below a folder that is no run."""
    from rl_yardstick.rating.ratings import is_model

    if not path.is_dir() or is_model(path):
        yield path
        return
    for one in sorted(path.iterdir()):
        is_wanted = not one.is_symlink() if one.is_dir() else one.suffix.lower() in SUFFIXES
        if is_wanted and not one.name.startswith((".", "__")):
            yield from _below(one)


def _row(name: str, rated: Rating | str) -> dict[str, Any]:
    if isinstance(rated, str):
        return {"file": name, "note": rated}
    figures = rated.mean_return, rated.optimum, rated.score, rated.success_rate
    cells = name, *figures, rated.environment, "; ".join(rated.notes[:2])
    return dict(zip(COLUMNS, cells, strict=True))


def _print_table(console: Any, rows: list[dict[str, Any]]) -> None:
    from rich.table import Table

    from rl_yardstick.report.words import number, score_number

    environments = sorted({row["environment"] for row in rows if "environment" in row})
    table = Table(title=", ".join(environments), title_justify="left")
    table.add_column("file", overflow="fold", max_width=26)
    for name in ("return", "optimum", "score"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("note", overflow="fold")
    for row in rows:
        figures = number(row.get("return")), number(row.get("optimum"))
        table.add_row(row["file"], *figures, score_number(row.get("score")), row["note"])
    console.print(table)
    if n_failed := sum("environment" not in row for row in rows):
        console.print(f"{n_failed} of {len(rows)} could not be rated")
