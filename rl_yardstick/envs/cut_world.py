"""The model of an environment whose observations are cut into bins.

From many points of each bin the environment makes one step for each action. The *cut world* has all
of these steps, with equal probabilities: a state is a bin, and each step begins at a random point
of it, wherever the step before ended. Its figures are not those of the environment.
"""

from __future__ import annotations

import copy
from array import array
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rl_yardstick.envs.known_models import TRANSPARENT_WRAPPERS, folds, layers
from rl_yardstick.envs.wrappers import DiscretizeObservation
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

Step = tuple[int, float, bool]  # the bin reached, the reward, whether the episode terminates

MOST_BINS = 500_000
MOST_POINTS, MOST_IN_BIN = 200_000, 20  # in all (but one in each bin), and in each bin
ARCS = 3  # of a circle, for each bin of the cosine or sine of an angle
N_STARTS, N_REPEATED = 10_000, 200


def cut_world(env: gym.Env[Any, Any]) -> TransitionModel | None:
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
    stepper = _Stepper(env)
    stepper.check()
    starts = np.array([stepper.start() for _ in range(N_STARTS)])
    initial = np.bincount(stepper.bins_of(starts), minlength=stepper.n_bins) / N_STARTS
    points = stepper.points(starts)
    without = ~np.isin(stepper.bins_of(starts), stepper.bins_of(points))
    steps = stepper.steps_from(np.concatenate((points, starts[without])))
    return _mean_model(np.reshape(steps, (-1, 4)), initial, stepper.n_actions)


class _Stepper:
    """A copy of an environment that steps from any state."""

    def __init__(self, env: Any) -> None:
        copies = dict[int, Any]()  # of what is inside wrappers that record, limit or check
        for wrapper in layers(env)[1]:
            kind = type(wrapper)
            if f"{kind.__module__}.{kind.__qualname__}" in TRANSPARENT_WRAPPERS:
                copies[id(wrapper)] = copy.deepcopy(wrapper.env, copies)
        self.env = copy.deepcopy(env, copies)
        self.base, self.wrappers = self.env.unwrapped, layers(self.env)[1]
        self.cut = next(w for w in self.wrappers if isinstance(w, DiscretizeObservation))
        self.n_bins, self.n_actions = int(env.observation_space.n), int(env.action_space.n)
        self.env.reset(seed=0)
        self.is_over = False  # where the next step needs a start
        self.first: Any = np.asarray(getattr(self.base, "state", None))
        self.n_angles = len(self.cut.env.observation_space.sample()) - self.first.size

    def state(self) -> tuple[float, ...]:
        """The present state."""
        return tuple(np.ravel(self.base.state).astype(np.float64).tolist())

    def start(self) -> tuple[float, ...]:
        """Begin an episode; its first state."""
        self.env.reset()
        self.is_over = False
        return self.state()

    def step(self, action: int, state: tuple[float, ...] | None = None) -> Step:
        """One step from a state, or from the present one."""
        if self.is_over:
            self.start()
        if state is not None:
            # Gymnasium's own classes compute faster with Python's numbers.
            is_quick = type(self.base).__module__.startswith("gymnasium.")
            self.base.state = state if is_quick else np.reshape(state, self.first.shape)
        reached, reward, terminated, truncated, _ = self.env.step(action)
        self.is_over = terminated or truncated
        return int(reached), float(reward), bool(terminated)

    def check(self) -> None:
        """Repeat steps in another order, each from its state; ValueError if they differ."""
        unknown = [w for w in self.wrappers if not (folds(w) or isinstance(w, gym.ActionWrapper))]
        if unknown:
            raise ValueError(f"the effect of {type(unknown[0]).__name__} on steps is not known")
        if self.n_bins > MOST_BINS:
            raise ValueError(f"{self.n_bins:,} bins are more than {MOST_BINS:,}")
        if self.first.dtype.kind not in "fiu":
            raise ValueError("it has no attribute state of numbers")
        played = []
        for action in np.random.default_rng(0).integers(self.n_actions, size=N_REPEATED).tolist():
            before = self.start() if self.is_over else self.state()
            played.append((before, action, (*self.step(action), *self.state())))
        again = [(*self.step(action, before), *self.state()) for before, action, _ in played[::-1]]
        found = np.array([numbers for *_, numbers in played], dtype=np.float64)
        same = 0 <= self.n_angles <= found.shape[1] - 3
        same = same and np.array_equal(self.bins_of(found[:, 3:]), found[:, 0])
        if not (same and np.allclose(found, again[::-1], rtol=1e-6, atol=1e-9)):
            raise ValueError("its steps or observations depend on more than its attribute state")

    def bins_of(self, states: Floats) -> Ints:
        """The bins of states of shape (n, numbers), shape (n,)."""
        angles, others = np.split(states, [self.n_angles], axis=1)
        circles = np.stack((np.cos(angles), np.sin(angles)), axis=2).reshape(len(states), -1)
        return self.cut.map_observations(np.hstack((circles, others)).astype(np.float32))

    def points(self, starts: Floats) -> Floats:
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

    def steps_from(self, points: Floats) -> array[float]:
        """All steps from points, as rows of `_mean_model`, one after the other."""
        steps, has_points = array("d"), np.zeros(self.n_bins, dtype=np.bool_)
        while len(points):
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
        return steps


def _mean_model(steps: Floats, initial: Floats, n_actions: int) -> TransitionModel:
    """The model in which all steps from a state by an action have the same probability.

    ``steps`` has the shape (n, 4): state x number of actions + action, next state, reward, and
    whether the episode terminates. States without steps are ends.
    """
    n_states = len(initial)
    row, reached, _, ends = steps.astype(np.int64).T
    kind = (row * n_states + reached) * 2 + ends
    kinds, which, counts = np.unique(kind, return_inverse=True, return_counts=True)
    mean = np.bincount(which, steps[:, 2]) / counts
    variance = np.bincount(which, (steps[:, 2] - mean[which]) ** 2) / counts
    rows = kinds // (2 * n_states)
    totals = np.bincount(rows, counts, minlength=n_states * n_actions)
    places = np.arange(len(rows)) - np.searchsorted(rows, rows)  # among the outcomes of a row

    def table(values: NDArray[Any], elsewhere: float = 0.0) -> NDArray[Any]:
        filled = np.zeros((len(totals), places.max() + 1), values.dtype)
        filled[totals == 0, 0] = elsewhere
        filled[rows, places] = values
        return filled.reshape(n_states, n_actions, -1)

    prob, next_state = table(counts / totals[rows], 1.0), table(kinds // 2 % n_states)
    outcomes = prob, next_state, table(mean), table(kinds % 2 == 1, 1.0)
    return TransitionModel(*outcomes, initial, table(variance))
