"""Sections on what agents do: on bandits, on maps, in films."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from envs.known_models import transition_model
from envs.layout import GridLayout, grid_layout
from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.bandits import PullStatistics
from experiments.child_processes import do_aside
from experiments.plan import PlannedRun
from experiments.run_files import read_value_maps
from pipeline.environments import make_single_env
from report.films import MAX_BYTES, films_of, has_film
from report.page.frame import Report, Section, data_uri, first_runs, layout_data
from report.series import (
    SPREAD,
    ArmSeries,
    Belief,
    Curve,
    Pulls,
    PullSeries,
    mean_regret,
    regret_of_runs,
)
from report.words import number
from safe_files.files import NO_LIMIT, read_file

# What agents make of bandits: rewards and regrets by pull, where pulls went, what is believed.

MOST_ARMS = 40  # over all contexts, in a table or in a figure


@dataclass(frozen=True)
class ArmRow:
    """An arm in a context."""

    name: str  # what it is called
    mean: float  # its true mean reward
    regret: float  # how far that is from the best in the context
    # By agent, the share of the pulls in the context that went to it; nan where the agent never
    # saw the context.
    shares: Mapping[str, float]


@dataclass(frozen=True)
class ContextTable:
    """Where the pulls went in one context."""

    name: str  # what it is called; empty where it is the only one
    rows: list[ArmRow]  # its arms
    regrets: Mapping[str, float]  # by agent, mean regret of a pull there


def bandits(report: Report) -> Section | None:
    """Figures by pull of every bandit; None where there is none."""
    bandits = [one.pulls for one in report.series.environments]
    if not any(bandits):
        return None
    data = [None if series is None else _bandit_data(series) for series in bandits]
    pulls = [{} if series is None else series.pulls for series in bandits]
    context = {
        "is_bandit": [series is not None for series in bandits],
        "tables": [context_tables(of_agents) for of_agents in pulls],
        "agents": [list(of_agents) for of_agents in pulls],
        "spread": SPREAD,
        "has_bounds": any(series is not None and series.bounds for series in bandits),
    }
    return Section("bandits", "Pulls and regret", context, places=data, by_environment=True)


def context_tables(pulls: Pulls) -> list[ContextTable]:
    """Where the pulls went by context; none where true means differ between runs."""
    known = {agent: p for agent, p in pulls.items() if p.true_means.size}
    if not known:
        return []
    means = next(iter(known.values())).true_means
    if means.size > MOST_ARMS:
        return []
    gaps = means.max(axis=1, keepdims=True) - means
    tables = []
    for context in range(len(means)):
        rows = [
            ArmRow(
                name=f"arm {arm}",
                mean=float(means[context, arm]),
                regret=float(gaps[context, arm]),
                shares={agent: float(p.shares[context, arm]) for agent, p in known.items()},
            )
            for arm in range(means.shape[1])
        ]
        regrets = {agent: float(p.shares[context] @ gaps[context]) for agent, p in known.items()}
        tables.append(ContextTable(f"context {context}" if len(means) > 1 else "", rows, regrets))
    return tables


def _bandit_data(series: PullSeries) -> dict[str, Any]:
    bounds = series.bounds
    return {
        "best": series.best,
        "bounds": None
        if bounds is None
        else {"x": bounds.pulls, "auer": bounds.auer, "lai_robbins": bounds.lai_robbins},
        "curves": {agent: _curves(statistics) for agent, statistics in series.pulls.items()},
        "arms": _arms(series.arms),
        "posteriors": [_belief(belief) for belief in series.beliefs],
    }


def _curves(statistics: PullStatistics) -> dict[str, Any]:
    return {
        "x": statistics.pulls,
        "reward": statistics.reward,
        "optimal": statistics.optimal,
        "regret": {
            "mean": _band(mean_regret(statistics)),
            "runs": _band(regret_of_runs(statistics)),
        },
        "simple": statistics.simple_regret,
    }


def _band(curve: Curve) -> dict[str, Any]:
    return {"y": curve.y, "low": curve.low, "high": curve.high}


def _arms(arms: ArmSeries | None) -> dict[str, Any] | None:
    if arms is None or len(arms.names) > MOST_ARMS:
        return None
    estimates = {agent: {"mean": m, "std": std} for agent, (m, std) in arms.estimates.items()}
    return {
        "names": arms.names,
        "means": arms.means,
        "shares": arms.shares,
        "estimates": estimates,
    }


def _belief(belief: Belief) -> dict[str, Any]:
    """Densities by moment, context and arm."""
    return {
        "agent": belief.agent,
        "moments": belief.moments,
        "x": belief.points,
        "truth": belief.true_means,
        "densities": belief.densities,
    }


# What agents do on each cell of a grid world, over their training, beside the optimum.

MAX_MAPS = 40  # of a run: more than a slider needs
MIN_MAPS = 2  # the first and the last
# Figures of a page, values and actions of all maps, which environments share; each takes 4 bytes.
MAX_FIGURES = 200_000

Arrays = Mapping[str, NDArray[Any]]


def policies(report: Report) -> Section | None:
    """The maps of every grid world; None where there is none."""
    analysis = report.analysis
    room = MAX_FIGURES // len(analysis.environments)
    data = [_policy_data(analysis, environment, room) for environment in analysis.environments]
    if not any(data):
        return None
    context = {"is_drawn": [item is not None for item in data]}
    return Section("policies", "Policies", context, places=data, by_environment=True)


def _policy_data(
    analysis: StudyAnalysis, environment: EnvironmentAnalysis, room: int
) -> dict[str, Any] | None:
    runs = _recorded_runs(analysis, environment)
    if not runs:
        return None
    first = runs[0]
    env = make_single_env(first.spec)
    try:
        layout, model = grid_layout(env), transition_model(env)
    finally:
        env.close()
    if layout is None or model is None:
        return None
    maps = _read_maps(runs, layout, room)
    if not maps:
        return None
    optimum = next(iter(maps.values()))
    return {
        **layout_data(layout),
        "matters": _digits(model.reachable),
        "optimum": {
            "values": optimum["optimal_values"],
            # Bit a of a state's number says that action a is optimal there.
            "actions": (optimum["optimal_actions"] << np.arange(len(layout.moves))).sum(axis=1),
        },
        "runs": [
            {"agent": agent, "seed": seed, **_map_data(arrays)}
            for (agent, seed), arrays in maps.items()
        ],
    }


def _recorded_runs(analysis: StudyAnalysis, environment: EnvironmentAnalysis) -> list[PlannedRun]:
    """The runs with maps, those of one seed together and the best agent first."""
    order = [agent.agent for agent in environment.agents]
    runs = [
        run
        for run in analysis.results.finished
        if run.environment == environment.environment and run.run.value_maps_path.exists()
    ]
    return sorted(runs, key=lambda run: (run.seed, order.index(run.agent)))


def _read_maps(
    runs: Sequence[PlannedRun], layout: GridLayout, room: int
) -> dict[tuple[str, int], Arrays]:
    """The maps by agent and seed, of the first seed and as many others as there is room for."""
    n_agents = sum(run.seed == runs[0].seed for run in runs)
    # Of the first seed all agents, if at few moments.
    n_maps = min(max(room // (2 * layout.n_states * n_agents), MIN_MAPS), MAX_MAPS)
    maps: dict[tuple[str, int], Arrays] = {}
    figures = 0
    for run in runs:
        arrays = _read(run, n_maps)
        if arrays["optimal_actions"].shape != (layout.n_states, len(layout.moves)):
            continue  # an agent that was given another map
        figures += 2 * arrays["values"].size
        if figures > room and run.seed != runs[0].seed:
            # All agents of a seed, or none of them.
            return {key: found for key, found in maps.items() if key[1] != run.seed}
        maps[run.agent, run.seed] = arrays
    return maps


def _read(run: PlannedRun, n_maps: int) -> Arrays:
    """The maps of a run, at so many moments at most, the first and the last among them."""
    arrays = read_value_maps(run.run)
    n = len(arrays["timesteps"])
    if n > n_maps:
        kept = np.linspace(0, n - 1, n_maps).round().astype(np.int64)
        arrays |= {name: arrays[name][kept] for name in ("timesteps", "values", "actions")}
    return arrays


def _map_data(arrays: Arrays) -> dict[str, Any]:
    return {
        "steps": arrays["timesteps"],
        "values": arrays["values"],
        "actions": [_digits(actions) for actions in arrays["actions"]],
    }


def _digits(numbers: NDArray[Any]) -> str:
    """Numbers below ten as one text, which takes the least room."""
    return "".join(map(str, numbers.astype(np.int64).tolist()))


# An episode of each agent as an animated picture inside the page.

MOST_FILMED = 8  # agents of an environment, the best of them
ALL_BYTES = 1_000_000  # of the films of a page, a third more as text


@dataclass(frozen=True)
class Film:
    """A greedy episode of an agent."""

    agent: str  # its label
    still: str  # the first frame as a data URI
    place: int  # that of its film among those of the page, which agents of one route share
    width: int  # in pixels
    height: int
    caption: str  # how the episode went


def played_episodes(report: Report) -> Section | None:
    """The films of each environment; None where nothing can be drawn."""
    groups: list[list[Film]] = []
    contents: dict[bytes, int] = {}  # and their places on the page
    without_room: list[list[str]] = []
    not_filmed: list[list[str]] = []
    ranked = first_runs(report.analysis)
    to_film = [run for runs in ranked for run in runs[:MOST_FILMED]]
    report.tell("filming episodes")
    made = films_of(to_film) if all(map(has_film, to_film)) else do_aside(films_of, to_film)
    paths = dict(zip((run.path for run in to_film), made, strict=True))
    for n_done, runs in enumerate(ranked, start=1):
        groups.append([])
        without_room.append([])
        not_filmed.append([run.agent for run in runs[MOST_FILMED:]])
        for run in runs[:MOST_FILMED]:
            path = paths[run.path]
            if path is None:
                continue
            content = read_file(path, NO_LIMIT)
            # What an environment does not take is left to the next ones.
            room = ALL_BYTES * n_done // len(ranked) - sum(map(len, contents))
            if content in contents or len(content) <= room:
                place = contents.setdefault(content, len(contents))
                groups[-1].append(_film(run.agent, path, content, place))
            else:
                without_room[-1].append(run.agent)
    if not any(groups):
        return None
    data = [data_uri("image/gif", content) for content in contents]
    context = {"films": groups, "without_room": without_room, "not_filmed": not_filmed}
    return Section("films", "Episodes", context, data, by_environment=True)


def _film(agent: str, path: Path, content: bytes, place: int) -> Film:
    still = io.BytesIO()
    with Image.open(io.BytesIO(content)) as picture:
        width, height = picture.size
        picture.convert("RGB").quantize(64).save(still, "PNG", optimize=True)
    return Film(
        agent,
        data_uri("image/png", still.getvalue()),
        place,
        width,
        height,
        _caption(json.loads(read_file(path.with_suffix(".json"), MAX_BYTES))),
    )


def _caption(episode: dict[str, Any]) -> str:
    shown, steps = episode["frames"] - 1, episode["steps"]
    if steps is None:
        return f"the first {shown} steps"
    result = f"return {number(episode['return'])} in {steps} step{'s' if steps > 1 else ''}"
    return result if shown >= steps else f"{result}, of which these are the first {shown}"
