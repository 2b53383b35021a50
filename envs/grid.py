"""What every grid world shares: its arguments, stepping, the exact model, and rendering."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.argument_checks import check_flag, check_number
from envs.finite_env import Outcome, as_dictionaries, summing_to_one
from envs.grid_dynamics import MOVES, POSSIBLE_MOVES, GridDynamics, Tile
from envs.grid_map import GOAL, Description, GridMap
from envs.rendering import GridRenderer
from envs.scene import Scene
from envs.shown_env import ShownEnv
from envs.text_rendering import render_text
from mdp.array_types import AnyInts, Bools, Floats, Ints

if TYPE_CHECKING:
    from mdp.transition_model import TransitionModel

Observation = int | NDArray[np.float32]


class GridWorld(ShownEnv):
    """A robot on a map of letters, moving up, down, left or right; the base of all grid worlds.

    A subclass says in `tiles` what its letters mean; cells that neither block nor terminate can
    be walked on. What it must hold to, so that the arrays of `transition_model` replay an episode
    exactly: `reset` and `step` draw one uniform number each, even where nothing is random, and
    choose by cumulative sum in the order of `initial_state_distrib` and `P`.

    Args:
        desc: the map: its rows, or the path to a text file. Exactly one ``S``, at least one ``G``.
        tiles: what each letter means.
        edge: what meets a robot that tries to leave the map.
        slip: probability that a move goes sideways, half of it to each side.
        random_start: start each episode on any cell that can be walked on, holds nothing to
            collect, and has a way to the goal, with equal probability, instead of on ``S``.
        render_mode: ``"ansi"``, ``"rgb_array"``, ``"human"`` or None.

    Attributes:
        s: the state, an index; may be set to continue from another one.

    Raises:
        ValueError: if an argument is out of range or the map malformed; see `GridMap.read`.
    """

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
        super().__init__(render_mode)
        passable = [
            letter for letter, tile in tiles.items() if not (tile.blocked or tile.terminated)
        ]
        self.map = GridMap.read(desc, tiles, passable)
        self.dynamics = GridDynamics(self.map, tiles, edge, slip)
        self.observation_space = spaces.Discrete(self.dynamics.n_states)
        self.action_space = spaces.Discrete(len(MOVES))
        self._slip_thresholds = np.cumsum(self.dynamics.outcome_prob).tolist()
        self.s = self.map.start
        self._steps: set[tuple[int, int]] = set()
        self._last_action: int | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; ``options`` are not used."""
        super().reset(seed=seed)
        starts, thresholds = self._starts
        drawn = np.searchsorted(thresholds, self.np_random.random(), side="right")
        self.s = int(starts[drawn])
        self._steps = set()
        self._last_action = None
        if self.render_mode == "human":
            self.render()
        return self._observe(), self._info(bumped=False)

    def step(self, action: int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Try to move one cell; see the class for the meaning of what is returned.

        Raises:
            ValueError: if the action is not one of 0, 1, 2, 3.
        """
        action = int(action)
        if not 0 <= action < len(MOVES):
            raise ValueError(f"action {action} does not exist: 0 up, 1 down, 2 left, 3 right")
        uniform = self.np_random.random()
        # As categorical_sample of toy_text: the first, where rounding leaves none.
        outcome = next((k for k, upto in enumerate(self._slip_thresholds) if upto > uniform), 0)
        move = self.dynamics.move(self.s, POSSIBLE_MOVES[action][outcome])
        if self.render_mode is not None:
            self._note_step(action, move.next_state)
        self.s = move.next_state
        if self.render_mode == "human":
            self.render()
        return self._observe(), move.reward, move.terminated, False, self._info(move.bumped)

    def action_masks(self) -> Bools:
        """Which moves neither a wall nor the edge stops, bool of shape (4,).

        Where moves may slip, the one that is meant counts: slipping to the side is not ruled out.
        Never none: all may be tried in a cell that is walled in, and where an episode has ended.
        The convention is that of sb3-contrib's agents.
        """
        return self.dynamics.action_mask(self.s)

    def observation_of(self, states: AnyInts) -> NDArray[Any]:
        """What is observed in each of many states: here the states themselves.

        Args:
            states: indices of states, shape (n,).

        Returns:
            The observations, the first axis counting the states.
        """
        return states

    def transition_model(self) -> TransitionModel:
        """The exact dynamics as arrays; its states are numbered as `s`, whatever is observed."""
        return self.dynamics.transition_model(self.initial_state_distrib)

    @cached_property
    def initial_state_distrib(self) -> Floats:
        """Probabilities of the starting states, shape (S,)."""
        starts, thresholds = self._starts
        distribution = np.zeros(self.dynamics.n_states)
        distribution[starts] = _equal(len(thresholds))
        return distribution

    @cached_property
    def P(self) -> dict[int, dict[int, list[Outcome]]]:  # noqa: N802 (the name toy_text gave it)
        """The dynamics as Gymnasium's toy_text environments hold them.

        ``P[state][action]`` is a list of (probability, next state, reward, terminated). Built when
        first asked for, from `transition_model`, whose arrays take a tenth of the memory.
        """
        return as_dictionaries(self.transition_model())

    @property
    def is_stationary(self) -> bool:
        """Whether the dynamics stay as they are, so that their model holds at any time."""
        return True

    @property
    def desc(self) -> NDArray[np.bytes_]:
        """The map as FrozenLake holds it, single letters of shape (rows, columns)."""
        return np.frombuffer(self.map.codes, "S1").reshape(self.map.n_rows, self.map.n_columns)

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
        return starts, np.cumsum(_equal(len(starts)))

    def _observe(self) -> Observation:
        return self.s

    def _info(self, bumped: bool) -> dict[str, Any]:
        cell = self.s % self.map.n_cells
        return {
            "position": divmod(cell, self.map.n_columns),
            "bumped": bumped,
            # On every step, so that an episode cut off by a time limit counts as a failure.
            "is_success": self.map.codes[cell] == ord(GOAL),
        }

    def _note_step(self, action: int, next_state: int) -> None:
        """Remember for the next picture what was done."""
        origin, target = self.s % self.map.n_cells, next_state % self.map.n_cells
        if origin != target:
            self._steps.add((origin, target))
        self._last_action = action

    def _text(self) -> str:
        return render_text(self._picture())

    def _make_renderer(self, fps: int, title: str) -> GridRenderer:
        return GridRenderer(self.map.rows, fps, title)

    def _picture(self) -> Scene:
        collected, cell = divmod(self.s, self.map.n_cells)
        return Scene(
            rows=self.map.rows,
            robot=cell,
            steps=self._steps,
            collected=[c for c, bit in self.dynamics.collectable_bits.items() if bit & collected],
            last_action=self._last_action,
        )


def _equal(n: int) -> Floats:
    """Equal probabilities."""
    return summing_to_one(np.full(n, 1 / n))
