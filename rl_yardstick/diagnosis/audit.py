"""Which backup a program makes: its values after training, or one update, against all formulas."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np

from rl_yardstick.diagnosis.backups import (
    RIGHT,
    RULES,
    Found,
    Measured,
    candidates,
    fault_of,
    is_table,
    measured,
)
from rl_yardstick.diagnosis.composite_world import BETTER, END, GAMMA, STORIES, Steps
from rl_yardstick.diagnosis.subjects import KINDS, CannotTrain, Subject
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import UserError

State = Literal["right", "wrong", "unreadable"]


@dataclass(frozen=True)
class Verdict:
    """The result of an audit."""

    subject: str
    state: State
    fault: str = ""  #: its name; empty if none is near enough, or if it is right
    target: str = ""  #: the backup that was measured, in words
    notes: tuple[str, ...] = ()  #: what the verdict rests on
    unseen: str = ""  #: what the audit cannot see of such a program
    measured: Measured | None = None  #: None if it cannot be read

    @property
    def exit_code(self) -> int:
        """0 if right, 1 for a fault, 2 if it cannot be read."""
        return ("right", "wrong", "unreadable").index(self.state)

    def lines(self) -> list[str]:
        """The verdict in a few lines: first the backup, as measured."""
        first = [self.target] if self.target else []
        if self.state == "right":
            rest = f"targets and choices right; not seen: {self.unseen}" if self.unseen else "right"
            return [*first, rest, *self.notes]
        name = f"fault: {self.fault}" if self.fault else "wrong: no known fault is near"
        return [*first, name if self.state == "wrong" else "cannot be read", *self.notes]

    def as_json(self) -> dict[str, Any]:
        """The verdict as JSON."""
        words = {"right": "right", "wrong": "fault", "unreadable": "nothing can be said"}
        return {
            "algorithm": self.subject,
            "verdict": words[self.state],
            "measured": self.measured and self.measured._asdict(),
            "notes": [*self.notes],
            "fault": self.fault or None,
            "target": self.target,
            "not_seen": self.unseen,
        }


def audit(subject: Subject, seeds: int = 0) -> Verdict:
    """Audit an algorithm.

    A subclass of the library's DQN, PPO or A2C is asked for one update, which is compared exactly.
    All else, and a subclass whose update is like no formula's, is trained in the composite world,
    with each of ``seeds`` seeds (default: 3 for a table, 2 for a network), and its values are
    compared with those to which each formula leads.
    """
    from rl_yardstick.diagnosis.one_update import audit_update

    try:
        with warnings.catch_warnings():  # of the program that is audited
            warnings.simplefilter("ignore")
            found = audit_update(subject)
            if found is None:
                return _ByValues(subject, seeds).verdict()
            told, (fault, note) = found
            if note and not fault:  # perhaps it learns by a rule of its own
                by_values = _ByValues(subject, seeds, has_own_rule=True).verdict()
                if by_values.state == "right":
                    return replace(by_values, notes=(f"{note}; what it learns is right",))
        state: State = "wrong" if note else "right"
        return Verdict(subject.name, state, fault, told.words(), (note,) * bool(note), "", told)
    except CannotTrain as error:
        return Verdict(subject.name, "unreadable", notes=(f"it cannot train here: {error}",))


# --- by values after training ---------------------------------------------------------------------

VISITS = 40  # of a cell whose value counts
OF_ONE_STEP = ("next-value-is-", "follows-", "maximises-")  # faults, not of traces and the like
LENGTHS = (1, 2, 4)  # of trainings, until values have settled
RATES = re.compile(r"(eps|exploration)(?!.*(decay|frac|step))", re.I)  # settings by their names
ROLLOUTS = ("n", "n_step", "n_steps", "num_steps", "rollout", "rollout_length", "rollout_steps")


class Near(NamedTuple):
    """How far a formula's values are from those learnt, in tolerances."""

    rms: float
    worst: float
    name: str


class _Training(NamedTuple):
    """The values that one seed learnt, and the log."""

    values: Floats
    first: Floats
    steps: Steps
    act: Callable[[int], int]


def nearest(trainings: Sequence[_Training], rule: str) -> tuple[Near, list[Near]]:
    """The right formula, and all, the nearest first: differences are averaged over seeds."""
    sums: dict[str, Floats] = {}
    for one in trainings:
        uses = (one.steps.counts(one.values.size) >= VISITS).astype(float)
        uses[END] = 0.0
        for found in candidates(one.steps, rule, one.values, one.first):
            tolerance = 0.08 + 0.05 * np.abs(found.values) + 0.35 * found.spread
            parts = uses * [one.values - found.values, tolerance, np.ones_like(uses)]
            sums[found.name] = sums.get(found.name, 0.0) + parts
    ranking = {}
    for name, (difference, tolerance, uses) in sums.items():
        is_used = uses > 0
        if not is_used.any():
            raise UserError(f"no state was visited {VISITS} times: it trained for too few steps")
        z = np.abs(difference[is_used] / tolerance[is_used])
        ranking[name] = Near(float(np.sqrt(np.mean(z**2))), float(z.max()), name)
    return ranking[RIGHT], sorted(ranking.values())


@dataclass
class _ByValues:
    """The audit of a program that is trained in the composite world."""

    subject: Subject
    n_seeds: int = 0
    has_own_rule: bool = False  # then settings need not mean what their names say

    def verdict(self) -> Verdict:
        """Train longer until the values have settled, and compare them."""
        start = self.subject.train(1, 1).values
        if start is None:
            return Verdict(self.subject.name, "unreadable", notes=(NO_VALUES,))
        self.is_table = is_table(start)
        self.length = length = 6800 if self.is_table else 8500
        n_seeds, before, last = self.n_seeds or (3 if self.is_table else 2), np.inf, np.inf
        for times in LENGTHS[:2] if self.has_own_rule else LENGTHS:
            trainings = self._trainings(times * length, n_seeds)
            if not np.isfinite([one.values for one in trainings]).all():
                return Verdict(self.subject.name, "wrong", notes=("its values are not finite",))
            rule, right, near = self._by_rules(trainings)
            found = self._judged(trainings, rule, right, near)
            if found.state == "right" or found.fault or right.rms > 0.9 * before:
                return found
            before, last = right.rms, before
        if before < 0.7 * last:
            note = f"its values still change after {LENGTHS[-1] * length:,} steps: it learns slowly"
            return replace(found, state="unreadable", notes=(note,))
        return found

    def _trainings(self, n: int, n_seeds: int, /, **changes: Any) -> list[_Training]:
        found = []
        for seed in range(1, 1 + n_seeds):
            trained, begun = (self.subject.train(steps, seed, **changes) for steps in (n, 3))
            assert trained.values is not None
            assert begun.values is not None
            steps = reduce(Steps.joined, [Steps(log, late=0.35) for log in trained.logs])
            found.append(_Training(trained.values, begun.values, steps, trained.act))
        return found

    def _by_rules(self, trainings: Sequence[_Training]) -> tuple[str, Near, list[Near]]:
        """The rule of the next value, the nearest right one if the kind is not known."""
        rule = KINDS.get(self.subject.kind or "", "")
        rules = [rule] if rule in RULES else ["largest", "next", "expected"]
        if trainings[0].values.shape[1] == 1:
            rules = ["states"]
        ranked = [(rule, *nearest(trainings, rule)) for rule in rules]
        return min(ranked, key=lambda each: each[1].rms)

    def _judged(
        self, trainings: Sequence[_Training], rule: str, right: Near, near: list[Near]
    ) -> Verdict:
        one = trainings[-1]
        backup = measured(one.values, one.steps, rule)
        verdict = partial(Verdict, self.subject.name, target=backup.words(), measured=backup)
        if all((each.values == each.first).all() for each in trainings):
            return verdict("wrong", "does-not-learn", notes=("its values stay as they were",))
        if right.rms <= 0.5 and right.worst <= 3 and right.rms <= near[0].rms + 0.1:
            for fault, note in self._other_faults(trainings, rule):
                return verdict("wrong", fault, notes=(note,))
            unseen = UNSEEN_OF_ACTORS if rule == "states" else UNSEEN
            return verdict("right", unseen="" if self.is_table else unseen)
        tight = 0.25 if self.is_table else 0.5
        is_tight = near[0].rms <= tight and near[0].worst <= 4 * tight
        alike = {fault_of(each.name): 0 for each in near if each.rms < near[0].rms + 0.02}
        fault = " or ".join(alike)  # values that cannot be told apart
        other = next(each for each in near if fault_of(each.name) not in alike)
        told = f"{fault} at {near[0].rms:.2f}, {fault_of(other.name)} at {other.rms:.2f}"
        note = f"nearest in tolerances: {told}; right at {right.rms:.2f}"
        if fault == RIGHT and not any(backup.off()):  # it is too noisy, or learns too slowly
            return verdict("unreadable", notes=(note,))
        is_named = is_tight and other.rms > 1.9 * near[0].rms and RIGHT not in alike
        is_named &= len(alike) < 3
        is_named &= self.subject.is_one_step or not fault.startswith(OF_ONE_STEP)
        return verdict("wrong", fault if is_named else "", notes=(note,))

    def _other_faults(self, trainings: Sequence[_Training], rule: str) -> Iterator[Found]:
        """Faults that leave the values right."""
        yield from _choices(trainings)
        if self.is_table:
            yield from _credit(self.subject)
        if not self.has_own_rule:
            with suppress(CannotTrain):  # it may not be made for other settings
                yield from self._with_other_settings(rule)

    def _with_other_settings(self, rule: str) -> Iterator[Found]:
        """What it does without exploration, and with rollouts of two steps, if it has settings."""
        rates = {name: 1e-9 for name in self.subject.parameters if RATES.match(name)}
        length = self.subject.named(*ROLLOUTS)
        if rates and rule != "states":
            [(q, _, d, _)] = self._trainings(self.length // 2, 1, **rates)
            is_clear = (d.weight > 0) & (np.ptp(q, axis=1)[d.state] > 0.3)
            share = float(np.mean((q[d.state, d.action] < q.max(axis=1)[d.state])[is_clear]))
            if share > 0.25:
                told = f"{share:.0%} of its actions are not its best"
                yield "exploration-inverted", f"with {' and '.join(rates)} at 0, {told}"
        if length:
            [(q, _, d, _)] = short = self._trainings(self.length, 1, **{length: 2})
            found = measured(q, d, rule)
            if nearest(short, rule)[0].rms > 1 and any(found.off()):
                yield "", f"with {length} at 2, {found.words()}"


ACTS_WORSE = "advantage-sign or ratio-inverted"  # from outside they are the same
UNSEEN = "minibatches, the loss's form, schedules"
UNSEEN_OF_ACTORS = "the trace, normalisation, clipping, minibatches"
NO_VALUES = "add the method values(obs): a list with a number for each action, or the state's value"


def _choices(trainings: Sequence[_Training]) -> Iterator[Found]:
    """What it does where one action pays more: an actor late in training, others when asked."""
    if trainings[0].values.shape[1] == 1:
        steps = [one.steps for one in trainings]
        hits = [(d.action == d.better)[(d.weight > 0) & (d.better >= 0)] for d in steps]
        share = float(np.mean(np.concatenate(hits)))
        if share <= 0.6:
            told = f"late in training it does the action that pays more in {share:.0%}"
            yield ACTS_WORSE if share < 0.35 else "", told
        return
    asked = [
        np.mean([one.act(state) == BETTER[state] for _ in range(200)])
        for one in trainings
        for state in (13, 14)
    ]
    low, high = min(asked), max(asked)
    if low <= 0.99:
        fault = "acts-by-the-worst-value" if high < 0.03 else "explores-in-evaluation"
        if {*asked} <= {0.0, 1.0} and high:
            fault = ""  # it is wrong in some states, and explores in none
        shares = f"{low:.0%} to {high:.0%} of 200 times"
        yield fault, f"it does the action that pays in {shares}, when evaluated"


def _credit(subject: Subject) -> Iterator[Found]:
    """What the reward of one step changes: nothing of an earlier episode, nothing by chance."""
    name = subject.named("trace_decay", "lam", "lambda_", "lmbda")
    decay = {} if name is None else {name: 0.5}

    def changed(n: int, step: int, seed: int = 1) -> Floats:
        values = [subject.train(n, seed, bump, **decay).values for bump in (step, -1)]
        found: Floats = np.abs(np.subtract(*map(np.asarray, values))).max(axis=1)
        return found

    if changed(25, 10**9).max() > 0:
        yield "not-reproducible", "two trainings with the same seed differ"
    if len(subject.train(10, 1).logs) != 1:  # of copies it is not known which one is first
        return
    starts = np.cumsum([len(story.states) for story in STORIES[:4]]).tolist()
    for first, end in pairwise(starts):
        change = changed(end, first)
        earlier = {row[0] for row in subject.train(end, 1).logs[0][:first]}
        if leak := sorted(earlier & set(np.flatnonzero(change > 1e-9).tolist())):
            text = f"the reward of step {first + 1}, the first of an episode, changes state "
            text += f"{leak[-1]} of an earlier one by {change[leak[-1]]:.3f}"
            yield "traces-not-reset", text
    *_, before, last = STORIES[1].states
    back = [changed(starts[1], starts[1] - 1, seed) for seed in range(1, 7)]
    shares = [change[before] / change[last] for change in back if change[last]]
    if decay and shares and abs(max(shares) - 0.5 * GAMMA) > 0.01:
        text = f"credit fades to {max(shares):.2f} with a step back at lambda 0.5"
        yield "trace-decay", f"{text}; right would be {0.5 * GAMMA:g}"
