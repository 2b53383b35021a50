"""The map of a grid world, and the cells of its states: all that a drawing needs.

Layouts have these letters, whatever those of the environment's own map: ``.`` free, ``S`` start,
``#`` wall, ``G`` goal, ``X`` trap, ``P`` prize.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.toy_text.blackjack import BlackjackEnv
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.envs.toy_text.taxi import TaxiEnv

from rl_yardstick.envs.grid import MOVES, Grid, GridWorld, Tile
from rl_yardstick.envs.known_models import core_of, observations_of_states
from rl_yardstick.envs.textbook.grids import WindyGridworldEnv
from rl_yardstick.mdp.transition_model import Ints

FREE, START, WALL, GOAL, TRAP, PRIZE = ".S#GXP"

UP, DOWN, LEFT, RIGHT = MOVES
_NAMES = {UP: "up", DOWN: "down", LEFT: "left", RIGHT: "right"}
WORDS = {"#": "shelf", "M": "mine", "P": "power"}


@dataclass(frozen=True)
class GridLayout(Grid):
    """The map of a grid world, and how its states are numbered.

    State ``cell + n_cells * layer`` is the robot on a cell, cells counted row by row from the top
    left, where bit i of the layer says that the i-th prize has been collected. Without prizes
    there is one layer, 0, and states are cells.
    """

    moves: tuple[tuple[int, int], ...]  # rows down, columns to the right: what each action tries
    names: Mapping[str, str]  # what this environment calls its walls, traps and prizes
    prizes: tuple[int, ...] = ()  # their cells

    @property
    def n_layers(self) -> int:
        """The number of subsets of prizes that may have been collected."""
        return 1 << len(self.prizes)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return self.n_cells * self.n_layers

    @property
    def cells(self) -> Ints:
        """The cell of each state, shape (S,)."""
        return np.arange(self.n_states) % self.n_cells

    @property
    def layers(self) -> Ints:
        """The layer of each state, shape (S,)."""
        return np.arange(self.n_states) // self.n_cells

    def rows_in(self, layer: int) -> tuple[str, ...]:
        """The map without the prizes that are collected in a layer."""
        collected = self.collected_in(layer)
        return tuple(
            "".join(
                FREE if row * self.n_columns + column in collected else letter
                for column, letter in enumerate(letters)
            )
            for row, letters in enumerate(self.rows)
        )

    def collected_in(self, layer: int) -> tuple[int, ...]:
        """The cells of the prizes that are collected in a layer."""
        return tuple(cell for bit, cell in enumerate(self.prizes) if layer >> bit & 1)


def grid_layout(env: gym.Env[Any, Any]) -> GridLayout | None:
    """The layout for the states of `envs.known_models.transition_model`, None where there is none.

    Grid worlds of this project, WindyGridworld, FrozenLake and CliffWalking have one.
    """
    base = env.unwrapped
    if isinstance(base, GridWorld):
        tiles = {chr(code): tile for code, tile in base.dynamics.tiles.items()}
        letters = {letter: _letter(letter, tile) for letter, tile in tiles.items()}
        return GridLayout(
            rows=tuple("".join(letters[letter] for letter in row) for row in base.map.rows),
            moves=MOVES,
            names={letters[letter]: word for letter, word in WORDS.items() if letter in letters},
            prizes=tuple(base.dynamics.collectable_bits),
        )
    if isinstance(base, WindyGridworldEnv):
        return GridLayout(base.rows, base.steps, {})
    if isinstance(base, FrozenLakeEnv):
        ours = str.maketrans("FH", FREE + TRAP)
        rows = tuple("".join(row).translate(ours) for row in np.array(base.desc).astype(str))
        return GridLayout(rows, (LEFT, DOWN, RIGHT, UP), {TRAP: "hole"})
    if isinstance(base, CliffWalkingEnv):
        cells = np.where(base._cliff, TRAP, FREE)
        cells.flat[base.start_state_index], cells.flat[-1] = START, GOAL
        rows = tuple("".join(row) for row in cells)
        return GridLayout(rows, (UP, RIGHT, DOWN, LEFT), {TRAP: "cliff"})
    return None


def _letter(own: str, tile: Tile) -> str:
    if own in {START, GOAL}:
        return own
    if tile.blocked:
        return WALL
    if tile.terminated:
        return TRAP
    return FREE if tile.bonus is None else PRIZE


def action_names(env: gym.Env[Any, Any]) -> tuple[str, ...]:
    """The names of an environment's actions; empty where it has none."""
    given = getattr(env.unwrapped, "action_names", None)
    if isinstance(given, tuple | list):
        return tuple(map(str, given))
    if isinstance(env.unwrapped, TaxiEnv):
        return ("south", "north", "east", "west", "pick up", "drop off")
    if isinstance(env.unwrapped, BlackjackEnv):
        return ("stick", "hit")
    layout = grid_layout(env)
    return () if layout is None else tuple(_NAMES.get(move, str(move)) for move in layout.moves)


def state_name(env: gym.Env[Any, Any], layout: GridLayout | None, state: int) -> str:
    """The name of a state of `envs.known_models.transition_model`: its place, where it has one."""
    base = env.unwrapped
    if layout is not None:
        name = layout.place_name(state % layout.n_cells)
        collected = layout.collected_in(state // layout.n_cells)
        return f"{name}, {len(collected)} collected" if collected else name
    if isinstance(base, TaxiEnv) and not base.fickle_passenger:
        row, column, passenger, target = base.decode(state)
        where = "on board" if passenger == 4 else f"at {'RGYB'[passenger]}"
        return f"row {row + 1}, column {column + 1}, passenger {where}, to {'RGYB'[target]}"
    observations = observations_of_states(core_of(env)[0])
    if observations is None or np.array_equal(observations, range(len(observations))):
        return f"state {state}"
    seen = observations[state]
    told = str(tuple(seen.tolist()) if seen.ndim == 1 and seen.dtype.kind in "iu" else seen)
    return f"state {state}, seen as {textwrap.shorten(told, 40, placeholder=' ...')}"
