"""What the page plays, as data: the steps, where states lie on a map, and what actions are called.

Numbers are written with all their digits: what the page shows is what the agent computed.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.known_models import observations_of_states
from envs.layout import GridLayout, action_names, grid_layout
from mdp.array_types import Floats
from pipeline.environments import make_single_env
from pipeline.evaluation.value_maps import MAX_STATES
from pipeline.train_spec import TrainSpec
from pipeline.watching.map_recorder import LOGGED, MapRecorder
from pipeline.watching.table_recorder import TableRecorder
from report.page.sections import layout_data


def steps_data(recorder: TableRecorder, most_steps: int) -> dict[str, Any]:
    """Steps of an agent that learns in tables.

    Args:
        recorder: what was kept of it.
        most_steps: how many of them: of the first episodes the first, else the last, since there
            the return has risen.
    """
    begin, end = recorder.window()
    if recorder.n_episodes:
        end = min(end, begin + most_steps)
    else:
        begin = max(begin, end - most_steps)
    steps = recorder.steps.rows[begin:end]
    moves, changes = (
        _between(kept.rows, begin, end) for kept in (recorder.moves, recorder.changes)
    )
    return {
        "kind": "steps",
        "tables": [_table(name, table) for name, table in _tables_before(recorder, begin).items()],
        "steps": _columns(steps),
        "moves": _columns(moves),
        "changes": _columns(changes),
        "begin": begin,
        "is_cut": recorder.is_cut or end - begin < len(recorder.steps),
        "is_longer": recorder.model.num_timesteps > steps["timesteps"][-1],
    }


def _between(rows: NDArray[np.void], begin: int, end: int) -> NDArray[np.void]:
    """Those of some steps, of which the first has the number 0."""
    chosen = rows[(rows["step"] >= begin) & (rows["step"] < end)].copy()
    chosen["step"] -= begin
    return chosen


def _tables_before(recorder: TableRecorder, step: int) -> dict[str, Floats]:
    """The tables as they were before a step."""
    tables = {name: recorder.initial[name].copy() for name in recorder.names}
    earlier = recorder.changes.rows[recorder.changes.rows["step"] < step]
    for number, table in enumerate(tables.values()):
        moved = earlier[earlier["table"] == number]
        table.reshape(-1)[moved["entry"]] = moved["after"]  # of several the last
    return tables


def maps_data(recorder: MapRecorder, stride: int) -> dict[str, Any]:
    """What an agent did in every state as it learnt, and what each state was worth then.

    Args:
        recorder: what was kept of it.
        stride: of how many updates or evaluations one is shown, and the last in any case.
    """
    evaluator, rows = recorder.evaluator, recorder.moments.rows
    is_shown = rows["number"] % stride == 0
    is_shown[-1] = True
    shown = rows[is_shown]
    optimal = evaluator.optimum[0][evaluator.model.reachable]
    return {
        "kind": "maps",
        "unit": recorder.unit,
        "n_units": recorder.n_units,
        "stride": stride,
        "moments": {
            **_columns(shown),
            "values": np.where(evaluator.model.reachable, shown["values"], np.nan),
            "return": shown["values"] @ evaluator.model.initial,
        },
        "logged": LOGGED,
        "optimum": evaluator.yardstick.optimum,
        "optimal_range": [optimal.min(), optimal.max()],
    }


def place_data(spec: TrainSpec, recorder: TableRecorder | MapRecorder) -> dict[str, Any]:
    """Where states lie, and what actions are called."""
    if isinstance(recorder, MapRecorder):
        evaluator = recorder.evaluator
        return _place(spec, (evaluator.model.n_states, evaluator.model.n_actions), evaluator.layout)
    has_rows = recorder.has_actions
    shape = recorder.initial[recorder.names[0]].shape if has_rows else (0, 0)
    return _place(spec, (shape[-2], shape[-1]))


def exact_json(value: Any) -> str:
    """The value as JSON: every number to its last digit, null for nan, and infinity as a word."""
    return json.dumps(_plain(value), separators=(",", ":"), allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        if math.isnan(value):
            return None
        if math.isinf(value):
            return "Infinity" if value > 0 else "-Infinity"
        return int(value) if value.is_integer() and abs(value) < 2**53 else value
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def _columns(rows: NDArray[np.void]) -> dict[str, Any]:
    return {name: rows[name] for name in rows.dtype.names or ()}


def _table(name: str, values: Floats) -> dict[str, Any]:
    fill = values.reshape(-1)[0]
    is_even = bool((values == fill).all())
    initial = {"fill": float(fill)} if is_even else {"values": values.reshape(-1)}
    return {"name": name, "shape": values.shape, **initial}


def _place(
    spec: TrainSpec, shape: tuple[int, int], layout: GridLayout | None = None
) -> dict[str, Any]:
    n_states, n_actions = shape
    env = make_single_env(spec, training=True)
    try:
        layout = layout or _layout_of(env, n_states)
        names = action_names(env)
        n_arms = int(getattr(env.action_space, "n", n_actions))
    finally:
        env.close()
    if len(names) < n_arms:
        names = tuple(f"action {action}" for action in range(n_arms))
    return {
        "n_states": n_states,
        "actions": names[:n_arms],
        "layout": None if layout is None else layout_data(layout),
        "is_drawn": 1 < n_states <= MAX_STATES,
    }


def _layout_of(env: Any, n_states: int) -> GridLayout | None:
    """The map, where the agent observes the number of the state."""
    layout = grid_layout(env)
    if layout is None or layout.n_states != n_states:
        return None
    seen = observations_of_states(env)
    is_number = seen is not None and np.array_equal(seen, np.arange(n_states))
    return layout if is_number else None
