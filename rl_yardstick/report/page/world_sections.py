"""Sections on what agents do: on bandits, on maps, in films."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from rl_yardstick.envs.known_models import transition_model
from rl_yardstick.envs.layout import GridLayout, grid_layout
from rl_yardstick.experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.pool import do_aside
from rl_yardstick.experiments.results import read_compared
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.files import read_arrays, read_bytes, read_json
from rl_yardstick.pipeline.run import MEANINGS
from rl_yardstick.report.films import film_of, has_film
from rl_yardstick.report.page.frame import Report, Section, data_uri, first_runs, layout_data
from rl_yardstick.report.series import SPREAD, Curve, Pulls, mean_of, mean_regret, regret_of_runs
from rl_yardstick.report.words import number, whys_of

MOST_ARMS = 40  # over all contexts, in a table or in a figure


def bandits(report: Report) -> Section | None:
    """Figures by pull of every bandit; None where there is none."""
    bandits = [one.pulls for one in report.series.environments]
    if not any(bandits):
        return None
    pulls = [{} if series is None else series.pulls for series in bandits]
    context = {
        "tables": [_by_arm(of_agents) for of_agents in pulls],
        "agents": [list(of_agents) for of_agents in pulls],
        "spread": SPREAD,
        "has_bounds": any(series is not None and series.bounds for series in bandits),
    }
    data = [
        None
        if series is None
        else {
            "best": series.best,
            "bounds": series.bounds,
            "curves": {
                agent: {
                    "x": pulls.pulls,
                    "reward": pulls.reward,
                    "optimal": pulls.optimal,
                    "regret": {"mean": mean_regret(pulls), "runs": regret_of_runs(pulls)},
                    "simple": pulls.simple_regret,
                }
                for agent, pulls in series.pulls.items()
            },
            "arms": series.arms if series.arms and len(series.arms.names) <= MOST_ARMS else None,
            "beliefs": series.beliefs,
        }
        for series in bandits
    ]
    return Section("bandits", "Pulls and regret", context, places=data, by_environment=True)


def _by_arm(pulls: Pulls) -> dict[str, Any] | None:
    """Means, regret and shares of the pulls by context and arm; None if means differ by run."""
    shares = {agent: p.shares for agent, p in pulls.items() if p.true_means.size}
    means = next((p.true_means for p in pulls.values() if p.true_means.size), np.empty(0))
    if not 0 < means.size <= MOST_ARMS:
        return None
    gaps = means.max(axis=1, keepdims=True) - means
    # NaN where an agent never saw the context.
    regrets = {agent: (share * gaps).sum(axis=1) for agent, share in shares.items()}
    return {"means": means, "gaps": gaps, "shares": shares, "regrets": regrets}


MOST_EXPLAINED = 8  # the largest number of agents per environment, because each is loaded


def why(report: Report) -> Section | None:
    """Where the median run of each agent loses return; None if no gap can be split."""
    analysis = report.analysis
    chosen = [_median_runs(analysis, one)[:MOST_EXPLAINED] for one in analysis.environments]
    asked = [run for runs in chosen for run in runs]
    answers = iter(do_aside(whys_of, asked) if asked else ())
    told = [[(run, next(answers)) for run in runs] for runs in chosen]
    told = [[(run, why) for run, why in of_runs if why is not None] for of_runs in told]
    if not any(told):
        return None
    return Section("why", "Why not optimal", {"told": told}, by_environment=True)


def _median_runs(analysis: StudyAnalysis, environment: EnvironmentAnalysis) -> list[PlannedRun]:
    """Each agent's run with the (lower) median final return among its exactly evaluated runs."""
    table, label = analysis.results.summary, environment.environment
    exact = table[(table["environment"] == label) & (table["exact"] == True)]  # noqa: E712  # or None
    here = [run for run in analysis.results.finished if run.environment == label]
    runs = {(run.agent, run.seed): run for run in here}
    found = []
    for agent in environment.agents:
        rows = exact[exact["agent"] == agent.agent].sort_values("final", kind="stable")
        if len(rows) and runs:  # none where the runs were done elsewhere
            found.append(runs[agent.agent, int(rows["seed"].iloc[(len(rows) - 1) // 2])])
    return found


def diagnosis(report: Report) -> Section | None:
    """A curve for each figure of `diagnosis.csv`; None where no run has one."""
    analysis = report.analysis
    data = [_compared(analysis, environment) or None for environment in analysis.environments]
    if not any(data):
        return None
    title = "Critics and gradients"
    return Section("diagnosis", title, data=MEANINGS, places=data, by_environment=True)


def _compared(
    analysis: StudyAnalysis, environment: EnvironmentAnalysis
) -> dict[str, dict[str, Curve]]:
    """By column of the files and by agent, the mean over seeds with its interval."""
    rows: dict[tuple[str, str], list[pd.DataFrame]] = {}
    for planned in analysis.results.finished:
        here = planned.environment == environment.environment
        if here and (planned.path / "diagnosis.csv").exists():
            table = pd.DataFrame(read_compared(planned.path))
            for name in table.columns.drop("timesteps"):
                known = table[["timesteps", name]].dropna().set_axis(["step", "value"], axis=1)
                if len(known):
                    rows.setdefault((name, planned.agent), []).append(known)
    curves: dict[str, dict[str, Curve]] = {}
    for name in MEANINGS:
        for agent in (one.agent for one in environment.agents):
            if (curve := mean_of(rows.get((name, agent), []), "step")) is not None:
                curves.setdefault(name, {})[agent] = curve
    return curves


MAX_MAPS = 40  # of a run: more than a slider needs
MIN_MAPS = 2  # the first and the last
MAPS = {
    "timesteps": "n",
    "values": "n states",
    "actions": "n states",
    "optimal_values": "states",
    "optimal_actions": "states choices",
}
# The most values and actions on a page, shared by its environments; each takes 4 bytes.
MAX_FIGURES = 200_000

Arrays = Mapping[str, NDArray[Any]]


def policies(report: Report) -> Section | None:
    """What agents do on each cell of a grid world, over their training, beside the optimum."""
    analysis = report.analysis
    room = MAX_FIGURES // len(analysis.environments)
    data = [_policy_data(analysis, environment, room) for environment in analysis.environments]
    if not any(data):
        return None
    return Section("policies", "Policies", places=data, by_environment=True)


def _policy_data(
    analysis: StudyAnalysis, environment: EnvironmentAnalysis, room: int
) -> dict[str, Any] | None:
    order = [agent.agent for agent in environment.agents]
    runs = [
        run
        for run in analysis.results.finished
        if run.environment == environment.environment and (run.path / "value_maps.npz").exists()
    ]
    if not runs:
        return None
    # By seed, the best agent first.
    runs.sort(key=lambda run: (run.seed, order.index(run.agent)))
    with closing(make_single_env(runs[0].spec)) as env:
        layout, model = grid_layout(env), transition_model(env)
    if layout is None or model is None or not (maps := _read_maps(runs, layout, room)):
        return None
    optimum = next(iter(maps.values()))
    return {
        **layout_data(layout),
        # Numbers below ten as one text, which is shortest; also the actions below.
        "matters": "".join(map(str, model.reachable.astype(np.int64).tolist())),
        "optimum": {
            "values": optimum["optimal_values"],
            # Bit a of a state's number is set if action a is optimal there.
            "actions": (optimum["optimal_actions"] << np.arange(len(layout.moves))).sum(axis=1),
        },
        "runs": [
            {
                "agent": agent,
                "seed": seed,
                "steps": arrays["timesteps"],
                "values": arrays["values"],
                "actions": [
                    "".join(map(str, row)) for row in arrays["actions"].astype(np.int64).tolist()
                ],
            }
            for (agent, seed), arrays in maps.items()
        ],
    }


def _read_maps(
    runs: Sequence[PlannedRun], layout: GridLayout, room: int
) -> dict[tuple[str, int], Arrays]:
    """The maps by agent and seed: of the first seed, and of as many others as fit."""
    n_agents = sum(run.seed == runs[0].seed for run in runs)
    # All agents of the first seed fit, if necessary with few moments.
    n_maps = min(max(room // (2 * layout.n_states * n_agents), MIN_MAPS), MAX_MAPS)
    maps: dict[tuple[str, int], Arrays] = {}
    figures = 0
    for run in runs:
        arrays = read_arrays(run.path / "value_maps.npz", MAPS)
        n = len(arrays["timesteps"])
        if n > n_maps:  # the first and the last among them
            kept = np.linspace(0, n - 1, n_maps).round().astype(np.int64)
            arrays |= {name: arrays[name][kept] for name in ("timesteps", "values", "actions")}
        if arrays["optimal_actions"].shape != (layout.n_states, len(layout.moves)):
            continue  # an agent that was given another map
        figures += 2 * arrays["values"].size
        if figures > room and run.seed != runs[0].seed:
            # All agents of a seed, or none of them.
            return {key: found for key, found in maps.items() if key[1] != run.seed}
        maps[run.agent, run.seed] = arrays
    return maps


MOST_FILMED = 8  # agents of an environment, the best of them
ALL_BYTES = 1_000_000  # of the films of a page, before base64


def played_episodes(report: Report) -> Section | None:
    """An episode of each agent as an animated picture; None where nothing can be drawn."""
    ranked = first_runs(report.analysis)
    to_film = [run for runs in ranked for run in runs[:MOST_FILMED]]
    made = [film_of(run) if has_film(run) else do_aside(film_of, run) for run in to_film]
    paths = dict(zip((run.path for run in to_film), made, strict=True))
    contents: dict[bytes, int] = {}  # of each film its place on the page; equal films share one
    groups: list[list[dict[str, Any]]] = [[] for _ in ranked]
    without_room: list[list[str]] = [[] for _ in ranked]
    for place, runs in enumerate(ranked):
        for run in runs[:MOST_FILMED]:
            if (path := paths[run.path]) is None:
                continue
            content = read_bytes(path)
            # Space that an environment does not use is left to the next ones.
            room = ALL_BYTES * (place + 1) // len(ranked) - sum(map(len, contents))
            if content in contents or len(content) <= room:
                film = {"place": contents.setdefault(content, len(contents))}
                groups[place].append({"agent": run.agent, **film, **_film(path, content)})
            else:
                without_room[place].append(run.agent)
    if not any(groups):
        return None
    data = [data_uri("image/gif", content) for content in contents]
    not_filmed = [[run.agent for run in runs[MOST_FILMED:]] for runs in ranked]
    context = {"films": groups, "without_room": without_room, "not_filmed": not_filmed}
    return Section("films", "Episodes", context, data, by_environment=True)


def _film(path: Path, content: bytes) -> dict[str, Any]:
    """The first frame as a data URI, its size in pixels, and a caption with the return."""
    still = io.BytesIO()
    with Image.open(io.BytesIO(content)) as picture:
        width, height = picture.size
        picture.convert("RGB").quantize(64).save(still, "PNG", optimize=True)
    episode = read_json(path.with_suffix(".json"))
    shown, steps = episode["frames"] - 1, episode["steps"]
    if steps is None:
        caption = f"the first {shown} steps"
    else:
        caption = f"return {number(episode['return'])} in {steps} step{'s' if steps > 1 else ''}"
        caption += f", of which these are the first {shown}" if shown < steps else ""
    address = data_uri("image/png", still.getvalue())
    return {"still": address, "width": width, "height": height, "caption": caption}
