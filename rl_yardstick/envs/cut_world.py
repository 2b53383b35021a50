"""The model of an environment whose observations are cut into bins.

From many points of each bin the environment makes one step for each action. The *cut world* has all
of these steps, with equal probabilities: a state is a bin, and each step begins at a random point
of it, wherever the step before ended. Its figures are not those of the environment.
"""

from __future__ import annotations

import copy
from array import array
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rl_yardstick.envs.known_models import TRANSPARENT_WRAPPERS, folds, layers
from rl_yardstick.envs.wrappers import DiscretizeObservation
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

Env = gym.Env[Any, Any]
State = tuple[float, ...]
Step = tuple[int, float, bool]  # the bin reached, the reward, whether the episode terminates

MOST_BINS = 500_000
MOST_POINTS, MOST_IN_BIN = 200_000, 20  # in all (but one in each bin), and in each bin
ARCS = 3  # of a circle, for each bin of the cosine or sine of an angle
N_RESETS, N_TRIED = 10_000, 200  # starts, and steps that are repeated from their states


@dataclass(frozen=True, eq=False)
class CutWorld:
    """The model of the bins, and the number of points that it was made from."""

    model: TransitionModel
    n_points: int


def cut_world(env: Env) -> CutWorld | None:
    """The model of an environment in `DiscretizeObservation`; None if it is in none.

    Its attribute ``state`` has to be its whole state, which determines each step. Observations are
    this state; or the first numbers of the state are angles, and observations begin with the cosine
    and sine of each, as in Gymnasium's Acrobot and Pendulum. The given environment does not change.

    Raises:
        ValueError: if the environment is not of this kind, in one line that says why.
    """
    cuts = [layer for layer in layers(env)[1] if isinstance(layer, DiscretizeObservation)]
    acts = isinstance(env.action_space, gym.spaces.Discrete)
    if not (acts and cuts and env.observation_space == cuts[0].observation_space):
        return None
    return _Stepper(env).world()


class _Stepper:
    """A copy of an environment, for steps from any state."""

    def __init__(self, env: Any) -> None:
        copies = dict[int, Any]()  # without wrappers that record, limit or check
        try:
            for wrapper in layers(env)[1]:
                kind = type(wrapper)
                if f"{kind.__module__}.{kind.__qualname__}" in TRANSPARENT_WRAPPERS:
                    copies[id(wrapper)] = copy.deepcopy(wrapper.env, copies)
            self.env = copy.deepcopy(env, copies)
        except TypeError as error:
            raise ValueError(f"the environment cannot be copied: {error}") from error
        self.base = self.env.unwrapped
        wrappers = layers(self.env)[1]
        unknown = [w for w in wrappers if not (folds(w) or isinstance(w, gym.ActionWrapper))]
        self.cut = next(w for w in wrappers if isinstance(w, DiscretizeObservation))
        seen: Any = self.cut.env.observation_space
        self.n_bins, self.n_actions = int(env.observation_space.n), int(env.action_space.n)
        if unknown:
            raise ValueError(f"the effect of {type(unknown[0]).__name__} on steps is not known")
        if self.n_bins > MOST_BINS:
            raise ValueError(f"{self.n_bins:,} bins are more than {MOST_BINS:,}")
        self.env.reset(seed=0)
        self.is_over = False  # where the next step needs a reset
        try:
            self.shape = np.shape(self.base.state)
            self.n_angles = seen.shape[0] - len(self.state())
        except (AttributeError, TypeError, ValueError):
            raise ValueError("it has no attribute state of numbers") from None
        if not self._follows_from_state():
            raise ValueError("its steps or observations depend on more than its attribute state")

    def state(self) -> State:
        """The present state."""
        return tuple(np.ravel(self.base.state).astype(np.float64).tolist())

    def start(self) -> State:
        """Begin an episode; its first state."""
        self.env.reset()
        self.is_over = False
        return self.state()

    def step(self, action: int, state: State | None = None) -> Step:
        """One step from a state, or from the present one."""
        if self.is_over:
            self.start()
        if state is not None:
            # Gymnasium's own classes compute faster with Python's numbers.
            is_quick = type(self.base).__module__.startswith("gymnasium.")
            self.base.state = state if is_quick else np.reshape(state, self.shape)
        reached, reward, terminated, truncated, _ = self.env.step(action)
        self.is_over = terminated or truncated
        return int(reached), float(reward), bool(terminated)

    def _follows_from_state(self) -> bool:
        """Whether steps of episodes, repeated in another order from their states, are the same."""
        actions = np.random.default_rng(0).integers(self.n_actions, size=N_TRIED).tolist()
        played = []
        for action in actions:
            before = self.start() if self.is_over else self.state()
            played.append((before, action, self.step(action), self.state()))
        if not 0 <= self.n_angles <= len(played[0][0]):
            return False
        reached = self.bins_of(np.array([after for *_, after in played])).tolist()
        same = reached == [found[0] for *_, found, _ in played]
        for before, action, (place, reward, ends), after in reversed(played):
            again = self.step(action, before)
            close = np.allclose((again[1], *self.state()), (reward, *after), rtol=1e-6, atol=1e-9)
            same = same and bool(close) and (again[0], again[2]) == (place, ends)
        return bool(same)

    def bins_of(self, states: Floats) -> Ints:
        """The bins of states of shape (n, numbers), shape (n,)."""
        angles, others = np.split(states, [self.n_angles], axis=1)
        circles = np.stack((np.cos(angles), np.sin(angles)), axis=2).reshape(len(states), -1)
        return self.cut.map_observations(np.hstack((circles, others)).astype(np.float32))

    def world(self) -> CutWorld:
        """Step from all points."""
        starts = np.array([self.start() for _ in range(N_RESETS)])
        initial = np.bincount(self.bins_of(starts), minlength=self.n_bins) / N_RESETS
        points, n_points, steps = self._points(starts), 0, array("d")
        has_points = np.zeros(self.n_bins, dtype=np.bool_)
        while len(points):
            n_points += len(points)
            bins, further = self.bins_of(points), []
            has_points[bins] = True
            for point, place in zip(map(tuple, points.tolist()), bins.tolist(), strict=True):
                for action in range(self.n_actions):
                    reached, reward, ends = self.step(action, point)
                    steps.extend((place * self.n_actions + action, reached, reward, ends))
                    # Of angles, some bins are so small that they have no point yet.
                    if not (ends or has_points[reached]):
                        further.append(self.state())
            points = np.array(further)
        return CutWorld(mean_model(np.reshape(steps, (-1, 4)), initial, self.n_actions), n_points)

    def _points(self, starts: Floats) -> Floats:
        """Points of all bins, spread evenly, shape (n, numbers); starts where nothing is cut."""
        from scipy.stats.qmc import Halton

        cut, axes = self.cut, dict[int, tuple[float, float, float]]()  # by place in the state
        for dim, n, low, high in zip(cut.dims, cut.bins, cut.low, cut.high, strict=True):
            is_of_angle = dim < 2 * self.n_angles
            place = dim // 2 if is_of_angle else dim - self.n_angles
            n_arcs = max(ARCS * n, axes.get(place, (0,))[0])
            axes[place] = (n_arcs, -np.pi, np.pi) if is_of_angle else (n, low, high)
        counts, lows, highs = np.array(list(axes.values())).T
        n_cells = int(counts.prod())
        n_each = min(max(MOST_POINTS // n_cells, 1), MOST_IN_BIN)
        cells = np.repeat(np.arange(n_cells), n_each)
        corners = np.stack(np.unravel_index(cells, counts.astype(np.int64)), axis=1)
        inside = Halton(len(counts), scramble=False).random(len(cells))
        points = starts[np.arange(len(cells)) % len(starts)]
        points[:, list(axes)] = lows + (corners + inside) / counts * (highs - lows)
        return points


def mean_model(steps: Floats, initial: Floats, n_actions: int) -> TransitionModel:
    """The model in which each of the steps of a state and action is equally likely.

    Args:
        steps: a row for each step, shape (n, 4): state x number of actions + action, the next
            state, the reward, and 1 if the step terminates. States without steps are ends.
        initial: probabilities of the starting states, shape (S,).
        n_actions: the number of actions.
    """
    n_states = len(initial)
    row, reached, _, ends = steps.astype(np.int64).T
    keys, kinds, counts = np.unique(
        (row * n_states + reached) * 2 + ends, return_inverse=True, return_counts=True
    )
    mean = np.bincount(kinds, steps[:, 2]) / counts
    variance = np.bincount(kinds, (steps[:, 2] - mean[kinds]) ** 2) / counts
    rows = keys // (2 * n_states)
    totals = np.bincount(rows, counts, minlength=n_states * n_actions)
    places = np.arange(len(rows)) - np.searchsorted(rows, rows)  # among the outcomes of a row

    def table(values: NDArray[Any], elsewhere: Any) -> NDArray[Any]:
        filled = np.zeros((len(totals), places.max() + 1), values.dtype)
        filled[totals == 0, 0] = elsewhere
        filled[rows, places] = values
        return filled.reshape(n_states, n_actions, -1)

    prob, next_state = table(counts / totals[rows], 1), table(keys // 2 % n_states, 0)
    reward, terminated = table(mean, 0), table(keys % 2 == 1, True)
    return TransitionModel(prob, next_state, reward, terminated, initial, table(variance, 0))
