"""What agents do on each cell of a grid world, over their training, beside the optimum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.known_models import transition_model
from envs.layout import GridLayout, grid_layout
from experiments.analysis import EnvironmentAnalysis, StudyAnalysis
from experiments.plan import PlannedRun
from experiments.run_files import read_value_maps
from pipeline.environments import make_single_env
from report.page.sections import Report, Section, layout_data

MAX_MAPS = 40  # of a run: more than a slider needs
MIN_MAPS = 2  # the first and the last
# Figures of a page, values and actions of all maps, which environments share; each takes 4 bytes.
MAX_FIGURES = 200_000

Arrays = Mapping[str, NDArray[Any]]


def section(report: Report) -> Section | None:
    """The maps of every grid world; None where there is none."""
    analysis = report.analysis
    room = MAX_FIGURES // len(analysis.environments)
    data = [_environment_data(analysis, environment, room) for environment in analysis.environments]
    if not any(data):
        return None
    context = {"is_drawn": [item is not None for item in data]}
    return Section("policies", "Policies", context, places=data, by_environment=True)


def _environment_data(
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
