"""The base classes of bandits: counts of pulls, the ``info`` of `step`, and rendering."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from rl_yardstick.envs import drawing
from rl_yardstick.envs.argument_checks import check_whole_number
from rl_yardstick.envs.drawing import Box, Chart, ChartRenderer, Disc, Label, Shape, ShownEnv
from rl_yardstick.mdp.transition_model import Floats, Ints

# Above these numbers, only the first arms are shown, and the contexts around the present one.
MAX_ARMS_SHOWN = 40
MAX_CONTEXTS_SHOWN = 4
# The length of a bar in a text, in characters.
BAR = 30
# In pixels.
MARGIN = 56
SLOT = 64
MAX_WIDTH = 960
TITLE = 40
PANEL = 200
CAPTION = 48
TEXT = 20
# The narrowest slot that numbers fit into: in narrower slots some of them are left out.
MIN_LABELLED = 30


@dataclass(eq=False)
class Tally:
    """Counts and rewards of the pulls of an episode."""

    counts: Ints  # the number of pulls, shape (n_contexts, n_arms)
    sums: Floats  # the sums of their rewards, likewise
    last: tuple[int, int, float] | None = None  # context, arm and reward of the latest pull

    @classmethod
    def empty(cls, n_contexts: int, n_arms: int) -> Tally:
        """No pulls yet."""
        shape = (n_contexts, n_arms)
        return cls(np.zeros(shape, np.int64), np.zeros(shape))

    def add(self, context: int, arm: int, reward: float) -> None:
        """Count a pull."""
        self.counts[context, arm] += 1
        self.sums[context, arm] += reward
        self.last = (context, arm, reward)

    @property
    def observed(self) -> Floats:
        """The mean rewards, NaN where there was no pull."""
        return np.divide(
            self.sums, self.counts, out=np.full_like(self.sums, np.nan), where=self.counts > 0
        )

    @property
    def title(self) -> str:
        """The latest pull in words."""
        if self.last is None:
            return "no pull yet"
        _, arm, reward = self.last
        return f"pull {self.counts.sum()}: arm {arm}, reward {reward:.4g}"


class _Scale:
    """Maps values to positions on an axis, which always includes zero."""

    def __init__(self, *means: Floats | None) -> None:
        known = np.concatenate([array.ravel() for array in means if array is not None])
        known = np.append(known[np.isfinite(known)], 0)
        self.low, self.high = float(known.min()), float(known.max())
        if self.high == self.low:
            self.high = self.low + 1

    def part(self, value: float) -> float:
        """0 for the lowest value, 1 for the highest."""
        return (value - self.low) / (self.high - self.low)


def render_text(tally: Tally, true: Floats | None, present: int) -> str:
    """The latest pull on a line, then a line for each arm.

    In the bars ``=`` reaches from zero to the observed mean, ``|`` marks the mean in ``true``, of
    shape (n_contexts, n_arms). ``present`` is the context of the next pull.
    """
    observed = tally.observed
    scale = _Scale(observed, true)
    lines = [tally.title]
    for context in _shown_contexts(len(observed), present):
        if len(observed) > 1:
            lines.append(f"context {context}{' (next)' if context == present else ''}")
        lines.append("  arm    pulls  observed" + ("" if true is None else "  true now"))
        for arm in range(min(observed.shape[1], MAX_ARMS_SHOWN)):
            latest = tally.last is not None and tally.last[:2] == (context, arm)
            mean = None if true is None else float(true[context, arm])
            seen = float(observed[context, arm])
            number = f"{'-':>10}" if np.isnan(seen) else f"{seen:10.3f}"
            line = f"{'>' if latest else ' '} {arm:3} {tally.counts[context, arm]:8}{number}"
            line += "" if mean is None else f"{mean:10.3f}"
            lines.append(f"{line}  {_text_bar(scale, seen, mean)}".rstrip())
        if observed.shape[1] > MAX_ARMS_SHOWN:
            lines.append(f"  ... of {observed.shape[1]} arms")
    return "\n".join(lines) + "\n"


def render_chart(tally: Tally, true: Floats | None, present: int) -> Chart:
    """A bar for each arm, with one panel for each context; see `render_text`."""
    observed = tally.observed
    contexts = _shown_contexts(len(observed), present)
    n_arms = min(observed.shape[1], MAX_ARMS_SHOWN)
    width = min(max(MARGIN + SLOT * n_arms, 360) + MARGIN // 4, MAX_WIDTH)
    height = TITLE + len(contexts) * (PANEL + CAPTION)
    cut = f"arms 0-{n_arms - 1} of {observed.shape[1]}" if n_arms < observed.shape[1] else ""
    shapes = list(_heading(tally.title, cut, width, true is not None))
    scale = _Scale(observed, true)
    for i, context in enumerate(contexts):
        panel = _Panel(scale, TITLE + i * (PANEL + CAPTION), width, n_arms)
        if len(observed) > 1:
            shapes += panel.name(context, context == present)
        shapes += panel.axis()
        for arm in range(n_arms):
            latest = tally.last is not None and tally.last[:2] == (context, arm)
            mean = None if true is None else float(true[context, arm])
            count = int(tally.counts[context, arm])
            shapes += panel.arm(arm, count, float(observed[context, arm]), mean, latest)
    return Chart((width, height), shapes)


@dataclass(frozen=True)
class _Panel:
    """The arms in one context."""

    scale: _Scale
    top: int
    width: int
    n_arms: int

    def y(self, value: float) -> float:
        """The height at which a value stands."""
        return self.top + 20 + (1 - self.scale.part(value)) * (PANEL - 40)

    def name(self, context: int, present: bool) -> Iterator[Shape]:
        """The name of a context, with a dot if it is the context of the next pull."""
        at = (self.width - MARGIN // 4, self.top + 8)
        yield Label(f"context {context}", at, TEXT, drawing.INK, align=1)
        if present:
            yield Disc((at[0] - 84, at[1] - 1), 5, drawing.GREEN)

    def axis(self) -> Iterator[Shape]:
        """The zero line, and the numbers beside it."""
        right = self.width - MARGIN // 4
        for value in sorted({self.scale.low, 0.0, self.scale.high}):
            colour = drawing.SHELF if value == 0 else drawing.GRID
            yield Box((MARGIN, self.y(value)), (right - MARGIN, 1), 0, colour)
            yield Label(f"{value:.3g}", (MARGIN - 8, self.y(value)), TEXT, drawing.INK, align=1)

    def arm(
        self, arm: int, count: int, observed: float, true: float | None, latest: bool
    ) -> Iterator[Shape]:
        """A bar up to the observed mean, a line at the true one, and the number of pulls."""
        slot = (self.width - MARGIN - MARGIN // 4) / self.n_arms
        left = MARGIN + slot * arm
        if not np.isnan(observed):
            upper, lower = sorted((self.y(observed), self.y(0)))
            colour = drawing.DARK_BLUE if latest else drawing.BLUE
            yield Box((left + slot * 0.2, upper), (slot * 0.6, lower - upper + 1), 0, colour)
        if true is not None:
            at = (left + slot * 0.08, self.y(true) - 2)
            yield Box(at, (slot * 0.84, 4), 2, drawing.ORANGE)
        middle, below = left + slot / 2, self.top + PANEL
        each = math.ceil(MIN_LABELLED / slot)
        if arm % each == 0:
            yield Label(f"{arm}", (middle, below), TEXT + 4, drawing.INK)
        if each == 1:
            yield Label(f"{count}", (middle, below + 18), TEXT - 2, drawing.SHELF)


def _heading(title: str, cut: str, width: int, knows_truth: bool) -> Iterator[Shape]:
    """The latest pull, the range of arms if not all are shown, and the meaning of the colours."""
    left, right = MARGIN // 4, width - MARGIN // 4
    yield Label(title, (left, 14), TEXT + 2, drawing.INK, align=0)
    yield Label(cut, (right, 14), TEXT - 2, drawing.SHELF, align=1)
    yield Box((left, 28), (12, 12), 0, drawing.BLUE)
    yield Label("observed mean", (left + 18, 34), TEXT - 2, drawing.INK, align=0)
    if knows_truth:
        yield Box((left + 130, 32), (16, 4), 2, drawing.ORANGE)
        yield Label("true mean now", (left + 152, 34), TEXT - 2, drawing.INK, align=0)
    if width >= 560:
        below = "below each arm: its number, its pulls"
        yield Label(below, (right, 34), TEXT - 2, drawing.SHELF, align=1)


def _shown_contexts(n_contexts: int, present: int) -> range:
    """Contexts around the present one."""
    first = max(0, min(present - MAX_CONTEXTS_SHOWN // 2, n_contexts - MAX_CONTEXTS_SHOWN))
    return range(first, min(first + MAX_CONTEXTS_SHOWN, n_contexts))


def _text_bar(scale: _Scale, observed: float, true: float | None) -> str:
    def place(value: float) -> int:
        return round(scale.part(value) * (BAR - 1))

    cells = [" "] * BAR
    if not np.isnan(observed):
        first, last = sorted((place(0), place(observed)))
        cells[first : last + 1] = "=" * (last + 1 - first)
    if true is not None:
        cells[place(true)] = "|"
    return "".join(cells)


MAX_PULLS = 10**9
MAX_ARMS = 10_000


class Bandit(ShownEnv):
    """Arms to pull, one a step, in the present context.

    A subclass defines the start of an episode in `_begin`, a pull in `step`, and the known means of
    the arms in `_true_means`. `gymnasium.make` makes ``pulls`` the time limit.
    """

    kind: str  # the kind of dynamics, which selects the compiled copy
    context: Any  # what the agent observes before the next pull

    def __init__(
        self,
        n_arms: int,
        observation_space: spaces.Space[Any],
        *,
        pulls: int,
        batch_size: int = 1,
        render_mode: str | None,
    ) -> None:
        super().__init__(render_mode)
        self.n_arms = n_arms
        self.pulls = check_whole_number("pulls", pulls, 1, MAX_PULLS)
        self.batch_size = check_whole_number("batch_size", batch_size, 1, MAX_PULLS)
        self.observation_space = observation_space
        self.action_space = spaces.Discrete(n_arms)
        self.pulls_done = 0  # in this episode
        self._tally = Tally.empty(max(self.n_contexts, 1), n_arms)

    @property
    def n_contexts(self) -> int:
        """The number of contexts; 0 where they are vectors."""
        space = self.observation_space
        return int(space.n) if isinstance(space, spaces.Discrete) else 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; ``options`` are not used."""
        super().reset(seed=seed)
        self.pulls_done = 0
        self._begin()
        if self.render_mode is not None:
            self._tally = Tally.empty(max(self.n_contexts, 1), self.n_arms)
        if self.render_mode == "human":
            self.render()
        return self.context, {}

    def _text(self) -> str:
        return render_text(self._tally, self._true_means(), self._row(self.context))

    def _picture(self) -> Chart:
        return render_chart(self._tally, self._true_means(), self._row(self.context))

    def _make_renderer(self, fps: int, title: str) -> ChartRenderer:
        return ChartRenderer(fps, title)

    def _checked(self, action: int) -> int:
        """The arm that an action names."""
        arm = int(action)
        if not 0 <= arm < self.n_arms:
            raise ValueError(f"arm {arm} does not exist: they are numbered 0 to {self.n_arms - 1}")
        return arm

    def _row(self, context: Any) -> int:
        """The row of the tally for a context: its own, or the only one."""
        return int(context) if self.n_contexts else 0

    def _show_pull(self, context: Any, arm: int, reward: float) -> None:
        """Record a pull for the next picture, and render it in mode ``human``."""
        if self.render_mode is not None:
            self._tally.add(self._row(context), arm, reward)
        if self.render_mode == "human":
            self.render()

    @abstractmethod
    def _true_means(self) -> Floats | None:
        """The mean reward of each arm, with the rows of the tally; None if not known."""

    @abstractmethod
    def _begin(self) -> None:
        """Prepare the first pull of an episode."""


class StochasticBandit(Bandit):
    """Arms with random rewards, each with an expected reward in the present context.

    A subclass draws the arms and the first context in `_begin`, returns the expected reward of each
    arm in the context from `expected_rewards`, and draws a reward and the next context in `_pull`.
    Its docstring lists the random numbers in the order in which it draws them: compiled copies draw
    the same ones.
    """

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Pull an arm; the class describes the results."""
        arm = self._checked(action)
        expected = self.expected_rewards()
        best = max(expected)
        self.pulls_done += 1
        before = self.context
        reward = self._pull(arm)
        info = {
            "optimal_action": expected.index(best),
            "expected_reward": expected[arm],
            "regret": best - expected[arm],
            "feedback_due": self.pulls_done % self.batch_size == 0 or self.pulls_done == self.pulls,
        }
        self._show_pull(before, arm, reward)
        return self.context, reward, False, False, info

    @abstractmethod
    def expected_rewards(self) -> list[float]:
        """The expected reward of each arm in the present context."""

    @abstractmethod
    def _pull(self, arm: int) -> float:
        """Draw the reward of an arm, and the next context."""

    def _true_means(self) -> Floats | None:
        return np.array([self.expected_rewards()])


def agreed_size(name: str, asked: int | None, given: int | None, default: int, low: int) -> int:
    """The size ``given`` by other arguments, else ``asked``, else the default; they must agree."""
    if asked is None:
        return default if given is None else given
    size = check_whole_number(name, asked, low, MAX_ARMS)
    if given not in {None, size}:
        raise ValueError(f"{name} is {size}, but {given} are given: leave it out")
    return size
