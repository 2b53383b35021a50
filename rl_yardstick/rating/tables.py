"""Turns what people save as a Q-table into one array of states and actions."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.errors import UserError, one_line, shown

SUMS_TO_ONE = 1e-6
# Where a table of another shape may come from.
USUAL_SHAPES: Mapping[tuple[int, ...], str] = {
    (16, 4): "FrozenLake-v1",
    (64, 4): "FrozenLake-v1 with --env-kwargs map_name:8x8",
    (48, 4): "CliffWalking-v1",
    (500, 6): "Taxi-v4",
    (704, 2): "Blackjack-v1",
}
# Names of the table among the contents of a file, the likeliest first.
USUAL_NAMES = ("qtable", "q_table", "q", "q_values", "qvalues", "table", "policy")
# Numbers in a text, but not the digits of a name such as int64.
_NUMBERS = re.compile(r"(?<![\w.])-?\d+(?:\.0*)?(?![\w.])|\b(?:True|False)\b")


@dataclass(frozen=True, eq=False)
class Table:
    """The values of actions, or their probabilities, in each state that can be observed."""

    values: Floats  #: shape (rows, actions), as numbered by `Rows`
    is_policy: bool  #: whether they are probabilities
    filled: Bools  #: the rows that the source has, shape (rows,)
    notes: tuple[str, ...] = ()  #: how the source was read, where that is not obvious


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows and columns of an environment's tables.

    The row of an observation is the number of its parts, the last one counting fastest.
    """

    name: str  #: of the environment
    sizes: tuple[int, ...]  #: how many values each part of an observation has
    first: Ints  #: the first value of each part
    n_actions: int
    actions: tuple[str, ...] = ()  #: their names, if there are any
    grid: tuple[int, int] | None = None  #: rows and columns of its map, if states are cells
    seen: Ints | None = None  #: the parts of the observations that can occur, (n, parts), if known

    def shape(self) -> str:
        """The shape of its tables, in words."""
        n = math.prod(self.sizes)
        folded = "" if len(self.sizes) == 1 else f" or {_by((*self.sizes, self.n_actions))}"
        return f"{self.name} needs {n} x {self.n_actions}{folded} (states x actions)"

    def numbers(self, parts: Ints) -> Ints | None:
        """The rows of states, given as observations, as rows, or as places on a map, (n, parts).

        None if states have another number of parts.

        Raises:
            UserError: if there is no such state.
        """
        known = {1: (math.prod(self.sizes),), 2: self.grid, len(self.sizes): self.sizes}
        sizes = known.get(parts.shape[1])
        if sizes is None:
            return None
        places = parts - (self.first if sizes == self.sizes else 0)
        wrong = ((places < 0) | (places >= sizes)).any(axis=1)
        if wrong.any():
            found = ", ".join(map(str, parts[wrong][-1]))
            hint = _hint((int(parts.max()) + 1, self.n_actions)) if len(sizes) == 1 else ""
            raise UserError(f"has a state {found}: {self.shape()}{hint}")
        rows: Ints = np.ravel_multi_index(tuple(places.T), sizes)
        return rows


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape)) or "one number"


def _hint(shape: tuple[int, ...]) -> str:
    """Where a table of another shape may come from."""
    known = USUAL_SHAPES.get(shape)
    return f"; {_by(shape)} is the shape of {known}" if known else ""


def parts_of(space: spaces.Space[Any]) -> list[tuple[int, int]] | None:
    """The sizes and first values of the whole numbers in an observation; None if it has others."""
    if isinstance(space, spaces.Discrete):
        return [(int(space.n), int(space.start))]
    if isinstance(space, spaces.MultiDiscrete):
        return list(zip(space.nvec.ravel().tolist(), space.start.ravel().tolist(), strict=True))
    if isinstance(space, spaces.MultiBinary):
        return [(2, 0)] * math.prod(space.shape)
    if isinstance(space, spaces.Box) and np.dtype(space.dtype).kind in "iu":
        bounds = zip(space.low.ravel().tolist(), space.high.ravel().tolist(), strict=True)
        return [(last - first + 1, first) for first, last in bounds]
    if not isinstance(space, spaces.Tuple | spaces.Dict):
        return None
    members = space.values() if isinstance(space, spaces.Dict) else space.spaces
    found = [parts_of(member) for member in members]
    return None if None in found else [part for parts in found for part in parts or ()]


# --- the tables in a file -------------------------------------------------------------------------


def tables_in(content: Any) -> dict[str, Any]:
    """What may be a table in the content of a file, by name; by an empty name if it stands alone.

    Among the entries of a dictionary, one with a usual name comes alone. Several arrays in a list
    are those of double Q-learning, which acts by their sum.
    """
    if isinstance(content, np.ndarray) and content.dtype == object:
        content = content.item() if content.ndim == 0 else content.tolist()
    is_mapping = isinstance(content, Mapping)
    if is_mapping and any(isinstance(key, str) and key_of(key) is None for key in content):
        named = {str(key).lower(): value for key, value in content.items()}
        usual = [name for name in USUAL_NAMES if name in named][:1]
        found = {name: named[name] for name in usual or named if _may_be_table(named[name])}
        return {"": next(iter(found.values()))} if len(found) == 1 else found
    arrays = content if isinstance(content, list | tuple) and 1 < len(content) < 5 else [content]
    if len(arrays) > 1 and all(isinstance(one, np.ndarray | Mapping) for one in arrays):
        summed = {}
        if all(isinstance(one, np.ndarray) and one.shape == arrays[0].shape for one in arrays):
            summed["sum"] = np.sum(arrays, axis=0)
        return {**summed, **{str(place): part for place, part in enumerate(arrays)}}
    return {"": content} if _may_be_table(content) else {}


def _may_be_table(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.size > 1
    return isinstance(value, list | tuple | Mapping) and len(value) > 1


def as_table(content: Any, rows: Rows) -> Table:
    """The table of an array, a list, or a dictionary of states.

    Raises:
        UserError: if it is none of the environment's, with the shape that would be right.
    """
    if isinstance(content, list | tuple) and content and isinstance(content[0], Mapping):
        content = dict(enumerate(content))
    try:
        if isinstance(content, Mapping):
            return _of_mapping(content, rows)
        array = np.asarray(content)
        if array.dtype.kind in "biuf" and array.size > 1:
            return _of_array(array.squeeze(), rows)
        fault = "no numbers"
    except (ValueError, TypeError, OverflowError) as error:
        fault = one_line(error)
    raise UserError(f"holds no table ({fault}): {rows.shape()}")


def _of_array(array: NDArray[Any], rows: Rows) -> Table:
    shape, n, n_actions = array.shape, math.prod(rows.sizes), rows.n_actions
    if shape in ((n,), rows.grid) and _are_actions(array, n_actions):
        return _as_policy(array.ravel(), np.arange(n), rows)
    folded = [(n, n_actions), (*rows.sizes, n_actions), (*(rows.grid or ()), n_actions)]
    if shape in folded:
        return _as_values(array.reshape(n, n_actions), rows)
    if shape == (n_actions, n):
        return _as_values(array.T, rows, f"read transposed: it is {_by(shape)}, actions x states")
    if rows.seen is not None and array.ndim == len(rows.sizes) + 1 > 2 and shape[-1] == n_actions:
        places = rows.seen - rows.first  # such as sums up to 21, of 31, in Blackjack
        if (places < shape[:-1]).all():
            values, numbers = np.zeros((n, n_actions)), rows.numbers(rows.seen)
            values[numbers] = array[tuple(places.T)]
            return _as_values(values, rows, f"read by its axes {_by(shape)}", numbers)
    what = "one value of each state" if shape == (n,) else f"a table of shape {_by(shape)}"
    raise UserError(f"holds {what}: {rows.shape()}{_hint(shape)}")


def _are_actions(array: NDArray[Any], n_actions: int) -> bool:
    return bool((array == np.floor(array)).all() and (array >= 0).all() and array.max() < n_actions)


def _as_policy(actions: NDArray[Any], numbers: Ints, rows: Rows) -> Table:
    """The table of one action in each state; the first action in others."""
    taken = np.zeros(math.prod(rows.sizes), np.int64)
    taken[numbers] = actions
    filled = np.isin(np.arange(len(taken)), numbers)
    note = "one action of each state: rated as a policy"
    return Table(np.eye(rows.n_actions)[taken], True, filled, (note,))


def _as_values(
    values: NDArray[Any], rows: Rows, note: str = "", numbers: Ints | None = None
) -> Table:
    """The table of values (n, A); if all of its rows are probabilities, it is a policy."""
    values = np.array(values, np.float64)
    if np.isnan(values).any():
        raise UserError(f"holds nan in {int(np.isnan(values).any(axis=1).sum())} states")
    filled = np.ones(len(values), np.bool_)
    if numbers is not None:
        filled = np.isin(np.arange(len(values)), numbers)
    sums = np.abs(values[filled].sum(axis=1) - 1) <= SUMS_TO_ONE
    is_policy = bool(sums.all() and (values >= 0).all())
    values[~filled] = 1 / rows.n_actions if is_policy else 0.0
    told = "its rows sum to 1: rated as probabilities of actions" if is_policy else ""
    return Table(values, is_policy, filled, tuple(filter(None, (note, told))))


# --- dictionaries ---------------------------------------------------------------------------------


def key_of(key: Any) -> tuple[int, ...] | None:
    """The numbers that a state, or a state and an action, consists of; None if it has others."""
    if isinstance(key, str):
        found = _NUMBERS.findall(key.replace("True", "1").replace("False", "0"))
        return tuple(int(float(number)) for number in found) or None
    if isinstance(key, np.ndarray | Mapping):  # an observation
        key = key.ravel().tolist() if isinstance(key, np.ndarray) else list(key.values())
    if isinstance(key, tuple | list):
        parts = [key_of(part) for part in key]
        return None if None in parts else tuple(one for part in parts for one in part or ())
    number = key.item() if isinstance(key, np.generic) else key
    is_whole = isinstance(number, int) or (isinstance(number, float) and number.is_integer())
    return (int(number),) if is_whole else None


def _of_mapping(content: Mapping[Any, Any], rows: Rows) -> Table:
    """The table of a dictionary by state, or by state and action."""
    names = {name.lower(): number for number, name in enumerate(rows.actions)}

    def named(key: Any) -> Any:  # with the number of an action in place of its name
        if isinstance(key, tuple) and key and isinstance(key[-1], str):
            return (*key[:-1], names.get(key[-1].lower(), key[-1]))
        return names.get(key.lower(), key) if isinstance(key, str) else key

    keys = {key: key_of(named(key)) for key in content}
    if len({len(numbers or ()) for numbers in keys.values()}) != 1 or None in keys.values():
        wrong = next((key for key, numbers in keys.items() if numbers is None), next(iter(keys)))
        raise UserError(f"has the key {shown(wrong)}, which is no state of {rows.name}")
    numbers, values = np.array(list(keys.values())), list(content.values())
    table = np.zeros((math.prod(rows.sizes), rows.n_actions))
    are_numbers = not any(isinstance(value, Mapping) or np.ndim(value) for value in values)
    states = rows.numbers(numbers[:, :-1]) if are_numbers else None
    if states is not None:
        table[states, _checked(numbers[:, -1], rows)] = values
        return _as_values(table, rows, numbers=states)
    states = rows.numbers(numbers)
    if states is None:
        raise UserError(f"has keys such as {shown(next(iter(keys)))}: {rows.shape()}")
    if are_numbers:
        actions = np.array(values, np.float64)
        if not _are_actions(actions, rows.n_actions):
            raise UserError(f"holds one value of each state: {rows.shape()}")
        return _as_policy(actions.astype(np.int64), states, rows)
    for state, value in zip(states, values, strict=True):
        if isinstance(value, Mapping):
            table[state] = -np.inf  # an action that is left out cannot be chosen
            taken = np.array([key_of(named(action)) or (-1,) for action in value])[:, 0]
            table[state, _checked(taken, rows)] = list(value.values())
        elif np.shape(value) == (rows.n_actions,):
            table[state] = value
        else:
            raise UserError(f"has {np.size(value)} values of a state: {rows.shape()}")
    return _as_values(table, rows, numbers=states)


def _checked(actions: Ints, rows: Rows) -> Ints:
    wrong = (actions < 0) | (actions >= rows.n_actions)
    if wrong.any():
        known = f"0 to {rows.n_actions - 1} {' '.join(rows.actions)}".strip()
        raise UserError(f"has an action {actions[wrong][0]}: {rows.name} has {known}")
    return actions
