"""Worlds on a map: maps, moves, text, stepping and the exact model."""

from __future__ import annotations

import os
from array import array
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.envs.argument_checks import check_flag, check_number
from rl_yardstick.envs.drawing import GridRenderer, Scene
from rl_yardstick.envs.finite_env import (
    FiniteEnv,
    MaskedFiniteEnv,
    first_above,
    summing_to_one,
)
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints, TransitionModel
from rl_yardstick.safe_files.files import UnsafeFileError, content_of

START = "S"
GOAL = "G"
# 4096 x 4096 cells: a Q-table of four actions then fills half a gigabyte.
MAX_STATES = 2**24
# A letter and maybe a line break for each cell.
MAX_MAP_BYTES = 3 * MAX_STATES
UNREACHED = -1

Description = Sequence[str] | str | os.PathLike[str]


@dataclass(frozen=True)
class Grid:
    """Rows of letters; row 0 is at the top, cells are numbered row by row."""

    rows: tuple[str, ...]

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(self.rows)

    @property
    def n_columns(self) -> int:
        """Number of columns."""
        return len(self.rows[0])

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.n_rows * self.n_columns

    def place_name(self, cell: int) -> str:
        """The name of a cell, rows and columns counted from 1 as on all pages and pictures."""
        row, column = divmod(cell, self.n_columns)
        return f"row {row + 1}, column {column + 1}"


@dataclass(frozen=True, eq=False)
class GridMap(Grid):
    """A map that was checked."""

    codes: bytes  # the letters' ASCII codes, one per cell
    start: int  # the cell of the only ``S``
    distances: NDArray[np.int32]  # see `distances_to`, to the nearest goal; shape (cells,)

    @classmethod
    def read(cls, desc: Description, known: Collection[str], passable: Collection[str]) -> GridMap:
        """Read and check a map.

        Args:
            desc: the rows; or the path to a text file that holds them; or that text itself,
                which has at least one line break.
            known: the letters that may occur.
            passable: those of them that the way to the goal may lead over, ``S`` among them.

        Raises:
            ValueError: if the file cannot be read, rows differ in length, a letter is unknown,
                there is not exactly one start or no goal, or no way between them. Rows and columns
                are counted from one.
        """
        rows, source = read_rows(desc), f"the map {desc}" if _is_path(desc) else "the map"
        if not rows or not rows[0]:
            raise ValueError(f"{source} is empty")
        letters, n_columns = "".join(rows), len(rows[0])
        if len(letters) > MAX_STATES:
            raise ValueError(f"{source} has {len(letters):,} cells, more than {MAX_STATES:,}")
        for i, row in enumerate(rows, 1):
            if len(row) != n_columns:
                raise ValueError(f"{source}: row {i} has {len(row)} cells, row 1 has {n_columns}")
        if not set(letters) <= set(known):
            cell = next(cell for cell, letter in enumerate(letters) if letter not in known)
            place = f"{letters[cell]!r} at {Grid(rows).place_name(cell)}"
            raise ValueError(f"{source}: unknown letter {place}; known are {' '.join(known)}")
        goals = [cell for cell, letter in enumerate(letters) if letter == GOAL]
        if letters.count(START) != 1 or not goals:
            found = f"{letters.count(START)} starts {START} and {len(goals)} goals {GOAL}"
            raise ValueError(f"{source} has {found}, it must have one start, and a goal")
        codes, start = letters.encode("ascii"), letters.index(START)
        free = np.isin(np.frombuffer(codes, np.uint8), [ord(letter) for letter in passable])
        distances = distances_to(goals, free.reshape(len(rows), n_columns)).ravel()
        if distances[start] == UNREACHED:
            raise ValueError(
                f"{source}: the goal at {Grid(rows).place_name(goals[0])} cannot be reached from "
                f"the start at {Grid(rows).place_name(start)}"
            )
        return cls(rows, codes, start, distances)


def distances_to(targets: Iterable[int], free: Bools) -> NDArray[np.int32]:
    """Moves from each cell to the nearest target over free cells, by breadth-first search.

    Targets need not be free. -1 where no way leads to one; the shape is that of ``free``.
    """
    n_rows, n_columns = free.shape
    # A border all around saves the search from asking whether it left the map. Plain Python on
    # bytes takes a third of a second for a million cells, without a library to import.
    width = n_columns + 2
    unvisited = bytearray(np.pad(free, 1).tobytes())
    distances = array("i", [UNREACHED]) * len(unvisited)
    frontier = [(cell // n_columns + 1) * width + cell % n_columns + 1 for cell in targets]
    n_moves = 0
    while frontier:
        reached = []
        for cell in frontier:
            unvisited[cell] = False
            distances[cell] = n_moves
        for cell in frontier:
            for beside in (cell - width, cell + width, cell - 1, cell + 1):
                if unvisited[beside]:
                    unvisited[beside] = False
                    reached.append(beside)
        frontier = reached
        n_moves += 1
    padded = np.frombuffer(distances, np.int32).reshape(n_rows + 2, width)
    return padded[1:-1, 1:-1].copy()


def read_rows(desc: Description) -> tuple[str, ...]:
    """The rows of a map, not checked yet; see `GridMap.read`."""
    if _is_path(desc):
        try:
            text = content_of(Path(desc), MAX_MAP_BYTES).decode("utf-8-sig")
        except (OSError, UnsafeFileError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise ValueError(f"desc: cannot read the map file {desc}: {reason}") from error
    elif isinstance(desc, str):
        text = desc
    elif isinstance(desc, Sequence) and all(isinstance(row, str) for row in desc):
        return tuple(desc)
    else:
        raise ValueError(
            f"desc must be a list of rows, such as ['S.', '#G'], or the path to a text file, not "
            f"{desc!r}"
        )
    return tuple(row.rstrip() for row in text.strip("\r\n").splitlines())


def _is_path(desc: Description) -> TypeGuard[str | os.PathLike[str]]:
    return isinstance(desc, os.PathLike) or (isinstance(desc, str) and "\n" not in desc)


MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))
# For each action the way it is meant to go, then the two ways it may slip.
POSSIBLE_MOVES = ((0, 2, 3), (1, 2, 3), (2, 0, 1), (3, 0, 1))


@dataclass(frozen=True)
class Tile:
    """The effect of trying to move onto a cell.

    Attributes:
        reward: what the move earns.
        blocked: the robot stays where it was.
        terminated: the episode ends.
        bonus: what is added the first time in an episode, None where there is nothing to collect.
    """

    reward: float
    blocked: bool = False
    terminated: bool = False
    bonus: float | None = None


class Move(NamedTuple):
    """The outcome of one move."""

    next_state: int
    reward: float
    terminated: bool
    bumped: bool


class GridDynamics:
    """The dynamics of a robot on a map, for a single step and for all states at once.

    A state is a cell plus the number of cells times a bit mask: bit i is set when the i-th
    collectable cell, row by row, has been visited in this episode. Without collectable cells
    the states are the cells. A state in which no move can be made, because the episode has ended
    there or no robot can be there, leads to itself and terminates, as in Gymnasium's toy_text.

    Args:
        grid_map: the map.
        tiles: what each letter of the map means.
        edge: the effect of trying to leave the map.
        slip: probability that a move goes sideways, half of it to each side.

    Raises:
        ValueError: if there are more than 2**24 states.
    """

    def __init__(
        self, grid_map: GridMap, tiles: Mapping[str, Tile], edge: Tile, slip: float
    ) -> None:
        self.n_rows, self.n_columns = grid_map.n_rows, grid_map.n_columns
        self.n_cells = grid_map.n_cells
        self.codes = grid_map.codes
        self.tiles = {ord(letter): tile for letter, tile in tiles.items()}
        self.edge = edge
        collectable = {code for code, tile in self.tiles.items() if tile.bonus is not None}
        cells = [cell for cell, code in enumerate(self.codes) if code in collectable]
        # Shifted no further than needed: a map can hold a million such cells.
        if self.n_cells << min(len(cells), 64) > MAX_STATES:
            raise ValueError(
                f"the map has {self.n_cells} cells, {len(cells)} of them to collect: these make "
                f"{self.n_cells} * 2**{len(cells)} states, more than {MAX_STATES:,}"
            )
        self.collectable_bits = {cell: 1 << i for i, cell in enumerate(cells)}
        self.n_states = self.n_cells << len(cells)
        self.outcome_prob = (1.0,) if slip == 0 else (1 - slip, slip / 2, slip / 2)

    def move(self, state: int, direction: int) -> Move:
        """Try to move one cell in a direction."""
        collected, cell = divmod(state, self.n_cells)
        here = self.tiles[self.codes[cell]]
        if here.blocked or here.terminated:
            return Move(state, 0.0, terminated=True, bumped=False)
        row, column = divmod(cell, self.n_columns)
        row += MOVES[direction][0]
        column += MOVES[direction][1]
        if not (0 <= row < self.n_rows and 0 <= column < self.n_columns):
            return Move(state, self.edge.reward, self.edge.terminated, bumped=True)
        target = row * self.n_columns + column
        tile = self.tiles[self.codes[target]]
        if tile.blocked:
            return Move(state, tile.reward, tile.terminated, bumped=True)
        reward = tile.reward
        if tile.bonus is not None and not collected & self.collectable_bits[target]:
            reward += tile.bonus
            collected |= self.collectable_bits[target]
        return Move(target + self.n_cells * collected, reward, tile.terminated, bumped=False)

    def transition_model(self, initial: Floats) -> TransitionModel:
        """The model as arrays, with the probabilities ``initial`` of starts, shape (S,).

        There is one outcome, or three where moves may slip: as meant, then to the two sides.
        """
        chosen = np.array(POSSIBLE_MOVES)[:, : len(self.outcome_prob)]
        next_state, reward, terminated = self._all_moves()
        return TransitionModel(
            prob=np.broadcast_to(self.outcome_prob, (self.n_states, *chosen.shape)),
            next_state=next_state[:, chosen],
            reward=reward[:, chosen],
            terminated=terminated[:, chosen],
            initial=initial,
        )

    def action_masks(self) -> Bools:
        """The moves that neither a wall nor the edge stops, all if none, bool of shape (S, 4)."""
        entered, _ = self._entered()
        free = ~self._per_code("blocked", np.bool_)[entered]
        free |= self._over()[:, None]
        free |= ~free.any(axis=1, keepdims=True)
        return np.tile(free, (self.n_states // self.n_cells, 1))

    def _all_moves(self) -> tuple[Ints, Floats, Bools]:
        """`move` for all states and directions: next states, rewards, ends; each (S, 4)."""
        entered, target = self._entered()
        stays = self._per_code("blocked", np.bool_)[entered]
        cells = np.arange(self.n_cells)[:, None]
        destination = np.where(stays, cells, target)

        bits = np.zeros(self.n_cells, np.int64)
        bits[list(self.collectable_bits)] = list(self.collectable_bits.values())
        found = np.where(stays, 0, bits[destination])
        collected = np.arange(self.n_states // self.n_cells)[:, None, None]
        bonus = np.where(found & ~collected, self._per_code("bonus", np.float64)[entered], 0.0)

        next_state = destination + self.n_cells * (collected | found)
        reward = self._per_code("reward", np.float64)[entered] + bonus
        ends = self._per_code("terminated", np.bool_)[entered]
        terminated = np.broadcast_to(ends, next_state.shape).copy()

        over = self._over()
        states = np.arange(self.n_states).reshape(-1, self.n_cells)
        next_state[:, over] = states[:, over, None]
        reward[:, over] = 0.0
        terminated[:, over] = True
        shape = (self.n_states, len(MOVES))
        return next_state.reshape(shape), reward.reshape(shape), terminated.reshape(shape)

    def _entered(self) -> tuple[NDArray[np.uint8], Ints]:
        """The code of what each move meets, and the cell it aims at; each (cells, 4)."""
        rows, columns = np.divmod(np.arange(self.n_cells)[:, None], self.n_columns)
        steps = np.array(MOVES)
        rows, columns = rows + steps[:, 0], columns + steps[:, 1]
        inside = (rows >= 0) & (rows < self.n_rows) & (columns >= 0) & (columns < self.n_columns)
        target = np.where(inside, rows * self.n_columns + columns, 0)
        codes = np.frombuffer(self.codes, np.uint8)
        # The edge takes the place of a letter: code 0, which no map holds.
        return np.where(inside, codes[target], 0).astype(np.uint8), target

    def _over(self) -> Bools:
        """The cells from which no move can be made, shape (cells,)."""
        over = self._per_code("blocked", np.bool_) | self._per_code("terminated", np.bool_)
        found: Bools = over[np.frombuffer(self.codes, np.uint8)]
        return found

    def _per_code(self, name: str, dtype: type[Any]) -> NDArray[Any]:
        """An attribute of the tiles as a table of ASCII codes, the edge's at 0, None as zero."""
        table = np.zeros(128, dtype)
        for code, tile in {0: self.edge, **self.tiles}.items():
            table[code] = getattr(tile, name) or 0
        return table


# Longer chains are drawn in several rows, read as lines of text are.
LONGEST_ROW = 50


def in_rows(letters: str) -> tuple[str, ...]:
    """A chain of letters as a map, in rows of equal length."""
    length = min(len(letters), LONGEST_ROW)
    starts = range(0, len(letters), length)
    return tuple(letters[start : start + length].ljust(length, "#") for start in starts)


class MapEnv(FiniteEnv):
    """An environment whose states are shown on a map, ``rows``, with letters of `envs.drawing`."""

    rows: tuple[str, ...]
    action_names: ClassVar[tuple[str, ...]]

    def cell_of(self, state: int) -> int:
        """The cell of a state, counted row by row: by default states are cells."""
        return state

    def _picture(self) -> Scene:
        name = "start" if self.last_action is None else self.action_names[self.last_action]
        return Scene(self.rows, self.cell_of(self.s), title=name)

    def _make_renderer(self, fps: int, title: str) -> GridRenderer:
        return GridRenderer(self.rows, fps, title)


class GridWorld(MapEnv, MaskedFiniteEnv):
    """A robot on a map of letters, moving up, down, left or right; the base of all grid worlds.

    A subclass defines its letters in `tiles`; cells that neither block nor terminate can be walked
    on.

    Args:
        desc: the map: its rows, or the path to a text file. Exactly one ``S``, at least one ``G``.
        tiles: what each letter means.
        edge: the effect of trying to leave the map.
        slip: probability that a move goes sideways, half of it to each side.
        random_start: start each episode on any cell that can be walked on, holds nothing to
            collect, and has a way to the goal, with equal probability, instead of on ``S``.
        render_mode: ``"ansi"``, ``"rgb_array"``, ``"human"`` or None.

    Raises:
        ValueError: if an argument is out of range or the map malformed; see `GridMap.read`.
    """

    action_names: ClassVar[tuple[str, ...]] = ("up", "down", "left", "right")
    is_stationary = True  # whether the dynamics do not change over time: the model always holds

    def __init__(
        self,
        desc: Description,
        tiles: Mapping[str, Tile],
        edge: Tile,
        *,
        slip: float,
        random_start: bool,
        render_mode: str | None,
    ) -> None:
        slip = check_number("slip", slip, 0, 1)
        self.random_start = check_flag("random_start", random_start)
        self._set_map(desc, tiles, edge, slip)
        super().__init__(self.dynamics.n_states, len(MOVES), render_mode)
        self._slip_thresholds = np.cumsum(self.dynamics.outcome_prob).tolist()
        self.s = self.map.start
        self._bumped = False  # in the latest step
        self._steps: set[tuple[int, int]] = set()  # those of the episode, where it is rendered

    def _set_map(
        self, desc: Description, tiles: Mapping[str, Tile], edge: Tile, slip: float
    ) -> None:
        closed = {letter for letter, tile in tiles.items() if tile.blocked or tile.terminated}
        self.map = GridMap.read(desc, tiles, tiles.keys() - closed)
        self.rows = self.map.rows
        self.dynamics = GridDynamics(self.map, tiles, edge, slip)

    def _draw_start(self) -> int:
        starts, thresholds = self._starts
        self._steps, self._bumped = set(), False
        drawn = np.searchsorted(thresholds, self.np_random.random(), side="right")
        return int(starts[drawn])

    def _draw(self, action: int) -> tuple[int, float, bool]:
        outcome = first_above(self._slip_thresholds, self.np_random.random())
        state, reward, terminated, self._bumped = self.dynamics.move(
            self.s, POSSIBLE_MOVES[action][outcome]
        )
        if self.render_mode is not None:
            step = self.cell_of(self.s), self.cell_of(state)
            self._steps |= {step} if step[0] != step[1] else set()
        return state, reward, terminated

    def action_masks(self) -> Bools:
        """Which moves neither a wall nor the edge stops, bool of shape (4,).

        Where moves may slip, only the intended move counts. All moves are allowed in a cell that is
        walled in, and where an episode has ended. The convention is that of sb3-contrib's agents.
        """
        free = [not self.dynamics.move(self.s, way).bumped for way in range(len(MOVES))]
        return np.array(free) | (not any(free))

    def masks_of_states(self) -> Bools:
        """`action_masks` in each state, bool of shape (S, 4)."""
        return self.dynamics.action_masks()

    def cell_of(self, state: int) -> int:
        """The cell of a state."""
        return state % self.dynamics.n_cells

    def transition_model(self) -> TransitionModel:
        """The exact dynamics as arrays; its states are numbered as `s`, whatever is observed."""
        return self.dynamics.transition_model(self.initial_state_distrib)

    @cached_property
    def initial_state_distrib(self) -> Floats:
        """Probabilities of the starting states, shape (S,)."""
        distribution, starts = np.zeros(self.dynamics.n_states), self._starts[0]
        distribution[starts] = summing_to_one(np.full(len(starts), 1 / len(starts)))
        return distribution

    @property
    def shortest_path_length(self) -> int:
        """Moves from ``S`` to the nearest goal if none slips."""
        return int(self.map.distances[self.map.start])

    @cached_property
    def _starts(self) -> tuple[Ints, Floats]:
        """The cells where an episode may begin, in order, and their cumulative probabilities."""
        if self.random_start:
            starts = np.flatnonzero(self.map.distances > 0)
            starts = starts[~np.isin(starts, list(self.dynamics.collectable_bits))]
        else:
            starts = np.array([self.map.start])
        return starts, np.cumsum(summing_to_one(np.full(len(starts), 1 / len(starts))))

    def _info(self) -> dict[str, Any]:
        cell = self.cell_of(self.s)
        return {
            "position": divmod(cell, self.map.n_columns),
            "bumped": self._bumped,
            # On every step, so that an episode cut off by a time limit counts as a failure.
            "is_success": self.map.codes[cell] == ord(GOAL),
        }

    def _picture(self) -> Scene:
        layer = self.s // self.map.n_cells
        collected = [c for c, bit in self.dynamics.collectable_bits.items() if bit & layer]
        scene = super()._picture()
        return replace(scene, steps=self._steps, collected=collected, last_move=self.last_action)
