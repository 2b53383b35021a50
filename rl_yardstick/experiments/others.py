"""Judges runs that were done elsewhere, from their logs, as the runs of a study are judged."""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd

from rl_yardstick.experiments.analysis import StudyAnalysis, analyse
from rl_yardstick.experiments.logs import (
    EVALUATION,
    FINAL,
    TRAINING,
    Found,
    Log,
    find_logs,
    table_logs,
)
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.pool import do_aside
from rl_yardstick.experiments.results import (
    HIDDEN_COLUMNS,
    KINDS,
    LAST_EPISODES,
    OF_RUN,
    RUN_COLUMNS,
    Curve,
    Episodes,
    StudyResults,
    joined,
    logged_curve,
    summary_row,
    training_curve,
)
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, Metric, StudySpec
from rl_yardstick.pipeline.components import import_modules
from rl_yardstick.pipeline.environments import MISTAKES, make_single_env
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.yardstick import Yardstick
from rl_yardstick.pipeline.spec import TrainSpec

WORDS = {
    FINAL: "return of the final policy",
    EVALUATION: "mean return of the last evaluation",
    TRAINING: f"mean return of the last {LAST_EPISODES} training episodes",
}
# Gymnasium's ids, and seeds with a word before them.
_FORMS = {
    "agent": "[^/]+?",
    "env": r"[A-Za-z0-9.-]+-v\d+",
    "seed": r"(?:(?:seed|run|s)[-_=]?)?\d+",
}
# The first that fits the end of a path is taken.
PATTERNS = (
    *("{agent}/{env}_{seed}", "{agent}/{env}/{seed}", "{env}/{agent}/{seed}"),
    *("{env}/{agent}_{seed}", "{env}__{agent}__{seed}__*", "{agent}_{env}_{seed}"),
    *("{env}_{agent}_{seed}", "{agent}/{env}", "{env}/{agent}", "{agent}/{seed}"),
    *("{agent}_{seed}", "{agent}"),
)
UNNAMED = "environment"  # one that no log names


@dataclass(frozen=True)
class Options:
    """How logs are read and judged."""

    pattern: str = ""  #: where paths have agent, env and seed; empty for one of `PATTERNS`
    columns: Mapping[str, str] = field(default_factory=dict)  #: a table's own, by the usual names
    env: str = ""  #: the environment of runs whose logs name none
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)  #: its arguments, for the optimum
    gym_packages: tuple[str, ...] = ()  #: modules with further environments
    metric: Metric = "final"  #: the figure that verdicts compare
    margin: float | None = None  #: the difference within which agents are tied


class _Run(NamedTuple):
    agent: str
    environment: str
    seed: str  # empty where none is told
    log: Log


# --- agent, environment and seed ------------------------------------------------------------------


def labels_in(place: str, pattern: str, forms: Mapping[str, str]) -> dict[str, str] | None:
    """The labels at the end of a path, by a pattern; None if it does not fit.

    ``forms`` has a regular expression for each of agent, env and seed. ``*`` is any text.
    """
    text, *others = re.split(r"\{(\w*)\}", pattern)
    names, regex = others[::2], re.escape(text)
    if "agent" not in names or len({*names}) < len(names) or not {*names} <= {*forms}:
        raise UserError(f"--pattern {pattern} must name agent, env, seed: '{PATTERNS[0]}'")
    for name, text in zip(names, others[1::2], strict=True):
        regex += f"(?P<{name}>{forms[name]}){re.escape(text)}"
    found = re.search("(?:^|/)" + regex.replace(r"\*", "[^/]*") + "$", place.replace("\\", "/"))
    return None if found is None else found.groupdict()


def _labelled(found: Found, options: Options) -> list[_Run]:
    """The logs with their labels, in order, one for each agent, environment and seed."""
    patterns, forms = PATTERNS, _FORMS
    if options.pattern:
        patterns, forms = (options.pattern,), {**_FORMS, "env": "[^/]+?"}
    used, runs = dict[str, list[str]](), dict[Any, _Run]()
    for log in sorted(found.logs, key=lambda log: log.has_events_only):
        labels = dict(log.labels)
        if "agent" not in labels:
            place = str(log.path.with_suffix("")) if labels else log.place
            read = ((one, labels_in(place, one, forms)) for one in patterns)
            pattern, in_path = next((pair for pair in read if pair[1]), ("", None))
            if in_path is None:
                raise UserError(f"--pattern {options.pattern} does not fit {place}")
            labels = {**in_path, **labels}
            told = " ".join(f"{key}={labels[key]}" for key in forms if key in in_path)
            used.setdefault(pattern, []).append(told)
        place = labels.get("env") or log.env or options.env or UNNAMED
        run = _Run(labels["agent"], place, re.sub("^.*[a-z_=-]", "", labels.get("seed", "")), log)
        key = run[:3] if run.seed else (*run[:2], log.place)
        if key not in runs:
            runs[key] = run
        elif not log.has_events_only:
            both = f"{runs[key].log.place} and {log.place}"
            raise UserError(f"two runs are {', '.join(run[:3])}: {both}: --pattern splits them")
    for pattern, all_told in used.items():
        which = f"{len(all_told):,} run{'s' * (len(all_told) > 1)}, as {all_told[0]}"
        found.notes.append(f"labels from paths by --pattern '{pattern}': {which}")
    if n := sum(not run.seed for run in runs.values()):
        found.notes.append(f"{n:,} runs have no seed and are numbered in their order")
    return sorted(runs.values(), key=lambda run: (*run[:2], run.seed.zfill(20)))


# --- from logs to a study -------------------------------------------------------------------------


def results_of(found: Found, options: Options, root: Path) -> StudyResults:
    """The logs as the results of a study in the folder ``root``; adds notes to ``found``.

    Raises:
        UserError: if labels are missing, or are those of two runs.
    """
    every, notes = _labelled(found, options), found.notes
    counts = Counter(kind for run in every for kind in run.log.figures)
    kind = max([*WORDS, *counts], key=lambda kind: counts[kind])  # the first that most runs have
    runs = [run for run in every if kind in run.log.figures]
    has_lines = any(kind in run.log.lines for run in runs)
    words = WORDS.get(kind) or f"{'last ' if has_lines else ''}{kind}"
    notes.append(f"figure of each run: {words}")
    if n := len(every) - len(runs):
        first = next(run.log.place for run in every if kind not in run.log.figures)
        notes.append(f"left out: {n:,} run{'s' * (n > 1)} without it, such as {first}")
    agents, places = (list(dict.fromkeys(run[k] for run in runs)) for k in (0, 1))
    if len(agents) == 1:
        notes.append(f"one agent only, {agents[0]}: a comparison needs two")
    specs = {place: _spec(place, runs, options) for place in places}
    known = [spec for spec in specs.values() if spec.env_id]
    aside = known and "torch" not in sys.modules
    scales = do_aside(yardsticks_of, known) if aside else yardsticks_of(known)
    scale_of = dict(zip((spec.env_id for spec in known), scales, strict=True))
    study = StudySpec(
        name=root.name,
        title=f"{', '.join(agents)} on {', '.join(places)}",
        agents=tuple(AgentSpec(agent, "") for agent in agents),
        environments=tuple(EnvironmentSpec(one, specs[one].env_id) for one in places),
        n_seeds=max(Counter(run[:2] for run in runs).values()),
        metric=options.metric,
        margin=options.margin,
        figure=words,
    )
    planned, rows, curves = list[PlannedRun](), list[dict[str, Any]](), list[Curve]()
    for agent, place, _, log in runs:
        seed = sum(run.labels == (agent, place) for run in planned)
        run = PlannedRun(agent, place, seed, specs[place], Path(log.place))
        of_run = _curves(run, log)
        try:
            row = _row(study, run, log, kind, scale_of.get(run.spec.env_id), of_run)
        except (LookupError, TypeError, ValueError) as error:
            raise UserError(f"{log.path} is damaged: {one_line(error)}") from error
        labels = {"agent": agent, "environment": place, "env_id": run.spec.env_id}
        rows.append({**labels, **row, "path": log.place})
        planned.append(run)
        curves += of_run.values()
    _note_budgets(rows, notes)
    hidden = HIDDEN_COLUMNS if any(row["full_optimum"] is not None for row in rows) else ()
    table = pd.DataFrame(rows, columns=[*RUN_COLUMNS, *hidden])
    return StudyResults(study, root, table, joined(curves), tuple(planned))


def _spec(place: str, runs: Sequence[_Run], options: Options) -> TrainSpec:
    """The environment of runs; its id is empty if it is not known here, or differs by run.

    No log makes this import a module, except Gymnasium's and this project's.
    """
    unknown = TrainSpec(algo="", env_id="", gym_packages=[*options.gym_packages])
    kwargs = [
        dict(options.env_kwargs or run.log.env_kwargs) for run in runs if run.environment == place
    ]
    for env_id in (place, place.replace("-", "/", 1)):
        entry = gym.registry[env_id].entry_point if env_id in gym.registry else None
        module = entry.partition(":")[0] if isinstance(entry, str) else ""
        is_trusted = module.startswith(("gymnasium.", "rl_yardstick.")) or module in sys.modules
        if entry and (is_trusted or not module) and all(one == kwargs[0] for one in kwargs):
            spec = unknown.changed(env_id=env_id, env_kwargs=kwargs[0])
            with suppress(UserError, *MISTAKES):
                make_single_env(spec).close()
                return spec
    return unknown


def yardsticks_of(specs: Sequence[TrainSpec]) -> list[Yardstick | None]:
    """The scale of each environment, if known; it loads PyTorch, unless there are none."""
    found: list[Yardstick | None] = []
    for spec in specs:
        from rl_yardstick.pipeline.evaluation.exact import evaluator_of_single
        from rl_yardstick.pipeline.evaluation.sampled import bracketed_yardstick

        found.append(None)
        with suppress(UserError, *MISTAKES):
            import_modules(spec.gym_packages)
            exact = evaluator_of_single(spec)
            found[-1] = bracketed_yardstick(spec) if exact is None else exact.yardstick
    return found


_NOTHING = Episodes(np.empty(0), np.empty(0), np.empty(0))


def _curves(run: PlannedRun, log: Log) -> dict[str, Curve]:
    """The learning curves of a run by kind; a column of a table counts as evaluations."""
    found, episodes = dict[str, Curve](), log.lines.get(TRAINING, _NOTHING)
    for name, line in log.lines.items():
        if name == TRAINING:
            found[name] = training_curve(run, line)
        elif KINDS[0] not in found:
            found[KINDS[0]] = logged_curve(run, episodes, line.steps, line.returns)
    return found


def _row(
    study: StudySpec,
    run: PlannedRun,
    log: Log,
    kind: str,
    scale: Yardstick | None,
    curves: Mapping[str, Curve],
) -> dict[str, Any]:
    """The row of a run in the summary."""
    value, figures = log.figures[kind], {} if scale is None else scale.figures(log.figures[kind])
    final = {"exact": False, **figures, **(log.recorded if kind == FINAL else {})}
    curve = curves.get(KINDS[0]) or logged_curve(run, _NOTHING, np.empty(0), np.empty(0))
    episodes = log.lines.get(TRAINING, _NOTHING)
    ends = [line.steps[-1] for line in log.lines.values()]
    recorded = {
        **dict.fromkeys(OF_RUN),
        "final": {**final, "mean_return": value},
        "best_mean_return": max(curve["value"], default=None),
        "n_timesteps": max(ends, default=None),
    }
    return summary_row(study, run, recorded, episodes, curve)


def _note_budgets(rows: Sequence[Mapping[str, Any]], notes: list[str]) -> None:
    """Note where the runs of some agents are longer than those of others."""
    table = pd.DataFrame(rows).astype({"n_timesteps": float})
    for place, here in table.groupby("environment", sort=False):
        steps = here.groupby("agent")["n_timesteps"].median().dropna()
        if len(steps) > 1 and steps.max() > 1.1 * steps.min():
            low, high = (
                f"{steps[name]:,.0f} ({name})" for name in (steps.idxmin(), steps.idxmax())
            )
            notes.append(f"{place}: budgets differ, from {low} to {high} steps")


# --- in Python ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Judgement:
    """The judgement of runs that were done elsewhere."""

    analysis: StudyAnalysis  #: all figures and verdicts
    notes: list[str]  #: on what was read, left out and assumed

    @property
    def table(self) -> pd.DataFrame:
        """A row for each agent on each environment, the best first: the mean and its interval."""
        rows = [
            {
                "environment": one.environment,
                "agent": agent.agent,
                "runs": agent.n_runs,
                **{end: getattr(agent.metric.mean, end) for end in ("point", "low", "high")},
                "score": None if agent.score is None else agent.score.point,
                "optimum": one.optimum,
            }
            for one in self.analysis.environments
            for agent in one.agents
        ]
        found = pd.DataFrame(rows).rename(columns={"point": "mean"})
        return found.dropna(axis="columns", how="all")

    @property
    def verdicts(self) -> pd.DataFrame:
        """A row for each pair of agents, the word on the first, and the difference of the means."""
        pairs = [pair for one in self.analysis.environments for pair in one.pairs]
        rows = [
            {**asdict(p), "verdict": p.text, **dict(zip(("low", "high"), p.interval))}
            for p in pairs
        ]
        columns = ["environment", "first", "verdict", "second", "difference", "low", "high", "n"]
        return pd.DataFrame(rows, columns=columns)

    def _repr_html_(self) -> str:
        tables = [table.to_html(index=False, na_rep="") for table in (self.table, self.verdicts)]
        return "".join([*tables, *(f"<p>{escape(note)}</p>" for note in self.notes)])


def judge(what: pd.DataFrame | str | Path | Sequence[str | Path], **options: Any) -> Judgement:
    """Judge runs by their logs, or by a table with a row for each score or step.

    Args:
        what: the table, or files and folders.
        options: the fields of `Options`.

    Raises:
        UserError: if nothing was found, or labels are missing or not unique.
    """
    chosen, found = Options(**options), Found()
    if isinstance(what, pd.DataFrame):
        found.logs += table_logs(what, Path("table"), chosen.columns, found.notes)
    else:
        paths = [what] if isinstance(what, str | Path) else what
        found = find_logs([Path(path) for path in paths], chosen.columns)
    return Judgement(analyse(results_of(found, chosen, Path("runs"))), found.notes)
