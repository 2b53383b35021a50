"""What happens on a grid when a robot moves: one rule, for a single step and for all at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.grid_map import MAX_STATES, GridMap
from mdp.array_types import Bools, Floats, Ints

if TYPE_CHECKING:
    from mdp.transition_model import TransitionModel

MOVE_NAMES = ("up", "down", "left", "right")
MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))
# For each action the way it is meant to go, then the two ways it may slip.
POSSIBLE_MOVES = ((0, 2, 3), (1, 2, 3), (2, 0, 1), (3, 0, 1))


@dataclass(frozen=True)
class Tile:
    """What a robot meets that tries to move onto a cell.

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
    """The rules of a grid world: a map, and what each of its letters means.

    A state is a cell plus the number of cells times a bit mask: bit i is set when the i-th
    collectable cell, row by row, has been visited in this episode. Without collectable cells
    the states are the cells. A state in which no move can be made, because the episode has ended
    there or no robot can be there, leads to itself and terminates, as in Gymnasium's toy_text.

    Args:
        grid_map: the map.
        tiles: what each letter of the map means.
        edge: what a robot meets that tries to leave the map.
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
        """Every move of every state as arrays.

        Args:
            initial: probabilities of the starting states, shape (S,).

        Returns:
            A model with 4 actions and one outcome, or three where moves may slip: as meant, then
            to the two sides. Equal outcomes stay apart.
        """
        from mdp.transition_model import TransitionModel

        chosen = np.array(POSSIBLE_MOVES)[:, : len(self.outcome_prob)]
        next_state, reward, terminated = self._all_moves()
        return TransitionModel(
            prob=np.broadcast_to(self.outcome_prob, (self.n_states, *chosen.shape)),
            next_state=next_state[:, chosen],
            reward=reward[:, chosen],
            terminated=terminated[:, chosen],
            initial=initial,
        )

    def action_mask(self, state: int) -> Bools:
        """The moves that neither a wall nor the edge stops, bool of shape (4,), never none."""
        free = [not self.move(state, direction).bumped for direction in range(len(MOVES))]
        return np.array(free) | (not any(free))

    def action_masks(self) -> Bools:
        """`action_mask` of all states, bool of shape (S, 4)."""
        codes = np.frombuffer(self.codes, np.uint8)
        blocked = self._per_code("blocked", np.bool_)
        entered, _ = self._entered()
        free = ~blocked[entered]
        free |= (blocked | self._per_code("terminated", np.bool_))[codes][:, None]
        free |= ~free.any(axis=1, keepdims=True)
        return np.tile(free, (self.n_states // self.n_cells, 1))

    def _all_moves(self) -> tuple[Ints, Floats, Bools]:
        """`move` for all states and directions: next states, rewards, ends; each (S, 4)."""
        codes = np.frombuffer(self.codes, np.uint8)
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
        terminated = np.broadcast_to(
            self._per_code("terminated", np.bool_)[entered], next_state.shape
        ).copy()

        over = (self._per_code("blocked", np.bool_) | self._per_code("terminated", np.bool_))[codes]
        states = np.arange(self.n_states).reshape(-1, self.n_cells)
        next_state[:, over] = states[:, over, None]
        reward[:, over] = 0.0
        terminated[:, over] = True
        shape = (self.n_states, len(MOVES))
        return next_state.reshape(shape), reward.reshape(shape), terminated.reshape(shape)

    def _entered(self) -> tuple[NDArray[np.uint8], Ints]:
        """The code of what each move meets, and the cell it aims at; each (cells, 4)."""
        codes = np.frombuffer(self.codes, np.uint8)
        target, inside = self._targets()
        # The edge takes the place of a letter: code 0, which no map holds.
        return np.where(inside, codes[target], 0).astype(np.uint8), target

    def _targets(self) -> tuple[Ints, Bools]:
        """The cell each move aims at, and whether it lies on the map; each (cells, 4)."""
        rows, columns = np.divmod(np.arange(self.n_cells)[:, None], self.n_columns)
        steps = np.array(MOVES)
        rows, columns = rows + steps[:, 0], columns + steps[:, 1]
        inside = (rows >= 0) & (rows < self.n_rows) & (columns >= 0) & (columns < self.n_columns)
        return np.where(inside, rows * self.n_columns + columns, 0), inside

    def _per_code(self, name: str, dtype: type[Any]) -> NDArray[Any]:
        """An attribute of the tiles as a table of ASCII codes, the edge's at 0, None as zero."""
        table = np.zeros(128, dtype)
        for code, tile in {0: self.edge, **self.tiles}.items():
            table[code] = getattr(tile, name) or 0
        return table
