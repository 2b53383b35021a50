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
import pandas as pd

from rl_yardstick.experiments.analysis import StudyAnalysis, analyse
from rl_yardstick.experiments.logs import FINAL, WORDS, Found, Log, find_logs, table_logs
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.results import (
    HIDDEN_COLUMNS,
    OF_RUN,
    RUN_COLUMNS,
    Curve,
    StudyResults,
    evaluation_curve,
    joined,
    summary_row,
    training_curve,
)
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, Metric, StudySpec
from rl_yardstick.pipeline.environments import MISTAKES
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.yardstick import Yardstick
from rl_yardstick.pipeline.spec import TrainSpec, validated

# Regular expressions of labels in paths: of ids of Gymnasium, and of seeds with a word before them.
FORMS = {"agent": "[^/]+?", "env": r"[A-Za-z0-9.-]+-v\d+", "seed": r"(?:(?:seed|run|s)[-_=]?)?\d+"}
# The first that fits the end of a path is taken.
PATTERNS = (
    *("{agent}/{env}_{seed}", "{agent}/{env}/{seed}", "{env}/{agent}/{seed}"),
    *("{env}/{agent}_{seed}", "{env}__{agent}__{seed}__*", "{agent}_{env}_{seed}"),
    *("{env}_{agent}_{seed}", "{agent}/{env}", "{env}/{agent}", "{agent}/{seed}"),
    *("{agent}_{seed}", "{agent}"),
)


@dataclass(frozen=True)
class Options:
    """How logs are read and judged."""

    pattern: str = ""  #: where paths have agent, env and seed; empty for one of `PATTERNS`
    columns: Mapping[str, str] = field(default_factory=dict)  #: a table's own, by the usual names
    env: str = "environment"  #: the environment of runs whose logs name none
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)  #: its arguments, for the optimum
    metric: Metric = "final"  #: the figure that verdicts compare
    margin: float | None = None  #: the difference within which agents are tied
    figures: tuple[str, ...] = ("png", "svg")  #: formats of figures


# --- agent, environment and seed ------------------------------------------------------------------


class _Run(NamedTuple):
    agent: str
    environment: str
    seed: str  # empty where none is told
    log: Log


def labels_in(place: str, pattern: str, forms: Mapping[str, str]) -> dict[str, str] | None:
    """The labels at the end of a path, or None if the pattern, in which ``*`` is any text, fails.

    ``forms`` has a regular expression for each label.
    """
    text, *others = re.split(r"\{(\w*)\}", pattern)
    names, regex = others[::2], re.escape(text)
    if "agent" not in names or len({*names}) < len(names) or not {*names} <= {*forms}:
        raise UserError(f"--pattern {pattern}: name agent, env and seed, as in {PATTERNS[0]}")
    for name, text in zip(names, others[1::2], strict=True):
        regex += f"(?P<{name}>{forms[name]}){re.escape(text)}"
    found = re.search("(?:^|/)" + regex.replace(r"\*", "[^/]*") + "$", place.replace("\\", "/"))
    return None if found is None else found.groupdict()


def _labelled(found: Found, options: Options) -> list[_Run]:
    """The logs with their labels, in order, one for each agent, environment and seed."""
    patterns = (options.pattern,) if options.pattern else PATTERNS
    forms = {**FORMS, "env": "[^/]+?"} if options.pattern else FORMS
    used, runs = Counter[str](), dict[Any, _Run]()
    for log in sorted(found.logs, key=lambda log: log.is_of_events):
        labels = dict(log.labels)
        if "agent" not in labels:
            place = str(log.path.with_suffix("")) if labels else log.place
            read = ((one, labels_in(place, one, forms)) for one in patterns)
            pattern, in_path = next((pair for pair in read if pair[1]), ("", None))
            if in_path is None:
                raise UserError(f"--pattern {options.pattern} does not fit {place}")
            labels = {**in_path, **labels}
            used[pattern] += 1
        seed = re.sub(r"^\D+(?=\d+$)", "", labels.get("seed", ""))
        run = _Run(labels["agent"], labels.get("env") or log.env or options.env, seed, log)
        key = run[:3] if seed else (*run[:2], log.place)
        if key in runs and not log.is_of_events:
            both = f"{runs[key].log.place} and {log.place}"
            raise UserError(f"two runs are {', '.join(run[:3])}: {both}; --pattern splits them")
        runs.setdefault(key, run)
    for pattern, n in used.items():
        found.notes.append(f"labels of {n:,} from their paths, by --pattern '{pattern}'")
    if n := sum(not run.seed for run in runs.values()):
        found.notes.append(f"{n:,} runs without a seed are numbered in their order")
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
    is_last = any(len(run.log.evaluations.steps) for run in runs)
    words = WORDS.get(kind) or f"{'last ' if is_last else ''}{kind}"
    notes.append(f"figure of each run: {'mean ' if kind in WORDS else ''}{words}")
    if n := len(every) - len(runs):
        notes.append(f"left out: {n:,} run{'s' * (n > 1)} without such a figure")
    agents = list(dict.fromkeys(run.agent for run in runs))
    if len(agents) == 1:
        notes.append(f"one agent only, {agents[0]}: a comparison needs two")
    places = {run.environment: _place(run.environment, runs, options) for run in runs}
    ranks = [sum(run[:2] == one[:2] for run in runs[:k]) for k, one in enumerate(runs)]
    first = int(runs[0].seed) if runs[0].seed.isdigit() else 0
    if any(run.seed != str(first + rank) for run, rank in zip(runs, ranks, strict=True)):
        first = 0
        notes.append("seeds are numbered from 0 for each agent")
    study = StudySpec(
        name=root.name,
        title=f"{', '.join(agents)} on {', '.join(places)}",
        agents=tuple(AgentSpec(agent, "") for agent in agents),
        environments=tuple(EnvironmentSpec(one, spec.env_id) for one, (spec, _) in places.items()),
        n_seeds=max(ranks) + 1,
        first_seed=first,
        metric=options.metric,
        margin=options.margin,
        figures=options.figures,
        figure=words,
    )
    planned, rows, curves = list[PlannedRun](), list[dict[str, Any]](), list[Curve]()
    for rank, (agent, place, _, log) in zip(ranks, runs, strict=True):
        spec, scale = places[place]
        run = PlannedRun(agent, place, first + rank, spec, Path(log.place))
        line = log.evaluations.steps, log.evaluations.returns
        of_run = [evaluation_curve(run, log.episodes, *line), training_curve(run, log.episodes)]
        labels = {"agent": agent, "environment": place, "env_id": spec.env_id, "path": log.place}
        recorded = _recorded(log, kind, scale)
        rows.append({**summary_row(study, run, recorded, log.episodes, of_run[0]), **labels})
        planned.append(run)
        curves += of_run
    _note_budgets(rows, notes)
    hidden = any(row["full_optimum"] is not None for row in rows)
    table = pd.DataFrame(rows, columns=[*RUN_COLUMNS, *(HIDDEN_COLUMNS if hidden else ())])
    return StudyResults(study, root, table, joined(curves), tuple(planned))


def _place(
    place: str, runs: Sequence[_Run], options: Options
) -> tuple[TrainSpec, Yardstick | None]:
    """The environment of runs and its scale; the id is empty if it is not known, or differs by run.

    A log imports no module: only Gymnasium's and this project's, and those imported before, count.
    """
    from rl_yardstick.pipeline.evaluation.exact import evaluator_of_single
    from rl_yardstick.pipeline.evaluation.sampled import bracketed_yardstick

    here = [run.log for run in runs if run.environment == place]
    kwargs = [dict(options.env_kwargs or log.env_kwargs) for log in here]
    for env_id in (place, place.replace("-", "/", 1)):
        entry = gym.registry[env_id].entry_point if env_id in gym.registry else None
        module = entry.partition(":")[0] if isinstance(entry, str) else "rl_yardstick."
        is_trusted = module.startswith(("gymnasium.", "rl_yardstick.")) or module in sys.modules
        if entry is not None and is_trusted and kwargs == kwargs[:1] * len(kwargs):
            spec = validated({"algo": "", "env_id": env_id, "env_kwargs": kwargs[0]})
            with suppress(UserError, *MISTAKES):
                exact = evaluator_of_single(spec)
                return spec, bracketed_yardstick(spec) if exact is None else exact.yardstick
    return validated({"algo": "", "env_id": ""}), None


def _recorded(log: Log, kind: str, scale: Yardstick | None) -> dict[str, Any]:
    """A run's figures as ``run.json`` has them."""
    value, returns = log.figures[kind], log.evaluations.returns
    own = log.recorded if kind == FINAL else {}
    figures = {} if scale is None else scale.figures(value)
    ends = [*log.evaluations.steps[-1:], *log.episodes.steps[-1:]]
    return {
        **dict.fromkeys(OF_RUN),
        "final": {"mean_return": value, "exact": False, **figures, **own},
        "best_mean_return": max(returns, default=None),
        "n_timesteps": max(ends, default=None),
    }


def _note_budgets(rows: Sequence[Mapping[str, Any]], notes: list[str]) -> None:
    """Note where the runs of some agents are longer than those of others."""
    table = pd.DataFrame(rows).astype({"n_timesteps": float})
    for place, here in table.groupby("environment", sort=False):
        steps = here.groupby("agent")["n_timesteps"].median().dropna().sort_values()
        if len(steps) > 1 and steps.iloc[-1] > 1.1 * steps.iloc[0]:
            low, *_, high = (f"{n:,.0f} ({agent})" for agent, n in steps.items())
            notes.append(f"{place}: budgets differ, from {low} to {high} steps")


# --- in Python ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Judgement:
    """The judgement of runs that were done elsewhere."""

    analysis: StudyAnalysis  #: all figures and verdicts
    notes: list[str]  #: on what was read, left out and assumed

    @property
    def table(self) -> pd.DataFrame:
        """A row for each agent on each environment, the best first."""
        columns = ["environment", "agent", "runs", "mean", "low", "high", "score", "optimum"]
        rows = []
        for one in self.analysis.environments:
            for agent in one.agents:
                mean, score = agent.metric.mean, agent.score and agent.score.point
                ends = mean.point, mean.low, mean.high
                rows.append([one.environment, agent.agent, agent.n_runs, *ends, score, one.optimum])
        return pd.DataFrame(rows, columns=columns).dropna(axis="columns", how="all")

    @property
    def verdicts(self) -> pd.DataFrame:
        """A row for each pair of agents: the word on the first, the difference of the means."""
        columns = ["environment", "first", "verdict", "second", "difference", "low", "high", "n"]
        pairs = [pair for one in self.analysis.environments for pair in one.pairs]
        ends = [{"verdict": p.text, "low": p.interval[0], "high": p.interval[1]} for p in pairs]
        rows = [asdict(pair) | end for pair, end in zip(pairs, ends, strict=True)]
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
