"""Reads the logs of runs that were done elsewhere; every file is data.

A folder with logs of its own is one run. A table has a row for each run, or for each step of each.
"""

from __future__ import annotations

import importlib.util
import io
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rl_yardstick.experiments.results import LAST_EPISODES as LAST
from rl_yardstick.experiments.results import read_evaluations
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import UserError, as_user_error, one_line, shown, unknown
from rl_yardstick.pipeline.files import MAX_TABLE, read_bytes
from rl_yardstick.pipeline.run import RECORD, Episodes, Run, joined_episodes
from rl_yardstick.pipeline.settings import read_saved

# The kinds of final figures, the best first; those of tables are named as their columns.
FINAL, EVALUATION, TRAINING, SAMPLED = "final", "evaluation", "training", "sampled"
WORDS = {
    FINAL: "return of the final policy",
    EVALUATION: "return in the last evaluation",
    TRAINING: f"return of the last {LAST} training episodes",
    SAMPLED: "return in the last tenth of the logged points of training",
}
# The usual names of columns, in small letters, without what stands before a slash; best first.
NAMES = {
    "agent": "agent algo algorithm method agent_name algo_name name model",
    "env": "env environment env_id env_name task game",
    "seed": "seed run trial run_id n_simu simulation repetition",
    "step": "episode global_step total_timesteps timesteps_total timesteps timestep num_timesteps "
    "steps step iteration epoch",
    "score": "score final_score final_return mean_return mean_reward ep_rew_mean eprewmean "
    "episode_reward_mean avg_episodic_return episodic_return episode_return episode_reward "
    "episode_rewards average_return average_reward total_reward return returns eval_rewards reward "
    "rewards value r",
}
# Columns with an episode of training in each row, and with means over such episodes.
OF_EPISODES = ("episodic_return", "episode_return", "episode_reward", "episode_rewards", "r")
OF_MEANS = ("ep_rew_mean", "eprewmean", "episode_reward_mean", "avg_episodic_return")
# Other files in run folders of this project.
_NO_LOGS = ("diagnosis.csv", "value_maps.npz", "pulls.npz", "pull_statistics.npz")
_MONITOR = r"((\d+|monitor)\.)?monitor\.csv"  # SB3 adds it to a name that is no folder's
_OF_RUN = re.compile(rf"{_MONITOR}|evaluations\.npz|progress\.csv|run\.json|.*tfevents.*")

NOTHING = Episodes(np.empty(0), np.empty(0), np.empty(0))


@dataclass
class Log:
    """The log of one run."""

    place: str  #: its folder, its file without the suffix, or its name in a table
    path: Path  #: the folder or file
    labels: Mapping[str, str] = field(default_factory=dict)  #: agent, env and seed, as far as told
    env: str = ""  #: its environment, where a header or a file of settings tells it
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)  #: the environment's arguments
    figures: dict[str, float] = field(default_factory=dict)  #: final figures by kind
    evaluations: Episodes = NOTHING  #: the curve of evaluations, or of a column of a table
    episodes: Episodes = NOTHING  #: those of training
    monitors: list[Floats] = field(default_factory=list)  #: those in each of Monitor's files

    def add(self, name: str, steps: Any, values: Any, axis: str = "") -> None:
        """Add the curve in a column, and its final figure, unless there is one of this kind."""
        rows = np.column_stack([steps, values]).astype(np.float64)
        rows = rows[np.isfinite(rows).all(axis=1)]
        steps, values = rows[np.argsort(rows[:, 0], kind="stable")].T
        is_every = len(steps) > 0 and np.ptp(steps) < 2 * len(steps)  # else a sample of episodes
        name = "r" if is_every and axis == "episode" and kind_of(name) == name else name
        kind, n = kind_of(name), 1
        if _short(name) in OF_EPISODES and (is_every or kind == TRAINING):
            kind, n = (kind, LAST) if is_every else (SAMPLED, max(1, len(values) // 10))
        if len(values) and kind not in self.figures:
            self.figures[kind] = float(values[-n:].mean())
            line = Episodes(steps, values, np.zeros(len(steps)))
            if kind in (TRAINING, SAMPLED):
                self.episodes = line
            elif kind == EVALUATION or not len(self.evaluations.steps):
                self.evaluations = line


def find_logs(paths: Sequence[Path], columns: Mapping[str, str]) -> tuple[list[Log], list[str]]:
    """Read all logs in files and folders; ``columns`` has a table's own names by those in `NAMES`.

    Returns the logs, and remarks on what was read. Raises UserError if nothing was found.
    """
    logs, notes, skipped = list[Log](), list[str](), list[str]()
    files = dict[Path, list[str]]()
    if strange := [name for name in columns if name not in NAMES]:
        raise unknown("--columns: unknown", strange[0], NAMES)
    for path in paths:
        if not path.is_dir():
            files.setdefault(path.parent, []).append(path.name)
        for folder, below, names in os.walk(path):
            below[:] = sorted(name for name in below if not name.startswith("."))
            if "verdicts.json" not in names:  # else the tables here are this project's
                files.setdefault(Path(folder), []).extend(names)
    for place, names in files.items():
        run = Log(str(place.resolve()), place)
        for name in sorted(names):
            try:
                logs += _read_file(place / name, run, columns, notes)
            except (UserError, OSError) as error:
                skipped.append(one_line(error))
        if any(map(_OF_RUN.fullmatch, names)):
            logs.append(run)
            with suppress(UserError, OSError):
                _add_settings(run)
    if not any(log.figures for log in logs):
        kinds = "monitor.csv, evaluations.npz, progress.csv, event files or tables as .csv"
        raise UserError("; ".join([f"no logs in {paths[0]}: give {kinds}", *skipped[:1]]))
    if n := len(skipped):
        notes.append(f"skipped {n:,} file{'s' * (n > 1)}: {'; '.join(skipped[:3])}")
    return logs, notes


def _read_file(path: Path, run: Log, columns: Mapping[str, str], notes: list[str]) -> list[Log]:
    """Add what a file tells of its folder's run; return the logs of other runs in it."""
    name, place = path.name, re.sub(r"[._-]?(monitor\.csv|npz)$", "", path.name)
    log = run if _OF_RUN.fullmatch(name) else Log(f"{run.place}/{place}", path)
    if name == RECORD:
        final = Run(run.path).recorded().get("final")
        if isinstance(final, dict) and isinstance(final.get("mean_return"), int | float):
            run.figures[FINAL] = float(final["mean_return"])
    elif name.endswith("monitor.csv"):
        _add_monitor(log, path, notes)
    elif path.suffix == ".npz" and name not in _NO_LOGS:
        log.add(EVALUATION, *read_evaluations(path))
    elif name == "progress.csv":
        table = _read_table(path)
        step = _named_columns(table, {}, path).get("step")
        _add_columns(run, table, step, returns_in(table.columns))
    elif path.suffix in (".csv", ".tsv") and name not in _NO_LOGS:
        return table_logs(_read_table(path), path, columns, notes)
    elif "tfevents" in name:
        _add_events(run)
    return [log] if log is not run and log.figures else []


def _add_settings(log: Log) -> None:
    """Add the environment that this project or rl_zoo3 has recorded."""
    saved: dict[str, Any] = {}
    # rl_zoo3 uses the latter before the former.
    for path in (*log.path.glob("*/config.yml"), *log.path.glob("*/args.yml")):
        saved |= {key: value for key, value in read_saved(path).items() if value}
    kwargs = saved.get("env_kwargs")
    log.env = str(saved.get("env") or log.env)
    log.env_kwargs = kwargs if isinstance(kwargs, dict) else {}


def _add_monitor(log: Log, path: Path, notes: list[str]) -> None:
    """Add the episodes in a file of Monitor; rows that are none are named and skipped."""
    text = read_bytes(path, MAX_TABLE).decode(errors="replace")
    lines = pd.Series(text.splitlines(), dtype=str)
    is_comment = lines.str.startswith("#")  # settings as JSON
    ids = re.findall(r'"env_id": *"(?!None")([^"]+)"', " ".join(lines[is_comment]))
    log.env = log.env or "".join(ids[:1])
    lines = lines[~is_comment & (lines.str.strip() != "")]
    is_whole = lines.str.count(",") == lines.str.count(",")[:1].sum()
    cells = lines[~lines.str.startswith("r,l")].str.split(",", n=3, expand=True)
    table = cells.reindex(columns=range(3)).apply(pd.to_numeric, errors="coerce")
    good = np.isfinite(table).all(axis=1) & (table[1] >= 1) & is_whole[table.index]
    if n := int((~good).sum()):
        if n == len(table):
            raise UserError(f"{path} is no log of episodes: it needs rows of r,l,t")
        faulty = (table.index[~good] + 1).astype(str)
        which = f"line{'s' * (n > 1)} {', '.join(faulty[:5])}{', ...' * (n > 5)}"
        notes.append(f"{path}: skipped {n:,} of {len(table):,} rows, no episodes: {which}")
    log.monitors += [table[good].to_numpy(np.float64)] if good.any() else []
    if log.monitors:  # the mean over the environments of the run
        log.figures[TRAINING] = float(np.mean([one[-LAST:, 0].mean() for one in log.monitors]))
        log.episodes = joined_episodes(log.monitors)


def _add_events(log: Log) -> None:
    """Add the returns in TensorBoard's event files, by tag."""
    if importlib.util.find_spec("tensorboard") is None:
        raise UserError(f"{log.path}: event files need: pip install 'rl-yardstick[tensorboard]'")
    module = "tensorboard.backend.event_processing.event_accumulator"
    events = importlib.import_module(module).EventAccumulator(str(log.path), {"scalars": 0})
    with as_user_error(f"{log.path}: damaged event files", Exception):  # of TensorBoard
        events.Reload()
        for tag in returns_in(events.Tags()["scalars"]):
            log.add(tag, *np.transpose([(one.step, one.value) for one in events.Scalars(tag)]))


# --- tables ---------------------------------------------------------------------------------------


def _short(name: str) -> str:
    """A column's name in small letters, without what stands before a slash."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower().rpartition("/")[2]).strip("_")


def kind_of(name: str) -> str:
    """The kind of figure in a column: of evaluations, of training episodes, or its own name."""
    is_of_training = _short(name) in (*OF_EPISODES, *OF_MEANS)
    return EVALUATION if "eval" in name.lower() else TRAINING if is_of_training else name


def returns_in(names: Iterable[str]) -> list[str]:
    """The columns of returns among these: the best of each kind."""
    known = NAMES["score"].split()
    places = [(known.index(_short(name)), name) for name in names if _short(name) in known]
    return list({kind_of(name): name for _, name in sorted(places, reverse=True)}.values())[::-1]


def _read_table(path: Path) -> pd.DataFrame:
    """A text table with a row of headings; commas, semicolons or tabs separate its cells."""
    content = read_bytes(path, MAX_TABLE).decode(errors="replace")
    separator = max(",;\t", key=content.partition("\n")[0].count)
    with as_user_error(f"{path} is no table", ValueError, RecursionError):
        return pd.read_csv(io.StringIO(content), sep=separator)


def table_logs(
    table: pd.DataFrame, path: Path, columns: Mapping[str, str], notes: list[str]
) -> list[Log]:
    """The runs in a table; UserError if it has no column of returns."""
    table = table.rename(columns=str)
    if {"tag", "value"} <= {*table.columns}:  # as rlberry exports: a column for each tag
        tags = returns_in(map(str, table["tag"].unique()))
        values = {tag: table["value"].where(table["tag"] == tag) for tag in tags}
        table = table.assign(**values)[table["tag"].isin(tags)].drop(columns=["tag", "value"])
    if charts := _chart_logs(table, path):
        return charts
    names = _named_columns(table, columns, path)
    scores = [columns["score"]] if "score" in columns else returns_in(table.columns)
    if not scores:
        held = ", ".join(table.columns[:8])
        raise UserError(f"{path} has no known column of returns ({held}): --columns score=NAME")
    if not table[scores].apply(pd.to_numeric, errors="coerce").notna().any(axis=None):
        held = shown([*table[scores[0]][:1]])
        raise UserError(f"{path}: column {scores[0]} holds no numbers: {held}")
    step, given = names.get("step"), [key for key in ("agent", "env", "seed") if key in names]
    by = [table[names[key]].astype("string").str.strip() for key in given]
    by = by or [pd.Series("", table.index)]
    steps = table[step] if step else pd.Series(range(0, -len(table), -1), table.index)
    falls = pd.to_numeric(steps, errors="coerce").groupby(by).diff() < 0
    if "seed" not in names:
        seed = falls.groupby(by).cumsum().astype("string")
        if seed.nunique() > 1:
            by, given = [*by[: len(given)], seed], [*given, "seed"]
            taken = "each row" if step is None else f"each part, to where {step!r} falls,"
            notes.append(f"{path} has no column of seeds: {taken} counts as a seed")
    elif falls.mean() > 0.1 and pd.concat([*by, steps], axis=1).duplicated().any():
        step = None  # the lengths of episodes, say
    if not step and (n := table.groupby(by).size().max()) > 1 and kind_of(scores[0]) != TRAINING:
        others = table.columns.drop([*scores, *(names[key] for key in given)])[:5]
        which = f"averaged (other columns: {', '.join(others) or 'none'})"
        notes.append(f"{path} has up to {n:,} rows for each {', '.join(given)}: {which}")
    logs = []
    for of, rows in table.groupby(by, sort=False):
        texts = [re.sub(r"\.0$", "", str(value)) for value in of][: len(given)]
        place = ", ".join([str(path.with_suffix("")), *texts])
        log = Log(place, path, dict(zip(given, texts, strict=True)))
        _add_columns(log, rows, step, scores)
        logs.append(log)
    return logs


def _named_columns(table: pd.DataFrame, columns: Mapping[str, str], path: Path) -> dict[str, str]:
    """The columns of agent, environment, seed and step that are given, or have usual names."""
    if wrong := [name for name in columns.values() if name not in table.columns]:
        raise unknown(f"{path}: no column", wrong[0], table.columns)
    filled = {_short(name): name for name in table.columns[::-1] if table[name].notna().any()}
    usual = {
        key: next((filled[name] for name in names.split() if name in filled), None)
        for key, names in NAMES.items()
    }
    return {key: name for key, name in {**usual, **columns}.items() if name is not None}


def _add_columns(log: Log, rows: pd.DataFrame, step: str | None, scores: Sequence[str]) -> None:
    """Add the curves or the mean figures in the rows of a run."""
    for name in scores:
        values = pd.to_numeric(rows[name], errors="coerce").to_numpy(np.float64)
        if step is not None:
            log.add(name, pd.to_numeric(rows[step], errors="coerce"), values, _short(step))
        elif len(rows) > 1 and _short(name) in OF_EPISODES:
            log.add(name, np.arange(1, len(values) + 1), values)
        elif np.isfinite(values).any():
            kind = kind_of(name) if kind_of(name) == EVALUATION else name
            log.figures.setdefault(kind, float(np.nanmean(values)))


def _chart_logs(table: pd.DataFrame, path: Path) -> list[Log]:
    """The runs of a chart that Weights & Biases exported, with columns ``NAME - METRIC``."""
    logs: dict[str, Log] = {}
    for column in table.columns[1:]:
        name, _, metric = column.rpartition(" - ")
        if name and returns_in([metric]):
            values = pd.to_numeric(table[column], errors="coerce")
            logs.setdefault(name, Log(name, path)).add(metric, table.iloc[:, 0], values)
    return list(logs.values())
