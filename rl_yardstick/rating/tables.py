"""Turns what people save as a Q-table into one array of states and actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.mdp.transition_model import Floats, Ints
from rl_yardstick.pipeline.errors import UserError, one_line, shown
from rl_yardstick.rating.worlds import World, by, key_of
from rl_yardstick.safe_files.files import NO_LIMIT, Budget
from rl_yardstick.safe_files.tables import table_of_text

SUMS_TO_ONE = 1e-6
# Names of the table among the contents of a file, the likeliest first.
USUAL_NAMES = ("qtable", "q_table", "q", "q_values", "qvalues", "table", "policy")


class Table(NamedTuple):
    """The values of actions, or their probabilities, in each state that can be observed."""

    values: Floats  #: shape (rows, actions), of `World.rows`; nan in states that a policy lacks
    is_policy: bool  #: whether they are probabilities
    note: str = ""  #: how the source was read, where that is not obvious


def tables_in(content: Any) -> dict[str, Any]:
    """What may be a table in the content of a file, by name; by an empty name if it stands alone.

    Among the entries of a dictionary, one with a usual name comes alone.
    """
    if isinstance(content, np.ndarray) and content.dtype == object:
        content = content.item() if content.ndim == 0 else content.tolist()
    found = {"": content}
    if isinstance(content, Mapping) and any(isinstance(k, str) and not key_of(k) for k in content):
        found = {str(key): value for key, value in content.items() if not isinstance(value, str)}
    elif isinstance(content, list | tuple):
        tables = [one for one in content if isinstance(one, Mapping) or getattr(one, "ndim", 0) > 1]
        found = {str(place): one for place, one in enumerate(tables)} or found
    usual = [one for name in USUAL_NAMES for one in found if one.lower() == name][:1]
    found = {name: found[name] for name in usual or found if hasattr(found[name], "__len__")}
    return {"": next(iter(found.values()))} if len(found) == 1 else found


def as_table(content: Any, world: World) -> Table:
    """The table of an array, a list, or a dictionary of states; masked actions are illegal.

    Raises:
        UserError: if it is none of the environment's, with the shape that would be right.
    """
    try:
        if hasattr(content, "to_csv"):  # of pandas
            content = table_of_text(content.to_csv(na_rep="nan"), Budget(NO_LIMIT))
        if isinstance(content, Mapping) and content:
            return _of_mapping(content, world)
        legal: Any = np.ma.asarray(content, np.float64).filled(-np.inf)
        return _of_array(np.asarray(legal).squeeze(), world)
    except (ValueError, TypeError, OverflowError, RuntimeError) as error:
        why = "rows of different lengths" if "inhomogeneous" in str(error) else one_line(error)
        raise UserError(f"holds no table ({why:.200}): {world.needs()}") from error


def _of_array(array: NDArray[Any], world: World) -> Table:
    shape, (n, n_actions) = array.shape, world.shape
    if shape == (n + 1, n_actions) and (array[0] == range(n_actions)).all():
        return _of_array(array[1:], world)  # below the numbers of the actions
    if shape in ((n,), world.sizes):
        return _of_actions(array.ravel(), np.arange(n), world)
    if shape in ((n, n_actions), (*world.sizes, n_actions)):
        return _of_values(array.reshape(n, n_actions), np.arange(n), world)
    if shape == (n_actions, n):
        note = f"read transposed: it is {by(shape)}, actions x states"
        return _of_values(array.T, np.arange(n), world, note)
    lakes = {(16, 4): "4x4", (64, 4): "8x8"} if "FrozenLake" in world.name else {}
    hint = f"; it fits --env-kwargs map_name:{lakes[shape]}" if shape in lakes else ""
    raise UserError(f"holds a table of shape {by(shape)}: {world.needs()}{hint}")


def _of_actions(actions: NDArray[Any], rows: Ints, world: World) -> Table:
    """The table of one action in each state."""
    if not np.isin(actions, range(world.shape[1])).all():
        raise UserError(f"holds one value of each state: {world.needs()}")
    chances = np.eye(world.shape[1])[actions.astype(np.int64)]
    return _of_values(chances, rows, world, "it holds actions: rated as a policy")


def _of_values(values: NDArray[Any], rows: Ints, world: World, note: str = "") -> Table:
    """The table with values of these rows; if all are probabilities, it is a policy."""
    if len(wrong := rows[np.isnan(values).any(axis=1)]):
        raise UserError(f"holds nan in states {shown(wrong.tolist())}: illegal actions need -inf")
    is_policy = bool((abs(values.sum(axis=1) - 1) <= SUMS_TO_ONE).all() and (values >= 0).all())
    table = np.full(world.shape, np.nan if is_policy else 0.0)
    table[rows] = values / values.sum(axis=1, keepdims=True) if is_policy else values
    told = "its rows sum to 1: rated as probabilities of actions" if is_policy else ""
    return Table(table, is_policy, note or told)


def _of_mapping(content: Mapping[Any, Any], world: World) -> Table:
    """The table of a dictionary by state, or by state and action."""
    missing, n_actions = 0.0, world.shape[1]
    if all(isinstance(row, Mapping) for row in content.values()):
        missing = -np.inf  # an action that is left out cannot be chosen
        content = {(state, one): row[one] for state, row in content.items() for one in row}
    keys = {key: key_of(key) for key in content}
    width = len(next(iter(keys.values())))
    last = {parts: key for key, parts in keys.items()}
    wrong = [k for k, parts in keys.items() if not parts or len(parts) != width or last[parts] != k]
    if wrong:
        told = f"{shown(wrong[0])}, which is no state of {world.name}, nor one with an action"
        raise UserError(f"has the key {told} from 0 to {n_actions - 1}")
    legal = [np.ma.filled(np.asanyarray(row, np.float64), -np.inf) for row in content.values()]
    parts, values = np.array([*keys.values()]), np.array(legal)
    if values.ndim == 1 and width - 1 in (1, len(world.sizes)):
        rows, actions = world.rows(parts[:, :-1]), parts[:, -1]
        if beyond := [action for action in actions.tolist() if not 0 <= action < n_actions]:
            raise UserError(f"has an action {beyond[0]}: {world.name} has 0 to {n_actions - 1}")
        table, known = np.full(world.shape, missing), np.unique(rows)
        table[rows, actions] = values
        return _of_values(table[known], known, world)
    rows = world.rows(parts)
    if values.ndim == 1:
        return _of_actions(values, rows, world)
    if values.shape[1:] != (n_actions,):
        raise UserError(f"has {values[0].size} values of a state: {world.needs()}")
    return _of_values(values, rows, world)
