"""Turns what people save as a Q-table into one array of states and actions."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.envs.layout import GridLayout, action_names
from rl_yardstick.envs.wrappers import DiscretizeObservation
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.errors import UserError, shown

MOST_ROWS = 50_000_000
SUMS_TO_ONE = 1e-6
# Where a table of another shape may come from.
USUAL_SHAPES = {
    (16, 4): "FrozenLake-v1 (map_name:4x4)",
    (64, 4): "FrozenLake-v1 with --env-kwargs map_name:8x8",
    (48, 4): "CliffWalking-v1",
    (500, 6): "Taxi-v4",
    (704, 2): "Blackjack-v1",
}
# Names of the table among the contents of a file, the likeliest first.
USUAL_NAMES = ("qtable", "q_table", "q", "q_values", "qvalues", "q_value", "table", "policy")
# Numbers in a text, but not the digits of a name such as int64.
_NUMBERS = re.compile(r"(?<![\w.])-?\d+(?:\.0*)?(?![\w.])|\b(?:True|False)\b")

Part = tuple[int, int]  # the number of values of a part of an observation, and its first value


@dataclass(frozen=True, eq=False)
class Table:
    """The values of actions, or their probabilities, in each state that can be observed."""

    values: Floats  #: shape (rows, actions), as numbered by `Rows`
    is_policy: bool  #: whether they are probabilities
    filled: Bools  #: the rows that the source has, shape (rows,)
    notes: tuple[str, ...] = ()  #: how the source was read, where that is not obvious


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows and columns of the tables of an environment.

    The row of an observation is the number of its parts, the last one counting fastest.
    """

    name: str  #: of the environment
    parts: tuple[Part, ...]
    n_actions: int
    actions: tuple[str, ...]  #: their names, if there are any
    seen: Ints | None = None  #: the parts of the observations that can occur, if known, (n, parts)
    layout: GridLayout | None = None

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """The number of values of each part."""
        return tuple(size for size, _ in self.parts)

    @cached_property
    def first(self) -> Ints:
        """The first value of each part."""
        return np.array([first for _, first in self.parts])

    @property
    def n(self) -> int:
        """The number of rows."""
        return math.prod(self.sizes)

    @property
    def shape(self) -> str:
        """The shape of a table, in words."""
        axes = [*self.sizes, self.n_actions]
        folded = f", or {self.n} x {self.n_actions}" if len(axes) > 2 else ""
        return f"{by(axes)}{folded} (states x actions)"

    def numbers(self, parts: NDArray[Any]) -> Ints:
        """The rows of observations given by their parts, shape (n, parts).

        Raises:
            UserError: if one is no observation.
        """
        places = np.asarray(parts, np.int64) - self.first
        wrong = ((places < 0) | (places >= self.sizes)).any(axis=1)
        if wrong.any():
            worst = parts[wrong].max(axis=0)
            found = int(worst[0]) if len(worst) == 1 else tuple(worst.tolist())
            n = int(parts.max()) + 1 if len(self.sizes) == 1 else 0
            raise UserError(
                f"state {found} is no observation of {self.name}: its tables are {self.shape}"
                f"{self.hint((n, self.n_actions))}"
            )
        rows: Ints = np.ravel_multi_index(tuple(places.T), self.sizes)
        return rows

    def hint(self, shape: tuple[int, ...]) -> str:
        """Where a table of another shape may come from."""
        if len(shape) == 2 and shape in USUAL_SHAPES and shape[0] != self.n:
            return f"; a table of {by(shape)} fits {USUAL_SHAPES[shape]}"
        side = math.isqrt(shape[0]) if shape else 0
        if self.layout is not None and shape[1:] == (self.n_actions,) and side**2 == shape[0] > 1:
            return f"; it may be of a map of {side} x {side}: give that by --env-kwargs"
        return ""


def by(shape: Sequence[int]) -> str:
    """A shape in words."""
    return " x ".join(map(str, shape)) or "one number"


# --- observations ---------------------------------------------------------------------------------


def rows_of(env: gym.Env[Any, Any], name: str) -> Rows:
    """The rows and columns of an environment's tables.

    Raises:
        UserError: if its observations or actions are not finitely many.
    """
    actions = env.action_space
    if not isinstance(actions, spaces.Discrete):
        raise UserError(f"{name} has actions {actions}: tables need a Discrete action space")
    if isinstance(env, DiscretizeObservation):
        parts: list[Part] | None = [(int(n), 0) for n in env.bins]
    else:
        parts = _parts(env.observation_space)
    if parts is None:
        raise UserError(
            f"{name} has observations {env.observation_space}: give the bins of the table, as in "
            "--bins bins:10 low:[-2.4,-3,-0.2,-3] high:[2.4,3,0.2,3]"
        )
    rows = Rows(name, tuple(parts), int(actions.n), action_names(env))
    if rows.n > MOST_ROWS:
        raise UserError(f"{name} has {rows.n:,} observations, too many for a table")
    return rows


def _parts(space: spaces.Space[Any]) -> list[Part] | None:
    """The whole numbers that an observation consists of; None if it has others."""
    if isinstance(space, spaces.Discrete):
        return [(int(space.n), int(space.start))]
    if isinstance(space, spaces.MultiDiscrete):
        sizes, starts = space.nvec.ravel().tolist(), space.start.ravel().tolist()
        return list(zip(sizes, starts, strict=True))
    if isinstance(space, spaces.MultiBinary):
        return [(2, 0)] * math.prod(space.shape)
    if isinstance(space, spaces.Box) and space.dtype is not None and space.dtype.kind in "iu":
        low, high = space.low.ravel().tolist(), space.high.ravel().tolist()
        return [(last - first + 1, first) for first, last in zip(low, high, strict=True)]
    if not isinstance(space, spaces.Tuple | spaces.Dict):
        return None
    members = space.values() if isinstance(space, spaces.Dict) else space.spaces
    found = [_parts(member) for member in members]
    return None if None in found else [part for parts in found for part in parts or ()]


def flat(observation: Any) -> list[int]:
    """The whole numbers of one observation."""
    if isinstance(observation, Mapping):
        observation = tuple(observation.values())
    if isinstance(observation, tuple | list):
        return [number for part in observation for number in flat(part)]
    numbers: list[int] = np.asarray(observation).ravel().astype(np.int64).tolist()
    return numbers


# --- the tables in a file -------------------------------------------------------------------------


def tables_in(content: Any) -> dict[str, Any]:
    """What may be a table in the content of a file, by name; by an empty name if it is all of it.

    Among the entries of a dictionary, those with a usual name come alone.
    """
    if isinstance(content, np.ndarray) and content.dtype == object:
        content = content.item() if content.ndim == 0 else content.tolist()
    if isinstance(content, Mapping) and any(_key(key) is None for key in content):
        named = {str(key).lower(): str(key) for key in content}
        usual = [named[name] for name in USUAL_NAMES if name in named][:1]
        held = {str(key): value for key, value in content.items()}
        chosen = {key: held[key] for key in usual or held}
        found = {key: value for key, value in chosen.items() if _may_be_table(value)}
        return {"": next(iter(found.values()))} if len(found) == 1 else found
    if isinstance(content, list | tuple) and len(content) <= 4:  # such as two of double Q-learning
        if all(_may_be_table(part) and not isinstance(part, list) for part in content):
            found = {str(place): part for place, part in enumerate(content)}
            arrays = [np.shape(part) for part in content if isinstance(part, np.ndarray)]
            if len(arrays) == len(content) and len(set(arrays)) == 1:
                found = {"sum": sum(content), **found}
            return found
    return {"": content} if _may_be_table(content) else {}


def environment_in(content: Any) -> str | None:
    """The environment's id that the content of a file names, as the course of Hugging Face does."""
    found = content.get("env_id") if isinstance(content, Mapping) else None
    return found if isinstance(found, str) else None


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
    if isinstance(content, Mapping):
        return _of_mapping(content, rows)
    try:
        array = np.asarray(content)
    except ValueError:
        raise UserError("holds lists of different lengths, which are no table") from None
    if array.dtype.kind not in "biuf" or array.size < 2:
        raise UserError(f"holds no table: {rows.name} needs {rows.shape}")
    if np.isnan(array).any():
        raise UserError(f"holds nan in {int(np.isnan(array).any(axis=-1).sum())} rows")
    return _of_array(array, rows)


def _of_array(array: NDArray[Any], rows: Rows) -> Table:
    while array.ndim > 2 and array.shape[0] == 1:
        array = array[0]
    shape, n, n_actions = array.shape, rows.n, rows.n_actions
    grid = None if rows.layout is None else (rows.layout.n_rows, rows.layout.n_columns)
    if shape in ((n,), grid) and _are_actions(array, n_actions):
        return _chosen(array.ravel(), rows)
    if shape == (n,):
        raise UserError(f"holds one value of each state: {rows.name} needs {rows.shape}")
    if shape in (rows.sizes + (n_actions,), (n, n_actions), (grid or ()) + (n_actions,)):
        return _judged(array.reshape(n, n_actions), rows)
    if len(rows.sizes) == 1 and shape == (n + rows.first[0], n_actions):
        return _judged(array[rows.first[0] :], rows, f"read from row {rows.first[0]} on")
    if shape == (n, n_actions + 1) and np.array_equal(array[:, 0], np.arange(n)):
        return _judged(array[:, 1:], rows, "its first column is the number of the state")
    if shape == (n_actions, n):
        return _judged(array.T, rows, f"read transposed: it is {by(shape)} (actions x states)")
    if rows.seen is not None and array.ndim == len(rows.sizes) + 1 > 2 and shape[-1] == n_actions:
        places = rows.seen - rows.first  # such as sums up to 21 instead of 31 in Blackjack
        if (places < shape[:-1]).all():
            values = np.zeros((n, n_actions))
            numbers = rows.numbers(rows.seen)
            values[numbers] = array[tuple(places.T)]
            told = f"read by its axes: it is {by(shape)}, where {by(rows.sizes)} can be observed"
            return _judged(values, rows, told, numbers)
    raise UserError(f"has the shape {by(shape)}: {rows.name} needs {rows.shape}{rows.hint(shape)}")


def _are_actions(array: NDArray[Any], n_actions: int) -> bool:
    whole = array == np.floor(array)
    return bool(whole.all() and array.min() >= 0 and array.max() < n_actions)


def _chosen(actions: NDArray[Any], rows: Rows, numbers: Ints | None = None) -> Table:
    """The table of one action in each state."""
    values, filled = np.zeros((rows.n, rows.n_actions)), np.zeros(rows.n, np.bool_)
    places = np.arange(rows.n) if numbers is None else numbers
    values[:, 0], filled[places] = 1.0, True
    values[places] = np.eye(rows.n_actions)[actions.astype(np.int64)]
    return Table(values, True, filled, ("one action of each state: rated as a policy",))


def _judged(values: NDArray[Any], rows: Rows, note: str = "", numbers: Ints | None = None) -> Table:
    """The table; rows that are probabilities, and not all the same, make it a policy."""
    filled = np.ones(rows.n, np.bool_)
    if numbers is not None:
        filled[:] = False
        filled[numbers] = True
    values, notes = np.asarray(values, np.float64), [note] if note else []
    known = values[filled]
    sums = np.abs(known.sum(axis=1) - 1) <= SUMS_TO_ONE
    is_policy = bool(len(known) and (known >= 0).all() and sums.all())
    if is_policy:
        values[~filled] = 1 / rows.n_actions
        notes.append("each row sums to 1: rated as probabilities of actions")
    return Table(values, is_policy, filled, tuple(notes))


# --- dictionaries ---------------------------------------------------------------------------------


def _key(key: Any) -> tuple[Any, ...] | None:
    """The numbers and names that a state, or a state and an action, consists of; None if none."""
    if isinstance(key, np.generic | np.ndarray):
        key = key.tolist()
    if isinstance(key, float) and key != int(key):
        return None
    if isinstance(key, int | float):  # bool is an int
        return (int(key),)
    if isinstance(key, str):
        found = _NUMBERS.findall(key)
        return tuple(int(float({"True": 1, "False": 0}.get(one, one))) for one in found) or None
    if isinstance(key, tuple | list):
        parts = [_key(part) or ((part,) if isinstance(part, str) else None) for part in key]
        return None if None in parts else tuple(one for part in parts for one in part or ())
    return None


def _of_mapping(mapping: Mapping[Any, Any], rows: Rows) -> Table:
    """The table of a dictionary by state, or by state and action."""
    content = {key: value for key, value in mapping.items() if key is not None}
    keys = [_key(key) for key in content]
    lengths = {len(key) for key in keys if key is not None}
    if None in keys or len(lengths) != 1:
        wrong = next((k for k, key in zip(content, keys, strict=True) if key is None), None)
        what = "keys of different lengths" if wrong is None else f"the key {shown(wrong)}"
        raise UserError(f"is a dictionary with {what}, which is no state of {rows.name}")
    (length,), values = lengths, list(content.values())
    are_numbers = all(np.ndim(value) == 0 and not isinstance(value, Mapping) for value in values)
    n_parts = _n_parts(length, are_numbers, rows)
    if n_parts == 0:
        raise UserError(
            f"has keys of {length} numbers, such as {shown(next(iter(content)))}; an observation "
            f"of {rows.name} has {len(rows.sizes)}"
        )
    states = np.array([[*key[:n_parts]] for key in keys if key], dtype=object)
    try:
        numbers = _numbers_of(states.astype(np.int64), rows)
    except (ValueError, TypeError):
        raise UserError(f"has the key {shown(next(iter(content)))}, which is no state") from None
    if length > n_parts:
        filled = _by_pair(numbers, [key[-1] for key in keys if key], values, rows)
    elif are_numbers:
        array = np.array(values, dtype=np.float64)
        if not _are_actions(array, rows.n_actions):
            raise UserError(f"holds one value of each state: {rows.name} needs one of each action")
        return _chosen(array, rows, numbers)
    else:
        filled = np.zeros((rows.n, rows.n_actions))
        for number, value in zip(numbers.tolist(), values, strict=True):
            filled[number] = _row(value, rows)
    if np.isnan(filled).any():
        raise UserError("holds nan")
    return _judged(filled, rows, numbers=np.unique(numbers))


def _n_parts(length: int, are_numbers: bool, rows: Rows) -> int:
    """How many numbers of a key are the state: all, or all but an action; 0 if that fits nothing.

    A state is an observation, its row, or its place on a map.
    """
    known = [len(rows.sizes), 1] + [2] * (rows.layout is not None)
    wanted = [length - 1] if are_numbers else []
    found = [n for n in (length, *wanted) if n in known]
    # A pair of numbers with a number is a state and an action before it is a place on a map.
    return min(found, default=0) if length == 2 and len(rows.sizes) == 1 else max(found, default=0)


def _numbers_of(states: Ints, rows: Rows) -> Ints:
    n_parts = states.shape[1]
    if n_parts == len(rows.sizes):
        return rows.numbers(states)
    if n_parts == 2 and rows.layout is not None:
        states = states[:, :1] * rows.layout.n_columns + states[:, 1:]
    whole = Rows(rows.name, ((rows.n, 0),), rows.n_actions, rows.actions, layout=rows.layout)
    return whole.numbers(states)


def _action(key: Any, rows: Rows) -> int:
    """The number of an action, from its number or name."""
    names = [name.lower() for name in rows.actions]
    found = _key(key) or ()
    if isinstance(key, str) and key.lower() in names:
        return names.index(key.lower())
    if len(found) == 1 and isinstance(found[0], int) and 0 <= found[0] < rows.n_actions:
        return found[0]
    known = f" or {', '.join(names)}" if names else ""
    raise UserError(f"has the action {shown(key)}: known are 0 to {rows.n_actions - 1}{known}")


def _by_pair(numbers: Ints, actions: list[Any], values: list[Any], rows: Rows) -> Floats:
    """Values of pairs of state and action; missing ones are 0."""
    filled = np.zeros((rows.n, rows.n_actions))
    filled[numbers, [_action(action, rows) for action in actions]] = values
    return filled


def _row(value: Any, rows: Rows) -> NDArray[Any]:
    """The values of one state; actions that a dictionary leaves out cannot be chosen."""
    if isinstance(value, Mapping):
        row = np.full(rows.n_actions, -np.inf)
        for action, number in value.items():
            row[_action(action, rows)] = number
        return row
    found = np.asarray(value, dtype=np.float64)
    if found.shape != (rows.n_actions,):
        raise UserError(f"has {by(found.shape)} values of a state: {rows.n_actions} are needed")
    return found
