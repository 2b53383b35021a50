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
from envs.layout import GridLayout, grid_layout
from mdp.array_types import Floats
from pipeline.environments import make_single_env
from pipeline.evaluation.value_maps import MAX_STATES
from pipeline.train_spec import TrainSpec
from pipeline.watching.map_recorder import MapRecorder
from pipeline.watching.table_recorder import TableRecorder

MOST_FIGURES = 200_000  # of all maps together


def steps_data(spec: TrainSpec, recorder: TableRecorder, most_steps: int) -> dict[str, Any]:
    """The first steps of an agent that learns in tables.

    Args:
        spec: of the training.
        recorder: what was kept of it.
        most_steps: how many of them.
    """
    n = min(most_steps, len(recorder.steps))
    moves, changes = recorder.moves.rows, recorder.changes.rows
    data = {
        "kind": "steps",
        "tables": [_table(name, recorder.initial[name]) for name in recorder.names],
        "steps": _columns(recorder.steps.rows[:n]),
        "moves": _columns(moves[moves["step"] < n]),
        "changes": _columns(changes[changes["step"] < n]),
        "is_cut": recorder.is_cut or n < len(recorder.steps),
    }
    shape = recorder.initial[recorder.names[0]].shape if recorder.has_actions else (0, 0)
    return {**data, **_place(spec, (shape[-2], shape[-1]))}


def maps_data(spec: TrainSpec, recorder: MapRecorder) -> dict[str, Any]:
    """What an agent did in every state at each evaluation, and what each state was worth then."""
    evaluator = recorder.evaluator
    most = max(MOST_FIGURES // (2 * evaluator.model.n_states), 2)
    kept = np.unique(np.linspace(0, len(recorder.moments) - 1, most).round().astype(np.int64))
    moments = [recorder.moments[index] for index in kept]
    shape = (evaluator.model.n_states, evaluator.model.n_actions)
    return {
        "kind": "maps",
        "moments": [
            {
                "timesteps": timesteps,
                "exploration": rate,
                "return": float(evaluator.model.initial @ values),
                "values": np.where(evaluator.model.reachable, values, np.nan),
                "actions": actions,
            }
            for timesteps, rate, values, actions in moments
        ],
        "optimum": evaluator.yardstick.optimum,
        **_place(spec, shape, evaluator.layout),
    }


def exact_json(value: Any) -> str:
    """The value as JSON, every number to its last digit, and null for what is not finite."""
    return json.dumps(_plain(value), separators=(",", ":"), allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
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
    """Where states lie, and what actions are called."""
    n_states, n_actions = shape
    env = make_single_env(spec, training=True)
    try:
        layout = layout or _layout_of(env, n_states)
        given = getattr(env.unwrapped, "action_names", None)
        n_arms = int(getattr(env.action_space, "n", n_actions))
    finally:
        env.close()
    names = [str(name) for name in given] if isinstance(given, tuple | list) else []
    if len(names) < n_arms:
        names = [f"action {action}" for action in range(n_arms)]
    return {
        "n_states": n_states,
        "actions": names[:n_arms],
        "layout": None if layout is None else _layout_data(layout),
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


def _layout_data(layout: GridLayout) -> dict[str, Any]:
    return {
        "rows": layout.rows,
        "moves": layout.moves,
        "names": dict(layout.names),
        "layers": [layout.collected_in(layer) for layer in range(layout.n_layers)],
    }
