"""Runs that were done elsewhere as the runs of a study, from their logs."""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from rl_yardstick.experiments import results
from rl_yardstick.experiments.analysis import MARGIN
from rl_yardstick.experiments.logs import TRAINING, WORDS, Log
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.pipeline.environments import MISTAKES
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.yardstick import Yardstick
from rl_yardstick.pipeline.spec import TrainSpec, validated

# Regular expressions of labels in paths: ids of Gymnasium; seeds: numbers behind a word, or dates.
SEED = r"(?:(?:seed|run|s)[-_= ]?)?\d+|\d{4}-?\d\d-?\d\d[-_T ]\d[\d.:-]*"
FORMS = {"agent": "[^/]+?", "env": r"[A-Za-z0-9.-]+-v\d+", "seed": SEED}
# The first that fits the end of a path is taken.
PATTERNS = (
    *("{agent}/{env}_{seed}", "{agent}/{env}/{seed}", "{env}/{agent}/{seed}"),
    *("{env}/{agent}_{seed}", "{env}__{agent}__{seed}__*", "{agent}_{env}_{seed}"),
    *("{env}_{agent}_{seed}", "{agent}/{env}", "{env}/{agent}", "{agent}/{seed}"),
    *("{agent}_{seed}", "{agent}"),
)
UNNAMED = "environment"  # of logs that name none


# --- agent, environment and seed ------------------------------------------------------------------


def labels_in(place: str, pattern: str, forms: Mapping[str, str] = FORMS) -> dict[str, str]:
    """The labels at the end of a path, empty where the pattern does not fit; ``*`` is any text."""
    text, *others = re.split(r"\{(\w*)\}", pattern)
    names, regex = others[::2], re.escape(text)
    if "agent" not in names or len({*names}) < len(names) or not {*names} <= {*forms}:
        raise UserError(f"--pattern {pattern}: name agent, env and seed, as in {PATTERNS[0]}")
    for name, text in zip(names, others[1::2], strict=True):
        regex += f"(?P<{name}>{forms[name]}){re.escape(text)}"
    found = re.search("(?:^|/)" + regex.replace(r"\*", "[^/]*") + "$", place.replace("\\", "/"))
    return {} if found is None else found.groupdict()


def _labelled(logs: Sequence[Log], notes: list[str], pattern: str, env: str) -> list[Log]:
    """The logs with all labels, in order, one for each agent, environment and seed."""
    patterns = [pattern] if pattern else [*PATTERNS]
    forms = {**FORMS, "env": "[^/]+?"} if pattern else FORMS
    used, runs = Counter[str](), dict[tuple[str, ...], Log]()
    for log in logs:
        if "agent" not in log.labels:
            place = str(log.path.with_suffix("")) if log.labels else log.place
            read = ((one, labels_in(place, one, forms)) for one in patterns)
            fitting, in_path = next((pair for pair in read if pair[1]), ("", {}))
            if not in_path:
                raise UserError(f"--pattern {pattern} does not fit {place}")
            log.labels = {**in_path, **log.labels}
            used[fitting] += 1
        seed = re.sub(r"^\D+(?=\d+$)", "", log.labels.get("seed", ""))
        environment = log.labels.get("env") or log.env or env
        log.labels = {"agent": log.labels["agent"], "env": environment}
        key = (*log.labels.values(), seed.zfill(20), "" if seed else log.place)
        if (other := runs.setdefault(key, log)) is not log:
            both = f"{', '.join([*log.labels.values(), seed])}: {other.place} and {log.place}"
            raise UserError(f"two runs are {both}; --pattern splits them")
    for fitting, n in used.items():
        notes.append(f"labels of {n:,} from their paths, by --pattern '{fitting}'")
    return [runs[key] for key in sorted(runs)]


# --- from logs to a study -------------------------------------------------------------------------


def results_of(
    every: Sequence[Log],
    notes: list[str],
    root: Path,
    pattern: str = "",
    env: str = UNNAMED,
    env_kwargs: Mapping[str, Any] | None = None,
) -> results.StudyResults:
    """The logs as the results of a study in the folder ``root``; adds to the notes.

    ``pattern`` tells where paths have agent, env and seed, ``env`` and ``env_kwargs`` belong to
    logs that name none. Raises UserError if labels are missing, or are those of two runs.
    """
    counts, half = Counter(kind for log in every for kind in log.figures), len(every) // 2
    # The first that more than half of the runs have, or else most.
    kind = max([*WORDS, *counts], key=lambda kind: min(counts[kind], half + 1))
    logs = _labelled([log for log in every if kind in log.figures], notes, pattern, env)
    is_last = any(len(log.evaluations.steps) for log in logs)
    words = WORDS.get(kind) or f"{'last ' if is_last else ''}{kind}"
    notes.append(f"figure of each run: {'mean ' if kind in WORDS else ''}{words}")
    if left := [log.place for log in every if kind not in log.figures]:
        n, more = len(left), ", ..." * (len(left) > 1)
        notes.append(f"left out: {n:,} run{'s' * (n > 1)} without such a figure: {left[0]}{more}")
    labels = [(log.labels["agent"], log.labels["env"]) for log in logs]
    agents = list(dict.fromkeys(agent for agent, _ in labels))
    if len(agents) == 1:
        notes.append(f"one agent only, {agents[0]}: a comparison needs two")
    if UNNAMED in (place for _, place in labels):
        notes.append("no log names its environment: --env gives it")
    names = dict.fromkeys(place for _, place in labels)
    places = {place: _place(place, logs, env_kwargs) for place in names}
    for agent, place in dict.fromkeys(labels):
        own, scale = {"agent": agent, "env": place}, places[place][1]
        finals: Any = pd.Series([log.figures[kind] for log in logs if log.labels == own])
        if scale and finals.mean() - 6 * finals.sem() > scale.optimum + MARGIN * abs(scale.optimum):
            above = f"{place}: returns of {agent} above the optimum {scale.optimum:.4g}"
            notes.append(f"{above}: another environment or other arguments; --env-kwargs")
            places[place] = _place("", (), None)
    seeds = [labels[:k].count(one) for k, one in enumerate(labels)]
    study = StudySpec(
        name=root.name,
        title=f"{', '.join(agents)} on {', '.join(places)}",
        agents=tuple(AgentSpec(agent, "") for agent in agents),
        environments=tuple(EnvironmentSpec(one, spec.env_id) for one, (spec, _) in places.items()),
        n_seeds=max(seeds) + 1,
        figure=words,
    )
    planned, rows, curves = list[PlannedRun](), list[dict[str, Any]](), list[results.Curve]()
    for (agent, place), seed, log in zip(labels, seeds, logs, strict=True):
        spec, scale = places[place]
        planned.append(PlannedRun(agent, place, seed, spec, Path(log.place)))
        row, *of_run = _read(study, planned[-1], log, log.figures[kind], scale)
        rows.append(row)
        curves += of_run
    hidden = results.HIDDEN_COLUMNS if any(row["full_optimum"] is not None for row in rows) else ()
    table = pd.DataFrame(rows, columns=[*results.RUN_COLUMNS, *hidden])
    for name, of_env in table.dropna(subset="n_timesteps").groupby("environment"):
        ends = of_env.set_index("agent")["n_timesteps"].sort_values()
        if ends.iloc[-1] > 1.1 * ends.iloc[0]:
            first, last = (f"{ends.iloc[k]:,.0f} ({ends.index[k]})" for k in (0, -1))
            notes.append(f"{name}: the shortest run ends at {first}, the longest at {last}")
    return results.StudyResults(study, root, table, results.joined(curves), tuple(planned))


def _place(
    place: str, logs: Sequence[Log], given: Mapping[str, Any] | None
) -> tuple[TrainSpec, Yardstick | None]:
    """The environment of runs and its scale; the id is empty if it is not known, or differs by run.

    A log imports no module: only Gymnasium's and this project's, and those imported before, count.
    """
    from rl_yardstick.pipeline.evaluation.exact import evaluator_of_single
    from rl_yardstick.pipeline.evaluation.sampled import bracketed_yardstick

    unknown = validated({"algo": "", "env_id": "", "n_timesteps": 1})
    kwargs = [dict(given or log.env_kwargs) for log in logs if log.labels["env"] == place]
    entry = gym.registry[place].entry_point if place in gym.registry else None
    module = entry.partition(":")[0] if isinstance(entry, str) else "rl_yardstick."
    is_trusted = module.startswith(("gymnasium.", "rl_yardstick.")) or module in sys.modules
    if entry is not None and is_trusted and kwargs == kwargs[:1] * len(kwargs):
        spec = unknown.changed(env_id=place, env_kwargs=kwargs[0])
        with suppress(UserError, *MISTAKES):
            exact = evaluator_of_single(spec)
            return spec, bracketed_yardstick(spec) if exact is None else exact.yardstick
    return unknown, None


def _read(
    study: StudySpec, run: PlannedRun, log: Log, value: float, scale: Yardstick | None
) -> tuple[dict[str, Any], results.Curve, results.Curve]:
    """A run's row of the summary and its curves, as those of a run folder."""
    evaluated, episodes = log.evaluations, log.episodes
    figures = {} if scale is None else scale.figures(value)
    recorded = {
        **dict.fromkeys(results.OF_RUN),
        "final": {"mean_return": value, "exact": False, **figures},
        "best_mean_return": max(evaluated.returns, default=None),
        "n_timesteps": max([*evaluated.steps[-1:], *episodes.steps[-1:]], default=None),
    }
    curve = results.evaluation_curve(run, episodes, evaluated.steps, evaluated.returns)
    row = results.summary_row(study, run, recorded, episodes, curve)
    row |= {"agent": run.agent, "environment": run.environment, "path": log.place}
    row |= {"env_id": run.spec.env_id, "last_episodes": log.figures.get(TRAINING)}
    return row, curve, results.training_curve(run, episodes)
