"""The backup of a learner, right or with a fault: formulas, and the values to which each leads."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rl_yardstick.diagnosis.composite_world import END, GAMMA, N_ACTIONS, Ints, Steps
from rl_yardstick.mdp.transition_model import Floats

Values = Callable[[Ints], Floats]  # the next value of each step at the states given
Backup = Callable[[Steps, Values], Floats]  # the target of each step
OfSteps = Callable[[Steps], Any]
RIGHT = "right"


def backup(
    reward: OfSteps = lambda d: d.reward,
    shown: OfSteps = lambda d: d.shown,
    goes_on: OfSteps = lambda d: 1 - d.terminated,
    discount: OfSteps = lambda d: GAMMA,
) -> Backup:
    """The target reward + discount * goes_on * value(shown); all right where nothing is given."""
    return lambda d, v: reward(d) + discount(d) * goes_on(d) * v(shown(d))


def at_truncation(cut: OfSteps, other: OfSteps) -> OfSteps:
    """One thing where an episode is truncated, and another elsewhere."""
    return lambda d: np.where(d.truncated > 0, cut(d), other(d))


def beside_its_own(backup: Backup) -> Backup:
    """As in rollouts whose truncated steps had their last value added to the reward."""
    return lambda d, v: d.truncated * GAMMA * v(d.shown) + backup(d, v)


def _next_episode(d: Steps) -> Ints:
    return np.where(d.over > 0, d.next_state, d.shown)


def _off(d: Steps) -> Floats:
    return 1 - d.is_first


_ONCE, _TWICE, _NOT, _SHOWN = (
    (lambda d: GAMMA),
    (lambda d: GAMMA**2),
    (lambda d: 1),
    (lambda d: d.shown),
)
_LEAKS, _LATE = backup(goes_on=_NOT, shown=_next_episode), backup(goes_on=_off, shown=_next_episode)
_REWARDS: Mapping[str, OfSteps] = {
    "reward-clipped": lambda d: np.clip(d.reward, -1, 1),
    "reward-sign-only": lambda d: np.sign(d.reward),
    "reward-sign-flipped": lambda d: -d.reward,
    "reward-absolute": lambda d: np.abs(d.reward),
    "reward-squashed": lambda d: np.tanh(d.reward),
    "reward-of-step-before": lambda d: d.reward_before,
    "reward-of-step-after": lambda d: d.next_reward,
    "reward-missing-at-the-end": lambda d: np.where(d.over > 0, 0, d.reward),
    "reward-missing-at-truncation": at_truncation(lambda d: 0, lambda d: d.reward),
    **{
        f"reward-scaled ({c:g})": lambda d, c=c: c * d.reward  # type: ignore[misc]
        for c in (0.01, 0.1, 0.5, 2.0, 10.0)
    },
}
# What is in parentheses tells rows of one fault apart.
BACKUPS: Mapping[str, Backup] = {
    RIGHT: backup(),
    "bootstraps-at-terminal": backup(goes_on=_NOT),
    "no-bootstrap-at-truncation": backup(goes_on=lambda d: 1 - d.over),
    "no-bootstrap-at-truncation (leaks)": backup(
        goes_on=lambda d: 1 - d.truncated, shown=_next_episode
    ),
    "bootstrap-mask-inverted": backup(goes_on=lambda d: 1 - d.truncated),
    "bootstraps-only-at-the-end": backup(goes_on=lambda d: d.over),
    "bootstraps-only-at-terminal": backup(goes_on=lambda d: d.terminated),
    "reset-observation": backup(shown=at_truncation(_next_episode, _SHOWN)),
    "own-state-at-truncation": backup(shown=at_truncation(lambda d: d.state, _SHOWN)),
    "truncation-undiscounted": backup(discount=at_truncation(_NOT, _ONCE)),
    "truncation-discounted-twice": backup(discount=at_truncation(_TWICE, _ONCE)),
    "truncation-counted-twice": beside_its_own(backup()),
    "next-episode-leaks": _LEAKS,
    "next-episode-leaks (beside)": beside_its_own(_LEAKS),
    "done-flag-off-by-one": _LATE,
    "done-flag-off-by-one (true end)": backup(goes_on=_off),
    "done-flag-off-by-one (beside)": beside_its_own(_LATE),
    "discount-twice": backup(discount=_TWICE),
    "discount-twice (not at truncation)": backup(discount=at_truncation(_ONCE, _TWICE)),
    "discount-missing": backup(discount=_NOT),
    "discount-missing (not at truncation)": backup(discount=at_truncation(_ONCE, _NOT)),
    "discount-on-reward-too": backup(reward=lambda d: GAMMA * d.reward),
    "no-bootstrap": backup(goes_on=lambda d: 0),
    "no-bootstrap (but at truncation)": backup(goes_on=lambda d: d.truncated),
    "bootstraps-from-own-state": backup(shown=lambda d: d.state),
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


def next_values(q: Floats, d: Steps, rule: str) -> Values:
    """The next values by a rule, of values of actions (S, 2), or of states (S, 1)."""
    if q.shape[1] == 1:
        return lambda states: q[states, 0]
    return lambda states: RULES[rule](q, d, states)


def fault_of(name: str) -> str:
    """The fault of a row, without what tells its rows apart."""
    return name.partition(" (")[0]


def name_of_rule(rule: str) -> str:
    """The fault of a learner whose next value is by this rule."""
    if rule not in ("largest", "next", "expected"):
        return f"next-value-is-{rule}"
    if rule == "largest":
        return f"maximises-instead-of-follows ({rule})"
    # from outside, an action chosen by the policy or by another state's values looks the same
    return f"follows-instead-of-maximises or next-value-is-best-in-own-state ({rule})"


# --- the values to which a formula leads ----------------------------------------------------------


class Candidate(NamedTuple):
    """Values to which a formula leads, (S, 2) or (S, 1)."""

    name: str
    values: Floats
    spread: Floats  # of the targets in each cell


def solve(name: str, formula: Backup, d: Steps, rule: str, own: Floats) -> Candidate:
    """The fixed point of a formula on a log; cells that it never updates have ``own`` values."""
    by_action, q = own.shape[1] > 1, np.zeros_like(own)
    known = np.bincount(d.cells(by_action), d.weight, own.size).reshape(own.shape) > 0
    spread = q
    for _ in range(200):
        target = formula(d, next_values(q, d, rule))
        before, (mean, spread) = q, d.means(target, by_action)
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
            boot[is_last] = (GAMMA**power * (1 - d.terminated[j]) * ahead[j])[is_last]
            alive = alive if how == "crosses episodes" else alive * (1 - d.over[j])
        found: Floats = total + boot
        return found

    return formula


def is_table(first: Floats) -> bool:
    """Whether these values before training are those of a table: the same in nearly all states."""
    return len(np.unique(first.round(6), axis=0)) < 5


def candidates(d: Steps, rule: str, own: Floats, first: Floats) -> Iterator[Candidate]:
    """The right values, and those of each fault.

    Args:
        d: the log.
        rule: of the right next value.
        own: the learner's values, (S, 2) or (S, 1).
        first: its values before training.
    """
    for name, formula in BACKUPS.items():
        yield solve(name, formula, d, rule, own)
    for n in (2, 3, 5):
        for how in ("one", "undiscounted", "more", "less", "crosses episodes"):
            yield solve(f"n-step-return ({how}, {n})", n_step(n, how), d, rule, own)
    ends = {"end": d.over, "terminal": d.terminated, "truncation": d.truncated}
    for name, unlearnt in ends.items() if is_table(first) else ():
        part, kept = copy.copy(d), first.copy()
        part.weight, kept[END] = d.weight * (1 - unlearnt), own[END]
        yield solve(f"step-before-{name}-never-learnt", BACKUPS[RIGHT], part, rule, kept)
    yield solve("learns-from-steps-after-the-end", BACKUPS[RIGHT], _with_resets(d), rule, own)
    yield _not_detached(d, rule, own)
    yield solve("loss-broadcasts-over-the-batch", _mean_of_all, d, rule, own)
    yield from (_of_actions(d, rule, own, first) if own.shape[1] > 1 else _of_states(d, own))


def _mean_of_all(d: Steps, v: Values) -> Floats:
    return np.full(len(d.state), np.average(BACKUPS[RIGHT](d, v), weights=d.weight))


def _of_actions(d: Steps, rule: str, own: Floats, first: Floats) -> Iterator[Candidate]:
    right = BACKUPS[RIGHT]
    for wrong in RULES:
        is_same = {wrong, rule} <= {"next", "expected"} or wrong == rule
        if wrong == "expectation-below-1" and rule != "expected":
            continue
        if not (is_same or (wrong == "mean" and rule != "largest" and d.exploration[-1] > 0.8)):
            yield solve(name_of_rule(wrong), right, d, wrong, own)
    other = copy.copy(d)
    for tag, other.action in (("before", d.action_before), ("after", d.next_action)):
        yield solve(f"action-of-another-step ({tag})", right, other, rule, own)
    still = next_values(first, d, rule)
    yield solve("target-never-copied", lambda d, v: right(d, still), d, rule, own)


def _of_states(d: Steps, own: Floats) -> Iterator[Candidate]:
    for decay in (0.0, 0.8, 0.9, 0.95, 1.0):

        def halved(d: Steps, v: Values, decay: float = decay) -> Floats:
            more = GAMMA * (1 + decay * (1 - d.truncated)) * (1 - d.terminated)
            found: Floats = (d.reward + more * v(d.shown)) / 2
            return found

        yield solve(f"value-target-is-the-advantage ({decay})", halved, d, "", own)


def _with_resets(d: Steps) -> Steps:
    """The log with a step of reward 0 from each end to the next episode's start."""
    more = d.take(np.flatnonzero(d.over))
    more.state, more.shown = more.shown, more.next_state
    more.reward = more.terminated = more.truncated = more.over = 0 * more.over
    return d.joined(more)


def _not_detached(d: Steps, rule: str, own: Floats) -> Candidate:
    """Values of the least squared error, where the target moves with the values."""
    found = solve("target-not-detached", BACKUPS[RIGHT], d, rule, own)
    q, by_action, rows = found.values, own.shape[1] > 1, np.arange(len(d.state))
    for _ in range(6):
        best = q[d.shown].argmax(axis=1) if rule == "largest" else d.next_action
        ahead = d.shown * N_ACTIONS + best if by_action else d.shown
        slopes = np.zeros((len(rows), own.size))
        slopes[rows, d.cells(by_action)] += 1
        slopes[rows, ahead] -= GAMMA * (1 - d.terminated)
        weighted = slopes * d.weight[:, None]
        normal = weighted.T @ slopes + 1e-8 * np.eye(own.size)
        q = np.asarray(np.linalg.solve(normal, weighted.T @ d.reward), float).reshape(own.shape)
    return Candidate(found.name, q, found.spread)


# --- what the values obey -------------------------------------------------------------------------


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
        right = (1.0, 0.0, GAMMA, 0.0, GAMMA)
        return [abs(found - wanted) > 0.08 for found, wanted in zip(self, right, strict=False)]

    def words(self) -> str:
        """The target in a line, and what would be right where it is not."""
        right = ["1.00 reward", "0.00", "0.80 next value", "0.00 value at the end"]
        right.append("0.80 value where cut off")
        told = [f"{found + 0.0005:.2f}{text[4:]}" for found, text in zip(self, right, strict=False)]
        off = self.off()
        shown = [text for i, text in enumerate(told) if off[i] or i in (0, 2, 4)]
        other = ", ".join(text for i, text in enumerate(right) if off[i])
        about = "about " if self.misfit > 1 else ""
        line = f"target = {about}{' + '.join(shown)}".replace("+ -", "- ")
        return f"{line}; right would be {other}" if other else line


def parts_of(d: Steps, ahead: Floats) -> list[Floats]:
    """The parts of each step's target, for the next values ``ahead``."""
    ends = ((1 - d.over) * ahead, d.terminated * ahead, d.truncated * ahead)
    return [d.reward, 0 * ahead + 1, *ends]


def fitted(
    told: Floats, parts: list[Floats], weights: Floats, own: Floats | None = None
) -> Measured:
    """Read the target off by least squares: of targets, or of errors if ``own`` values are given.

    Args:
        told: targets, or targets less own values times an unknown factor, shape (n,).
        parts: of the target, each of shape (n,).
        weights: inverse tolerances.
        own: the own values.
    """
    matrix = np.array([*parts, *([] if own is None else [-own])]).T * weights[:, None]
    found, *_ = np.linalg.lstsq(matrix, told * weights, rcond=None)
    misfit = np.sqrt(np.mean((matrix @ found - told * weights) ** 2))
    parts_of_it = found if own is None else found[:-1] / found[-1]
    reward, constant, following, at_end, where_cut = (float(each) for each in parts_of_it)
    return Measured(reward, constant, following, at_end, where_cut, float(misfit))


def measured(q: Floats, d: Steps, rule: str) -> Measured:
    """Read the backup off values, (S, 2) or (S, 1), in well-visited cells."""
    by_action, ahead = q.shape[1] > 1, next_values(q, d, rule)(d.shown)
    often = (d.counts(by_action) >= 40).ravel()
    means = [d.means(part, by_action)[0].ravel()[often] for part in parts_of(d, ahead)]
    told = q.ravel()[often]
    return fitted(told, means, 1 / (0.1 + 0.05 * np.abs(told)))
