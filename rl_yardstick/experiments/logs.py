"""Reads what other programs have logged of their runs; every file is data.

A folder with logs of its own is one run. A table has a row for each run, or for each step of each.
"""

from __future__ import annotations

import csv
import importlib.util
import io
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rl_yardstick.experiments.bandits import STATISTICS_FILE
from rl_yardstick.experiments.results import (
    LAST_EPISODES,
    MAX_TABLE,
    Episodes,
    evaluations_in,
    joined_episodes,
)
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import UserError, one_line, unknown
from rl_yardstick.pipeline.files import read_bytes
from rl_yardstick.pipeline.run import PULLS_FILE, RECORD, Run
from rl_yardstick.pipeline.settings import read_saved
from rl_yardstick.safe_files.files import opened

MOST_FILES = 200_000  # in a folder that is searched
# The kinds of final figures, the best first; those of tables are named as their columns.
FINAL, EVALUATION, TRAINING = "final", "evaluation", "training"
# The usual names of columns, in small letters, without what stands before a slash; best first.
NAMES = {
    "agent": "agent algo algorithm method agent_name algo_name name model",
    "env": "env environment env_id env_name task game",
    "seed": "seed run trial run_id n_simu simulation repetition",
    "step": "global_step total_timesteps timesteps_total timesteps timestep num_timesteps steps "
    "step episode iteration epoch",
    "score": "score final_score final_return mean_return mean_reward ep_rew_mean eprewmean "
    "episode_reward_mean avg_episodic_return episodic_return episode_return episode_reward "
    "episode_rewards average_return average_reward total_reward return returns eval_rewards reward "
    "rewards value r",
}
# Columns with an episode of training in each row, and with means over such episodes.
OF_EPISODES = ("episodic_return", "episode_return", "episode_reward", "episode_rewards", "r")
OF_MEANS = ("ep_rew_mean", "eprewmean", "episode_reward_mean", "avg_episodic_return")


@dataclass
class Log:
    """The log of one run."""

    place: str  #: its folder, its file without the suffix, or its name in a table
    path: Path  #: the folder or file
    labels: Mapping[str, str] = field(default_factory=dict)  #: agent, env and seed, as far as told
    env: str = ""  #: its environment, where a header or a file of settings tells it
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)  #: the environment's arguments
    figures: dict[str, float] = field(default_factory=dict)  #: final figures by kind
    lines: dict[str, Episodes] = field(default_factory=dict)  #: learning curves by kind
    recorded: Mapping[str, Any] = field(default_factory=dict)  #: all figures of `FINAL`
    has_events_only: bool = False  #: as beside another log of the same run

    def add(self, name: str, steps: Floats, values: Floats) -> None:
        """Add the curve in a column, and its final figure, unless there is one of this kind."""
        there = np.isfinite(steps) & np.isfinite(values)
        order = np.argsort(steps[there], kind="stable")
        steps, values = steps[there][order], values[there][order]
        kind, n = kind_of(name), LAST_EPISODES if _short(name) in OF_EPISODES else 1
        if len(values) and kind not in self.figures:
            self.figures[kind] = float(values[-n:].mean())
            self.lines[kind] = Episodes(steps, values, np.zeros(len(steps)))


@dataclass
class Found:
    """All logs in what was given, and remarks on them."""

    logs: list[Log] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)  #: of each file that is no log, the reason


def find_logs(paths: Sequence[Path], columns: Mapping[str, str]) -> Found:
    """Read all logs in files and folders; ``columns`` has a table's own names by those in `NAMES`.

    Raises:
        UserError: if a named file is no log, or nothing was found.
    """
    found, typed = Found(), dict[Path, list[str]]()
    for path in paths:
        if path.is_dir():
            for folder, names in _folders(path):
                _read_folder(folder, names, columns, found)
        elif path.is_file():
            typed.setdefault(path.parent, []).append(path.name)
        else:
            raise UserError(f"{path}: no such file or folder")
    n_skipped = len(found.skipped)
    for folder, names in typed.items():
        _read_folder(folder, sorted(names), columns, found)
    if found.skipped[n_skipped:]:
        raise UserError(found.skipped[n_skipped])
    if not found.logs:
        first = f" ({found.skipped[0]})" if found.skipped else ""
        kinds = "monitor.csv, evaluations.npz, progress.csv, event files or tables as .csv"
        raise UserError(
            f"no logs in {', '.join(map(str, paths))}: give folders with {kinds}{first}"
        )
    if found.skipped:
        n = f"{len(found.skipped):,} file{'s' * (len(found.skipped) > 1)}"
        found.notes.append(f"skipped {n}: {'; '.join(found.skipped[:3])}")
    return found


def _folders(root: Path) -> Iterator[tuple[Path, list[str]]]:
    """All folders below one, except hidden ones, with the names of their files."""
    n_files = 0
    for folder, below, names in os.walk(root):
        below[:] = sorted(name for name in below if not name.startswith("."))
        n_files += len(names)
        if n_files > MOST_FILES:
            raise UserError(f"{root} holds over {MOST_FILES:,} files: name a folder below it")
        # This project has written the tables beside its verdicts.
        yield Path(folder), [] if "verdicts.json" in names else sorted(names)


_NO_LOGS = ("diagnosis.csv", "value_maps.npz", PULLS_FILE, STATISTICS_FILE)  # of run folders


def _read_folder(
    folder: Path, names: Sequence[str], columns: Mapping[str, str], found: Found
) -> None:
    """Read the logs among these files of a folder."""
    of_run = [name for name in names if _OF_RUN.fullmatch(name)]
    log = Log(str(folder.resolve()), folder)
    log.has_events_only = all(".tfevents." in name for name in of_run)
    for read in (_read_settings, _read_monitors, _read_evaluations, _read_progress, _read_events):
        with _noted(found):
            read(log, of_run, found.notes)
    found.logs += [log] if log.figures else []
    for name in names:
        path, start = folder / name, re.sub(r"[._-]?(monitor\.csv|npz)$", "", name)
        if name in (*of_run, *_NO_LOGS) or name.startswith("."):
            continue
        with _noted(found):
            log = Log(str(folder.resolve() / start), path)
            if name.endswith("monitor.csv"):
                _read_monitors(log, [name], found.notes)
            elif name.endswith(".npz"):
                log.add(EVALUATION, *evaluations_in(path))
            elif path.suffix in (".csv", ".tsv"):
                found.logs += table_logs(_read_table(path, found.notes), path, columns, found.notes)
            found.logs += [log] if log.figures else []


@contextmanager
def _noted(found: Found) -> Iterator[None]:
    """Note the error of a file that is no log."""
    try:
        yield
    except (UserError, OSError) as error:
        found.skipped.append(one_line(error))


# --- run folders ----------------------------------------------------------------------------------

_OF_RUN = re.compile(
    r"(\d+\.)?monitor\.csv|evaluations\.npz|progress\.csv|.*\.tfevents\..*|" + re.escape(RECORD)
)


def _read_settings(log: Log, names: Sequence[str], notes: list[str]) -> None:
    """Read what a run of this project or of rl_zoo3 has recorded of itself."""
    for file in ("config.yml", "args.yml"):  # rl_zoo3 uses the latter before the former
        for path in log.path.glob(f"*/{file}") if names else ():
            saved = read_saved(path)
            if isinstance(saved.get("env"), str):
                log.env = saved["env"]
            if saved.get("env_kwargs") and isinstance(saved["env_kwargs"], dict):
                log.env_kwargs = saved["env_kwargs"]
    final = Run(log.path).recorded().get("final") if RECORD in names else None
    if isinstance(final, dict) and isinstance(final.get("mean_return"), int | float):
        texts = ("acts_by", "measured_by")
        kinds = {name: str if name in texts else int | float for name in final}
        log.recorded = {name: one for name, one in final.items() if isinstance(one, kinds[name])}
        log.figures[FINAL] = float(final["mean_return"])


def _read_monitors(log: Log, names: Sequence[str], notes: list[str]) -> None:
    """Read the episodes in Monitor's files, one file for each environment of the run."""
    paths = [log.path / name for name in names] if log.path.is_dir() else [log.path]
    tables = [_monitor_table(log, p, notes) for p in paths if p.name.endswith("monitor.csv")]
    if tables := [table for table in tables if len(table)]:
        log.lines[TRAINING] = joined_episodes(tables)
        means = [table[-LAST_EPISODES:, 0].mean() for table in tables]
        log.figures[TRAINING] = float(np.mean(means))


def _monitor_table(log: Log, path: Path, notes: list[str]) -> Floats:
    """Return, length and time of each episode, shape (n, 3).

    A row whose cells are no episode, or not as many as in the header or first row, is skipped.
    """
    text = read_bytes(path, MAX_TABLE).decode(errors="replace").replace("\0", "")
    lines, names, rows, faulty = text.splitlines(), list[str](), list[list[float]](), list[str]()
    for number, line in enumerate(lines, start=1):
        cells = line.split(",") if '"' not in line else next(csv.reader([line]))
        if line.startswith("#"):
            with suppress(ValueError, AttributeError, RecursionError):
                log.env = log.env or str(json.loads(line[1:]).get("env_id") or "")
        elif {"r", "l"} <= {*cells}:
            names = cells
        elif line.strip():
            names = names or ["r", "l", "t", *map(str, range(3, len(cells)))]
            with suppress(ValueError, LookupError):
                named = dict(zip(names, cells, strict=True))
                row = [float(named[name]) for name in "rlt"]
                if np.isfinite(row).all() and row[1] >= 1:
                    rows.append(row)
                    continue
            faulty.append(str(number))
    if faulty and not rows:
        raise UserError(f"{path} is no log of episodes: it needs rows of r,l,t")
    if faulty:
        which = f"line{'s' * (len(faulty) > 1)} {', '.join(faulty[:5])}"
        more = f" and {len(faulty) - 5:,} more" if len(faulty) > 5 else ""
        notes.append(f"{path}: skipped {which}{more}: no row of {','.join(names)}")
    return np.array(rows).reshape(-1, 3)


def _read_evaluations(log: Log, names: Sequence[str], notes: list[str]) -> None:
    if "evaluations.npz" in names:
        log.add(EVALUATION, *evaluations_in(log.path / "evaluations.npz"))


def _read_progress(log: Log, names: Sequence[str], notes: list[str]) -> None:
    if "progress.csv" in names:
        table = _read_table(log.path / "progress.csv", notes)
        named = _named_columns(table, {}, log.path)
        _add_columns(log, table, named.get("step"), _score_columns(table, named))


def _read_events(log: Log, names: Sequence[str], notes: list[str]) -> None:
    """Read the returns in TensorBoard's event files, by tag."""
    paths = [log.path / name for name in names if ".tfevents." in name]
    if not paths:
        return
    if importlib.util.find_spec("tensorboard") is None:
        raise UserError(f"{paths[0]} needs: pip install 'rl-yardstick[tensorboard]'")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for path in paths:
        opened(path, MAX_TABLE).close()
    events = EventAccumulator(str(log.path), {"scalars": 0})
    try:
        events.Reload()
        found = {tag: events.Scalars(tag) for tag in events.Tags()["scalars"] if _rank(tag)}
    except Exception as error:
        raise UserError(f"{paths[0]} is damaged: {one_line(error)}") from error
    for tag, scalars in sorted(found.items(), key=lambda item: _rank(item[0]) or ()):
        log.add(tag, *np.array([(one.step, one.value) for one in scalars], np.float64).T)


# --- tables ---------------------------------------------------------------------------------------


def _short(name: str) -> str:
    """A column's name in small letters, without what stands before a slash."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower().rpartition("/")[2]).strip("_")


def kind_of(name: str) -> str:
    """The kind of figure in a column: of evaluations, of training episodes, or its own name."""
    if "eval" in name.lower():
        return EVALUATION
    return TRAINING if _short(name) in (*OF_EPISODES, *OF_MEANS, TRAINING) else name


def _rank(name: str) -> tuple[bool, int] | None:
    """The place of a column among those that hold returns, the best first; None for others."""
    known, short = NAMES["score"].split(), _short(name)
    return (kind_of(name) != EVALUATION, known.index(short)) if short in known else None


def _read_table(path: Path, notes: list[str]) -> pd.DataFrame:
    """A text table with a row of headings; commas, semicolons or tabs separate its cells."""
    content = read_bytes(path, MAX_TABLE).decode(errors="replace")
    separator = max(",;\t", key=content.partition("\n")[0].count)
    try:
        table = pd.read_csv(io.StringIO(content), sep=separator, on_bad_lines="skip")
    except (ValueError, RecursionError, MemoryError) as error:
        raise UserError(f"{path} is no table: {one_line(error)}") from error
    if n := sum(map(bool, map(str.strip, content.splitlines()))) - 1 - len(table):
        notes.append(f"{path}: skipped {n:,} rows with more cells than headings")
    return table


def table_logs(
    table: pd.DataFrame, path: Path, columns: Mapping[str, str], notes: list[str]
) -> list[Log]:
    """The runs in a table; UserError if it has no column of returns."""
    table = _untagged(table.rename(columns=str))
    if charts := _chart_logs(table, path):
        return charts
    names = _named_columns(table, columns, path)
    scores = [columns["score"]] if "score" in columns else _score_columns(table, names)
    if not scores:
        held = ", ".join(table.columns[:8])
        raise UserError(f"{path} has no known column of returns ({held}): --columns score=NAME")
    table = table[table[scores].apply(pd.to_numeric, errors="coerce").notna().any(axis=1)]
    keys, step = [names[key] for key in ("agent", "env") if key in names], names.get("step")
    if "seed" not in names and (keys or step is None):
        table, names["seed"] = table.assign(**{_RUN: _run_numbers(table, keys, step)}), _RUN
        taken = "each row" if step is None else f"each start, where {step!r} falls,"
        notes.append(f"{path} has no column of seeds: {taken} counts as a seed")
    told = [key for key in ("agent", "env", "seed") if key in names]
    keys, logs = [names[key] for key in told], []
    for values, rows in table.groupby(keys, sort=False) if keys else [((), table)]:
        labels = dict(zip(told, map(_label, values), strict=True))
        place = path.with_name(re.sub(r"^run-|-tag-.*$", "", path.stem))  # of TensorBoard's page
        log = Log(", ".join([str(path), *labels.values()]) if labels else str(place), path, labels)
        _add_columns(log, rows, step, scores)
        logs += [log] if log.figures else []
    return logs


_RUN = "number of the run"


def _label(value: Any) -> str:
    is_whole = isinstance(value, float) and value.is_integer()
    return str(int(value) if is_whole else value)


def _named_columns(table: pd.DataFrame, columns: Mapping[str, str], path: Path) -> dict[str, str]:
    """The columns of agent, environment, seed and step that are given, or have usual names."""
    for given in columns.values():
        if given not in table.columns:
            raise unknown(f"{path}: no column", given, table.columns)
    filled = {_short(name): name for name in table.columns[::-1] if table[name].notna().any()}
    found = {key: known for key, known in columns.items() if key != "score"}
    for key in {"agent", "env", "seed", "step"} - found.keys():
        if usual := [filled[name] for name in NAMES[key].split() if name in filled]:
            found[key] = usual[0]
    return found


def _score_columns(table: pd.DataFrame, names: Mapping[str, str]) -> list[str]:
    """The columns of returns: the best of each kind."""
    ranks = {name: _rank(name) for name in table.columns if name not in names.values()}
    ranked = sorted((rank, name) for name, rank in ranks.items() if rank is not None)
    return list({kind_of(name): name for _, name in ranked[::-1]}.values())


def _add_columns(log: Log, rows: pd.DataFrame, step: str | None, scores: Sequence[str]) -> None:
    """Add the curves or the mean figures in the rows of a run."""
    for name in scores:
        values = pd.to_numeric(rows[name], errors="coerce").to_numpy(np.float64)
        is_of_episodes = step is None and _short(name) in OF_EPISODES
        if step is None and not is_of_episodes and np.isfinite(values).any():
            log.figures.setdefault(kind_of(name), float(np.nanmean(values)))
        elif step is None:
            log.add(name, np.arange(1.0, len(values) + 1), values)
        else:
            steps = pd.to_numeric(rows[step], errors="coerce").to_numpy(np.float64)
            log.add("r" if _short(step) == "episode" else name, steps, values)


def _run_numbers(table: pd.DataFrame, keys: Sequence[str], step: str | None) -> pd.Series:
    """Numbers from 0 of the runs of an agent on an environment, where no column has them."""
    by = [table[key] for key in keys] or [pd.Series(0, table.index)]
    if step is None:
        return table.groupby(by).cumcount()
    falls = pd.to_numeric(table[step], errors="coerce").groupby(by).diff() < 0
    return falls.groupby(by).cumsum()


def _untagged(table: pd.DataFrame) -> pd.DataFrame:
    """A table with the values of each tag in a column of its own, as rlberry exports them."""
    if not {"tag", "value"} <= {*table.columns}:
        return table
    tags = [tag for tag in table["tag"].dropna().unique() if _rank(str(tag))]
    columns = {str(tag): table["value"].where(table["tag"] == tag) for tag in tags}
    return table.drop(columns=["tag", "value"]).assign(**columns)


def _chart_logs(table: pd.DataFrame, path: Path) -> list[Log]:
    """The runs of a chart that Weights & Biases exported, with columns ``NAME - METRIC``."""
    logs: dict[str, Log] = {}
    for column in table.columns[1:]:
        name, _, metric = column.rpartition(" - ")
        if name and _rank(metric):
            name = re.sub(r"^[^:/]+: ", "", name)  # of a group
            values = table[column].to_numpy(np.float64)
            logs.setdefault(name, Log(name, path)).add(
                metric, table.iloc[:, 0].to_numpy(np.float64), values
            )
    return list(logs.values())
