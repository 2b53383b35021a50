"""The backup of a learner, right or with a fault: formulas, and the values to which each leads."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rl_yardstick.diagnosis.composite_world import END, GAMMA, N_ACTIONS, Steps
from rl_yardstick.mdp.transition_model import Floats, Ints

Values = Callable[[Ints], Floats]  # the next value of each step at the states given
Backup = Callable[[Steps, Values], Floats]  # the target of each step
Found = tuple[str, str]  # the name of a fault, empty without one, and what shows it
RIGHT = "right"


def backup(
    ahead: Callable[[Steps], tuple[Any, Ints]] = lambda d: (GAMMA * d.goes_on, d.shown),
    reward: Callable[[Steps], Any] = lambda d: d.reward,
) -> Backup:
    """The target reward + factor * value(states), where ``ahead`` returns factor and states."""

    def formula(d: Steps, v: Values) -> Floats:
        factor, states = ahead(d)
        target: Floats = reward(d) + factor * v(states)
        return target

    return formula


def beside_its_own(backup: Backup) -> Backup:
    """As in rollouts whose truncated steps had their last value added to the reward."""
    return lambda d, v: d.truncated * GAMMA * v(d.shown) + backup(d, v)


# What is in parentheses tells rows of one fault apart.
_AHEAD: Mapping[str, Callable[[Steps], tuple[Any, Ints]]] = {
    "bootstraps-at-terminal": lambda d: (GAMMA, d.shown),
    "no-bootstrap-at-truncation": lambda d: (GAMMA * (1 - d.over), d.shown),
    "no-bootstrap-at-truncation (leaks)": lambda d: (GAMMA * (1 - d.truncated), d.following),
    "bootstrap-mask-inverted": lambda d: (GAMMA * (1 - d.truncated), d.shown),
    "bootstraps-only-at-the-end": lambda d: (GAMMA * d.over, d.shown),
    "bootstraps-only-at-terminal": lambda d: (GAMMA * d.terminated, d.shown),
    "reset-observation": lambda d: (
        GAMMA * d.goes_on,
        np.where(d.truncated, d.next_state, d.shown),
    ),
    "own-state-at-truncation": lambda d: (
        GAMMA * d.goes_on,
        np.where(d.truncated, d.state, d.shown),
    ),
    "truncation-undiscounted": lambda d: (np.where(d.truncated, 1, GAMMA) * d.goes_on, d.shown),
    "truncation-discounted-twice": lambda d: (GAMMA ** (1 + d.truncated) * d.goes_on, d.shown),
    "next-episode-leaks": lambda d: (GAMMA, d.following),
    "done-flag-off-by-one": lambda d: (GAMMA * (1 - d.is_first), d.following),
    "done-flag-off-by-one (true end)": lambda d: (GAMMA * (1 - d.is_first), d.shown),
    "discount-twice": lambda d: (GAMMA**2 * d.goes_on, d.shown),
    "discount-twice (elsewhere)": lambda d: (GAMMA ** (2 - d.truncated) * d.goes_on, d.shown),
    "discount-missing": lambda d: (d.goes_on, d.shown),
    "discount-missing (elsewhere)": lambda d: (GAMMA**d.truncated * d.goes_on, d.shown),
    "no-bootstrap": lambda d: (0, d.shown),
    "no-bootstrap (but at truncation)": lambda d: (GAMMA * d.truncated, d.shown),
    "bootstraps-from-own-state": lambda d: (GAMMA * d.goes_on, d.state),
}
_BESIDE = ("next-episode-leaks", "done-flag-off-by-one")
_REWARDS: Mapping[str, Callable[[Steps], Any]] = {
    "discount-on-reward-too": lambda d: GAMMA * d.reward,
    "reward-clipped": lambda d: np.clip(d.reward, -1, 1),
    "reward-sign-only": lambda d: np.sign(d.reward),
    "reward-sign-flipped": lambda d: -d.reward,
    "reward-absolute": lambda d: np.abs(d.reward),
    "reward-squashed": lambda d: np.tanh(d.reward),
    "reward-of-step-before": lambda d: d.reward_before,
    "reward-of-step-after": lambda d: d.next_reward,
    "reward-missing-at-the-end": lambda d: d.reward * (1 - d.over),
    "reward-missing-at-truncation": lambda d: d.reward * (1 - d.truncated),
    "reward-scaled (0.01)": lambda d: 0.01 * d.reward,
    "reward-scaled (0.1)": lambda d: 0.1 * d.reward,
    "reward-scaled (0.5)": lambda d: 0.5 * d.reward,
    "reward-scaled (2)": lambda d: 2.0 * d.reward,
    "reward-scaled (10)": lambda d: 10.0 * d.reward,
}
BACKUPS: Mapping[str, Backup] = {
    RIGHT: backup(),
    **{name: backup(ahead) for name, ahead in _AHEAD.items()},
    "truncation-counted-twice": beside_its_own(backup()),
    **{f"{name} (beside)": beside_its_own(backup(_AHEAD[name])) for name in _BESIDE},
    **{name: backup(reward=reward) for name, reward in _REWARDS.items()},
}

# --- the next value -------------------------------------------------------------------------------

RULES: Mapping[str, Callable[[Floats, Steps, Ints], Floats]] = {
    "largest": lambda q, d, states: q[states].max(axis=1),
    "next": lambda q, d, states: np.where(
        (d.over == 0) & (states == d.shown) | (d.over == 1) & (states == d.next_state),
        q[states, d.next_action],
        q[states].max(axis=1),
    ),
    "expected": lambda q, d, states: (
        (1 - d.exploration) * q[states].max(axis=1) + d.exploration * q[states].mean(axis=1)
    ),
    "expectation-below-1": lambda q, d, states: (
        (1 - d.exploration) * q[states].max(axis=1) + d.exploration * q[states].min(axis=1) / 2
    ),
    "smallest": lambda q, d, states: q[states].min(axis=1),
    "mean": lambda q, d, states: q[states].mean(axis=1),
    "sum": lambda q, d, states: q[states].sum(axis=1),
    "first": lambda q, d, states: q[states, 0],
    "last": lambda q, d, states: q[states, 1],
    "same": lambda q, d, states: q[states, d.action],
    "best-in-own-state": lambda q, d, states: q[states, q[d.state].argmax(axis=1)],
}

# from outside, an action chosen by the policy or by another state's values looks the same
_ACTED = "follows-instead-of-maximises or next-value-is-best-in-own-state"
NAMES_OF_RULES = {rule: f"next-value-is-{rule}" for rule in RULES} | {
    "largest": "maximises-instead-of-follows",
    **{rule: f"{_ACTED} ({rule})" for rule in ("next", "expected")},
}


def next_values(q: Floats, d: Steps, rule: str) -> Values:
    """The next values by a rule, of values of actions (S, 2), or of states (S, 1)."""
    if q.shape[1] == 1:
        return lambda states: q[states, 0]
    return lambda states: RULES[rule](q, d, states)


def fault_of(name: str) -> str:
    """The fault of a row, without what tells its rows apart."""
    return name.partition(" (")[0]


# --- the values to which a formula leads ----------------------------------------------------------


class Candidate(NamedTuple):
    """Values to which a formula leads, (S, 2) or (S, 1)."""

    name: str
    values: Floats
    spread: Floats  # of the targets in each cell


def solve(name: str, formula: Backup, d: Steps, rule: str, own: Floats) -> Candidate:
    """The fixed point of a formula on a log; cells that it never updates have ``own`` values."""
    q = spread = np.zeros_like(own)
    known = np.bincount(d.cells(own.size), d.weight, own.size).reshape(own.shape) > 0
    for _ in range(200):
        target = formula(d, next_values(q, d, rule))
        before, (mean, spread) = q, d.means(target, own.size)
        q = np.clip(np.where(known, mean, own), -60, 60)
        if np.abs(q - before).max() < 1e-4:
            break
    return Candidate(name, q, spread)


def n_step(n: int, how: str) -> Backup:
    """A target of n steps along the log, with a fault."""

    def formula(d: Steps, v: Values) -> Floats:
        size, ahead = len(d.state), v(d.shown)
        total, boot, alive = np.zeros(size), np.zeros(size), np.ones(size)
        for k in range(n):
            j = (np.arange(size) + k) % size
            total += alive * (1 if how == "undiscounted" else GAMMA**k) * d.reward[j]
            is_last = (alive > 0) & ((k == n - 1) | (d.over[j] > 0))
            power = {"one": 1, "more": k + 2, "less": k}.get(how, k + 1)
            boot[is_last] = (GAMMA**power * d.goes_on[j] * ahead[j])[is_last]
            alive = alive if how == "crosses episodes" else alive * (1 - d.over[j])
        found: Floats = total + boot
        return found

    return formula


def is_table(first: Floats) -> bool:
    """Whether these values before training are those of a table: the same in nearly all states."""
    return len(np.unique(first.round(6), axis=0)) < 5


def half_the_return(decay: float) -> Backup:
    """Where values learn the advantage of a trace, they settle at half of their sum."""
    return backup(
        lambda d: (GAMMA * (1 + decay * (1 - d.truncated)) * d.goes_on / 2, d.shown),
        lambda d: d.reward / 2,
    )


def candidates(d: Steps, rule: str, own: Floats, first: Floats) -> Iterator[Candidate]:
    """The right values of a log, and those of each fault.

    ``rule`` is that of the right next value; ``own`` are the learner's values, (S, 2) or (S, 1),
    and ``first`` those before training.
    """
    right, solved = BACKUPS[RIGHT], partial(solve, d=d, rule=rule, own=own)
    for name, formula in BACKUPS.items():
        yield solved(name, formula)
    for n in (2, 3, 5):
        for how in ("one", "undiscounted", "more", "less", "crosses episodes"):
            yield solved(f"n-step-return ({how}, {n})", n_step(n, how))
    ends = {"end": d.over, "terminal": d.terminated, "truncation": d.truncated}
    for name, unlearnt in ends.items() if is_table(first) else ():
        part, kept = copy.copy(d), first.copy()
        part.weight, kept[END] = d.weight * (1 - unlearnt), own[END]
        yield solved(f"step-before-{name}-never-learnt", right, d=part, own=kept)
    yield solved("learns-from-steps-after-the-end", right, d=_with_resets(d))
    yield _not_detached(solved("target-not-detached", right), d, rule)
    yield solved(
        "loss-broadcasts-over-the-batch",
        lambda d, v: np.full(len(d.state), np.average(right(d, v), weights=d.weight)),
    )
    if own.shape[1] == 1:
        for decay in (0.0, 0.8, 0.9, 0.95, 1.0):
            yield solved(f"value-target-is-the-advantage ({decay})", half_the_return(decay))
        return
    same = {rule} if rule == "largest" else {"next", "expected"}
    if rule != "expected":
        same.add("expectation-below-1")
    if rule != "largest" and d.exploration[-1] > 0.8:
        same.add("mean")
    for wrong, name in NAMES_OF_RULES.items():
        if wrong not in same:
            yield solved(name, right, rule=wrong)
    other = copy.copy(d)
    for tag, other.action in (("before", d.action_before), ("after", d.next_action)):
        yield solved(f"action-of-another-step ({tag})", right, d=other)
    still = next_values(first, d, rule)
    yield solved("target-never-copied", lambda d, v: right(d, still))


def _with_resets(d: Steps) -> Steps:
    """The log with a step of reward 0 from each end to the next episode's start."""
    more = d.take(np.flatnonzero(d.over))
    more.state, more.shown = more.shown, more.next_state
    more.reward = more.terminated = more.truncated = more.over = 0 * more.over
    more.goes_on = 1 + more.over
    return d.joined(more)


def _not_detached(right: Candidate, d: Steps, rule: str) -> Candidate:
    """Values of the least squared error, where the target moves with the values."""
    q, rows = right.values, np.arange(len(d.state))
    for _ in range(6):
        best = q[d.shown].argmax(axis=1) if rule == "largest" else d.next_action
        slopes = np.zeros((len(rows), q.size))
        slopes[rows, d.cells(q.size)] += 1
        ahead = d.shown if q.shape[1] == 1 else d.shown * N_ACTIONS + best
        slopes[rows, ahead] -= GAMMA * d.goes_on
        weighted = slopes * d.weight[:, None]
        normal = weighted.T @ slopes + 1e-8 * np.eye(q.size)
        q = np.linalg.solve(normal, weighted.T @ d.reward).reshape(q.shape)
    return right._replace(values=q)


# --- what the values obey -------------------------------------------------------------------------


# The parts of a target, and the right coefficient of each.
PARTS = {"reward": 1.0, "": 0.0, "next value": GAMMA}
PARTS |= {"value at the end": 0.0, "value where cut off": GAMMA}


class Measured(NamedTuple):
    """The backup that values obey: coefficients of the target's parts."""

    reward: float
    constant: float
    next_value: float
    at_the_end: float  # of the value of what a terminated episode shows last
    where_cut: float  # of the value of what a truncated episode shows last
    misfit: float = 0.0  # root mean square, in tolerances

    def off(self) -> list[bool]:
        """Which coefficients are not right."""
        pairs = zip(self, PARTS.values(), strict=False)
        return [abs(found - right) > 0.08 for found, right in pairs]

    def words(self) -> str:
        """The target in a line, and what would be right where it is not."""
        if max(map(abs, self[:-1])) > 10:
            return "target = no sum of reward and next value"
        shown, other = [], []
        for found, (part, right), is_off in zip(self, PARTS.items(), self.off(), strict=False):
            if is_off or right:
                shown.append(f"{found + 0.0005:.2f} {part}".rstrip())
            if is_off:
                other.append(f"{right:.2f} {part}".rstrip())
        about = "about " if self.misfit > 1 else ""
        line = f"target = {about}{' + '.join(shown)}".replace("+ -", "- ")
        return f"{line}; right would be {', '.join(other)}" if other else line


def parts_of(d: Steps, ahead: Floats) -> list[Floats]:
    """The parts of each step's target, for the next values ``ahead``."""
    ends = ((1 - d.over) * ahead, d.terminated * ahead, d.truncated * ahead)
    return [d.reward, np.ones_like(ahead), *ends]


def fitted(
    told: Floats, parts: list[Floats], weights: Floats, own: Floats | None = None
) -> Measured:
    """Read the target off by least squares: of targets, or of errors if ``own`` values are given.

    ``told`` are targets, or targets less own values times an unknown factor, ``parts`` those of the
    target, and ``weights`` inverse tolerances, all of shape (n,).
    """
    matrix = np.array([*parts, *([] if own is None else [-own])]).T * weights[:, None]
    found, *_ = np.linalg.lstsq(matrix, told * weights, rcond=None)
    misfit = np.sqrt(np.mean((matrix @ found - told * weights) ** 2))
    coefficients = found if own is None else found[:-1] / found[-1]
    return Measured._make([*coefficients.tolist(), float(misfit)])


def measured(q: Floats, d: Steps, rule: str) -> Measured:
    """Read the backup off values, (S, 2) or (S, 1), in well-visited cells."""
    often, ahead = d.counts(q.size) >= 40, next_values(q, d, rule)(d.shown)
    means = [d.means(part, q.size)[0][often] for part in parts_of(d, ahead)]
    told = q[often]
    return fitted(told, means, 1 / (0.1 + 0.05 * np.abs(told)))
