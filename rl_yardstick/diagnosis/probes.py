"""The probes: each compares tiny worlds, or settings, that differ in one thing.

The values of a correct learner do not depend on that thing, or change by a known amount. Single
values only describe. Each probe yields `Finding` objects; the names of faults are in
`diagnosis.faults`.
"""

from __future__ import annotations

import random
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rl_yardstick.diagnosis.probe_worlds import N_ACTIONS, Record, World
from rl_yardstick.diagnosis.subjects import GAMMA, ClassSubject, Subject, Trained, TrainedModel
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import one_line

State = Literal["ok", "fault", "unsaid", "skipped"]


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    probe: str  # the name of the check
    state: State
    text: str = ""  # what was measured, or why nothing can be said
    fault: str = ""  # a key of FAULTS
    right: str = ""  # the correct result


class NotSettled(Exception):  # noqa: N818 (not an error)
    """Values after n and after 2n steps still differ at the largest number of steps."""


CHAIN = World(((0, 0), (1, 1)))
SEES_START = World(((0, 0), (1, 1)), end_shows=0)
START_PAYS = World(((5, 5), (1, 1)))
END_PAYS_MORE = World(((0, 0), (2, 2)))
LOOP = World(((0, 0), (1, 1)), ends=False, cut=4)
LOOP_START_PAYS = World(((5, 5), (1, 1)), ends=False, cut=4)
LONG_LOOP = World(((0, 0), (1, 1)), ends=False, cut=40)
SAFE_FORK = World(((0, 0), (1, 0)))
DEAR_FORK = World(((0, 0), (1, -4)))
ARM_0, ARM_1 = World(((1, 0),)), World(((0, 1),))
EQUAL_ARMS = World(((0, 0),))
COIN = World(((0, 0),), noise=1.0)
STAIRS = World(((0.5, 0.5), (0, 0), (1, 1), (0, 0), (1, 1)))
MOST_DOUBLINGS = 3


@dataclass
class Lab:
    """Trains one subject with one seed, and caches the values that have settled."""

    subject: Subject
    seed: int
    _values: dict[Any, Floats | None] = field(default_factory=dict)

    def begin(self, world: World, steps: int | None = None, **changes: Any) -> Trained:
        """Train for some steps."""
        steps = self.subject.steps if steps is None else steps
        return self.subject.begin(world, self.seed, steps, changes)

    def settled(self, world: World, **changes: Any) -> Floats:
        """The values of all states, shape (S,), once they no longer change.

        Raises:
            NotSettled: if they go on changing.
        """
        known = {**self.subject.base, **self.subject.typed}
        changes = {name: value for name, value in changes.items() if known.get(name) != value}
        key = world, tuple(sorted(changes.items()))
        if key not in self._values:
            self._values[key] = self._settle(world, changes)
        values = self._values[key]
        if values is None:
            raise NotSettled(f"values did not settle within {self._limit():,} steps")
        return values

    def _limit(self) -> int:
        return int(self.subject.steps * 2**MOST_DOUBLINGS)

    def _settle(self, world: World, changes: Mapping[str, Any]) -> Floats | None:
        steps = self.subject.steps
        trained = self.begin(world, steps, **changes)
        before = trained.state_values()
        while before is not None and np.isfinite(before).all() and steps < self._limit():
            trained.train(steps)
            steps *= 2
            values = trained.state_values()
            assert values is not None
            if np.abs(values - before).max() <= 0.05 * max(1.0, np.abs(values).max()):
                return values
            before = values
        return None

    def mean(self, world: World, n: int = 10, **changes: Any) -> tuple[Floats, float]:
        """Mean values in the second half of training, (S,), and action 1's share in the last state.

        For learners whose values depend on the actions taken, and so never settle.
        """
        steps = self.subject.steps
        trained = self.begin(world, steps, **changes)
        readings = []
        for _ in range(n if isinstance(self.subject, ClassSubject) else 1):
            trained.train(steps // n if isinstance(self.subject, ClassSubject) else steps)
            readings.append(trained.state_values())
        counts = trained.record.counts()[-1]
        share = counts[1] / counts.sum() if counts.sum() else 0.5
        return np.mean(np.array(readings), axis=0), float(share)


# --- targets --------------------------------------------------------------------------------------


def probe_ends(lab: Lab) -> Iterator[Finding]:
    """The observation at the end has no value, and the next episode does not count."""
    name = "the end of an episode"
    plain, seeing = lab.settled(CHAIN), lab.settled(SEES_START)
    shown = f"the last state is worth {plain[1]:.2f}"
    seen = f"{shown}, and {seeing[1]:.2f} where the end looks like the start"
    if abs(seeing[1] - plain[1]) > 0.25:
        yield Finding(name, "fault", seen, "bootstraps-at-terminal", "1 in both")
        return
    paid = lab.settled(START_PAYS)
    if abs(paid[1] - plain[1]) > 0.25:
        text = f"{shown}, and {paid[1]:.2f} where the first step of an episode pays 5"
        is_mixed_up = paid[0] - plain[0] < 2.5
        fault = "shared-buffer" if is_mixed_up else "bootstraps-at-terminal"
        if is_mixed_up:
            text += f"; the first state's own value changes by {paid[0] - plain[0]:.2f}"
        yield Finding(name, "fault", text, fault, "1 in both; the first state's changes by 5")
    elif abs(plain[1] - 1) > 0.25:
        yield Finding(name, "unsaid", f"{shown} and not 1: no fault known here explains it")
    else:
        yield Finding(name, "ok", seen)


def probe_discount(lab: Lab) -> Iterator[Finding]:
    """Where the end pays 1 more, the state before it is worth gamma more."""
    name = "the discount"
    less, more = lab.settled(CHAIN), lab.settled(END_PAYS_MORE)
    gain = float(more[1] - less[1])
    if gain < 0.5:
        yield Finding(name, "unsaid", f"a reward that is higher by 1 adds {gain:.2f} to its state")
        return
    seen = float(more[0] - less[0]) / gain
    text = f"a state's value grows by {seen:.2f} where that of the next grows by 1"
    fault = ""
    if abs(seen - GAMMA**2) < 0.08:
        fault = "discount-twice"
    elif abs(seen - 1) < 0.1:
        fault = "discount-missing"
    elif abs(seen) < 0.3 and has_target(lab.subject):
        fault = "target-never-copied"
    if fault:
        yield Finding(name, "fault", text, fault, f"gamma, which is {GAMMA}")
    elif abs(seen - GAMMA) > 0.08:
        yield Finding(name, "unsaid", f"{text} and not by {GAMMA}: no fault known here explains it")
    else:
        yield Finding(name, "ok", text)


def probe_cuts(lab: Lab) -> Iterator[Finding]:
    """Neither a time limit nor the start of the next episode changes a value."""
    name = "an episode that is cut off"
    cut = lab.settled(LOOP)
    text = f"a state that pays 1 for ever is worth {cut[1]:.2f}"
    right = f"{1 / (1 - GAMMA):g} in both"
    paid = lab.settled(LOOP_START_PAYS)
    if abs(paid[1] - cut[1]) > 1:
        text += f", and {paid[1]:.2f} where the first step of an episode pays 5"
        yield Finding(name, "fault", text, "reset-observation", right)
        return
    long = lab.settled(LONG_LOOP)
    text += f" under a limit of 4 steps, and {long[1]:.2f} under one of 40"
    if long[1] - cut[1] > 0.8:
        yield Finding(name, "fault", text, "no-bootstrap-at-truncation", right)
    elif abs(cut[1] * (1 - GAMMA) - 1) > 0.2:
        yield Finding(name, "unsaid", f"{text} and not {right}: no fault known here explains it")
    else:
        yield Finding(name, "ok", text)


def probe_next_action(lab: Lab) -> Iterator[Finding]:
    """The cost of a bad action lowers targets that follow the policy, not those that maximise."""
    name, target = "the next action", lab.subject.target
    if target is None:
        yield Finding(name, "skipped", "say what it claims to be: --kind q_learning or sarsa")
        return
    if target == "states" or lab.subject.spaces[1] == "box":
        yield Finding(name, "skipped", "it has no values of two actions")
        return
    safe, _ = lab.mean(SAFE_FORK)
    dear, share = lab.mean(DEAR_FORK)
    seen, expected = float(safe[0] - dear[0]), GAMMA * 4 * share
    text = (
        f"a state's value falls by {seen:.2f} where an action after it, done {share:.0%} of the "
        "time, costs 4 more"
    )
    if expected < 0.3:
        text = f"the bad action is done in {share:.0%} of the visits only: let it explore more"
        yield Finding(name, "unsaid", text)
    elif target == "maximises" and seen > 0.5 * expected:
        fault = "importance-ratio" if lab.subject.uses_ratio else "follows-instead-of-maximises"
        yield Finding(name, "fault", text, fault, "0")
    elif target == "follows" and seen < 0.25 * expected:
        fault = "maximises-instead-of-follows"
        yield Finding(name, "fault", text, fault, f"about {expected:.2f}")
    else:
        yield Finding(name, "ok", text)


def probe_ratio(lab: Lab) -> Iterator[Finding]:
    """Off-policy returns are weighted; PPO's clipping bounds the policy change of one rollout."""
    name, subject = "the importance ratio", lab.subject
    if subject.uses_ratio:
        whole = lab.settled(World(((0, 0), (1, 0))))
        half = lab.settled(World(((0, 0), (1, 0)), quits=0.5))
        share = float(half[0] / max(whole[0], 1e-9))
        text = f"a state that half of the time ends at once keeps {share:.2f} of its value"
        is_right = abs(share - 0.5) < 0.08
        fault = "" if is_right else "importance-ratio"
        yield Finding(name, "ok" if is_right else "fault", text, fault, "0.50")
        return
    if not all(map(subject.accepts, ("clip_range", "n_epochs", "n_steps", "batch_size"))):
        return
    moved = []
    for clip_range in (0.2, 0.5):
        once = {"n_steps": 64, "batch_size": 64, "n_epochs": 150, "learning_rate": 1e-3}
        trained = lab.begin(ARM_0, 64, clip_range=clip_range, **once)
        moved.append(share_of_action(trained, 0))
    text = (
        f"one rollout moves a probability from about 0.5 to {moved[0]:.2f} where the ratio is "
        f"clipped at 1.2, and to {moved[1]:.2f} where at 1.5"
    )
    low, high = moved
    if high < 0.15 or (high > 0.5 and (high > 0.92 or low > 0.75)):
        yield Finding(name, "fault", text, "importance-ratio", "to 0.6, and to 0.75")
    elif 0.5 < low < high:
        yield Finding(name, "ok", text)
    else:
        yield Finding(name, "unsaid", text)


def share_of_action(trained: Trained, action: int) -> float:
    """The share of an action among 2,000 that training would draw in state 0."""
    assert isinstance(trained, TrainedModel)
    return float((trained.drawn_actions(0, 2000) == action).mean())


# --- stored data ----------------------------------------------------------------------------------


def probe_age(lab: Lab) -> Iterator[Finding]:
    """Old rewards that have changed since are forgotten."""
    name, subject = "the age of training data", lab.subject
    if not (subject.accepts("buffer_size") or subject.is_on_policy):
        return
    steps = subject.steps
    changes = {"buffer_size": steps // 2} if subject.accepts("buffer_size") else {}
    late = World(((0, 0), (1, 1)), pays_after=steps)
    always = lab.settled(CHAIN)
    trained = lab.begin(late, 3 * steps, **changes)
    values = trained.state_values()
    assert values is not None
    text = (
        f"a state that pays only after {steps:,} steps is worth {values[1]:.2f} after "
        f"{3 * steps:,}, and one that always pays {always[1]:.2f}"
    )
    buffer = getattr(getattr(trained, "model", None), "rollout_buffer", None)
    if always[1] - values[1] > 0.25:
        yield Finding(name, "fault", text, "stale-buffer", "the same")
    elif buffer is not None and not _is_last(np.ravel(buffer.actions), trained.record.actions):
        text = "the last rollout that was learnt from is not the last one that was collected"
        yield Finding(name, "fault", text, "stale-buffer", "the same actions")
    else:
        yield Finding(name, "ok", text)


def _is_last(kept: Floats, done: list[int]) -> bool:
    return np.array_equal(kept.astype(int), np.array(done[-len(kept) :]))


def probe_copies(lab: Lab) -> Iterator[Finding]:
    """An environment may return the same array each time, and change it in place."""
    name, subject, numbered = "observations that change in place", lab.subject, lab
    if subject.spaces[0] == "discrete" and isinstance(subject, ClassSubject):
        if not subject.has_network:
            return
        subject = copy(subject)
        subject.spaces = "box", subject.spaces[1]
        if subject.misfit():
            return
        lab = Lab(subject, lab.seed)
    elif subject.spaces[0] == "discrete":
        return
    in_place = World(CHAIN.pays, in_place=True)
    copied = numbered.settled(CHAIN)
    if not _is_right(CHAIN, copied):
        yield Finding(name, "skipped", "values are wrong with copies already")
        return
    shared = lab.settled(in_place)
    text = f"values are {_told(copied)} with copies, and {_told(shared)} without"
    if np.abs(copied - shared).max() > 0.25:
        yield Finding(name, "fault", text, "shared-buffer", "the same")
        return
    in_place = World(LOOP.pays, ends=False, cut=LOOP.cut, in_place=True)
    copied, shared = numbered.settled(LOOP), lab.settled(in_place)
    text = f"under a time limit values are {_told(copied)} with copies, and {_told(shared)} without"
    is_same = np.abs(copied - shared).max() <= 0.8
    if not is_same and not isinstance(subject, ClassSubject):
        yield Finding(name, "fault", text, "shared-buffer", "the same")
    elif not is_same:
        text += ": that is the library's DummyVecEnv, which keeps no copy of an episode's last "
        yield Finding(name, "ok", f"{text}observation, and not this agent")
    else:
        yield Finding(name, "ok", text)


def _is_right(world: World, values: Floats) -> bool:
    return bool(np.abs(values - world.values(GAMMA)).max() < 0.25)


def _told(values: Floats) -> str:
    return " and ".join(f"{value:.2f}" for value in values)


def has_target(subject: Subject) -> bool:
    """Whether the subject has a target network whose updates can be set."""
    if isinstance(subject, ClassSubject) and "DeepQLearning" in {
        ancestor.__name__ for ancestor in subject.cls.__mro__
    }:
        return False
    return subject.accepts("target_update_interval") or subject.accepts("tau")


def probe_target_network(lab: Lab) -> Iterator[Finding]:
    """A target network that is never updated passes on nothing that is learnt."""
    name, subject = "the target network", lab.subject
    if not has_target(subject):
        return
    # The library's SAC restarts the interval in each call of train: with one gradient step it
    # always updates.
    settings = {"target_update_interval": 10**9, "tau": 1e-9}
    if subject.target != "maximises":
        settings = {"tau": 1e-9}
    for setting in filter(subject.accepts, settings):
        change = {setting: settings[setting]}
        less, more = lab.settled(CHAIN, **change), lab.settled(END_PAYS_MORE, **change)
        seen = float(more[0] - less[0])
        text = f"with {setting} {settings[setting]:g}, an end that pays 1 more adds {seen:.2f}"
        if abs(seen) > 0.35:
            yield Finding(name, "fault", text, "target-always-copied", "0")
            return
    yield Finding(name, "ok", text)


# --- several steps --------------------------------------------------------------------------------


def probe_n_steps(lab: Lab) -> Iterator[Finding]:
    """Values are the same whatever the number of steps of a target."""
    name, subject = "targets of several steps", lab.subject
    if not subject.accepts("n_steps") or (subject.is_on_policy and subject.accepts("n_epochs")):
        return
    if not isinstance(subject, ClassSubject) and subject.target == "states":
        return  # it may mean the length of a rollout
    if subject.is_on_policy and "A2C" not in {kind.__name__ for kind in subject_mro(subject)}:
        return
    one = lab.settled(STAIRS, n_steps=1)
    if not _is_right(STAIRS, one):
        yield Finding(name, "skipped", "values are wrong with one step already")
        return
    several = lab.settled(STAIRS, n_steps=3)
    text = f"values are {_told(one)} with one step, and {_told(several)} with 3"
    if np.abs(one - several).max() > 0.2:
        right = " and ".join(f"{value:.2f}" for value in STAIRS.values(GAMMA))
        yield Finding(name, "fault", text, "n-step-return", right)
        return
    cut, several = lab.settled(LOOP, n_steps=1), lab.settled(LOOP, n_steps=3)
    if abs(cut[1] - several[1]) > 0.8:
        text = (
            f"a state that pays 1 for ever is worth {cut[1]:.2f} with one step, and "
            f"{several[1]:.2f} with 3, under a limit of 4"
        )
        yield Finding(name, "fault", text, "n-step-return", f"{1 / (1 - GAMMA):g} in both")
    else:
        yield Finding(name, "ok", text)


def subject_mro(subject: Subject) -> tuple[type, ...]:
    """The class and base classes of a subject; empty for a script."""
    return subject.cls.__mro__ if isinstance(subject, ClassSubject) else ()


def probe_traces(lab: Lab) -> Iterator[Finding]:
    """Credit decays by gamma times lambda with each step back, and ends with the episode."""
    name, subject = "traces", lab.subject
    if subject.is_on_policy and isinstance(subject, ClassSubject) and subject.accepts("gae_lambda"):
        yield from _probe_advantages(lab)
    if not subject.accepts("trace_decay"):
        return
    decay, once = 0.5, {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}
    stairs = World(((0, 0), (0, 0), (1, 1)))
    first = _highest(lab.begin(stairs, 3, trace_decay=decay, learning_rate=0.5, **once))
    ratio = first[1] / first[2] if first[2] else np.nan
    text = f"after one episode a state's value is {ratio:.2f} times that of the next state"
    right = f"gamma x lambda, which is {GAMMA * decay:g}"
    if not abs(ratio - GAMMA * decay) < 0.05 or abs(first[0] - ratio**2 * first[2]) > 0.05:
        yield Finding(name, "fault", text, "traces", right)
        return
    paying = World(((5, 5), (0, 0), (1, 1)))
    later = _highest(lab.begin(paying, 4, trace_decay=decay, learning_rate=0.5, **once))
    if abs(later[2] - first[2]) > 0.05:
        text = f"the next episode's first reward changes the last state from {first[2]:.2f} to "
        yield Finding(name, "fault", f"{text}{later[2]:.2f}", "traces", "it changes nothing")
        return
    if subject.target == "maximises":
        fork, changes = World(((0, 0), (1, -1), (1, 1))), stepwise(subject)
        trained = lab.begin(fork, 24, trace_decay=decay, learning_rate=0.5, **changes)
        values, record = trained.values(), trained.record
        if values is not None and record.actions:
            uncut = watkins_table(fork, record, decay, is_cut=False)
            if np.allclose(values, uncut) and not np.allclose(
                uncut, watkins_table(fork, record, decay, is_cut=True)
            ):
                text = "the table after 8 episodes is that of traces that exploration does not cut"
                yield Finding(name, "fault", text, "traces", "that of traces that it cuts")
                return
    yield Finding(name, "ok", text)


def stepwise(subject: Subject) -> dict[str, str]:
    """Settings under which an agent of ours calls its environment at each step."""
    is_ours = isinstance(subject, ClassSubject) and "interpreted" in subject.engines
    return {"engine": "interpreted"} if is_ours and "engine" not in subject.typed else {}


def watkins_table(world: World, record: Record, decay: float, *, is_cut: bool) -> Floats:
    """The table of Watkins's Q(lambda) after the steps of a record; ties are all best."""
    table, traces = np.zeros((2, world.n_states, N_ACTIONS))
    steps = zip(record.states, record.actions, record.rewards, strict=True)
    for state, action, reward in steps:
        if state == 0 or (is_cut and table[state, action] < table[state].max()):
            traces[:] = 0
        else:
            traces *= GAMMA * decay
        goes_on = state + 1 < world.n_states
        ahead = GAMMA * table[state + 1].max() if goes_on else 0.0
        error = reward + ahead - table[state, action]
        traces[state, action] = 1
        table += 0.5 * error * traces
    return table


def _highest(trained: Trained) -> Floats:
    values = trained.values()
    assert values is not None
    highest: Floats = values.max(axis=1)
    return highest


def _probe_advantages(lab: Lab) -> Iterator[Finding]:
    """Compare the advantages in the rollout buffer with the sum that defines them."""
    name, found = "advantages of rollouts", {}
    for decay in (0.0, 0.9):
        trained = lab.begin(STAIRS, 128, gae_lambda=decay, n_steps=64)
        assert isinstance(trained, TrainedModel)
        buffer: Any = getattr(trained.model, "rollout_buffer", None)
        if not hasattr(buffer, "advantages"):
            yield Finding(name, "skipped", "it has no rollout buffer of the library's")
            return
        keys = ("rewards", "values", "episode_starts", "advantages")
        rewards, values, starts, kept = (np.ravel(getattr(buffer, key)) for key in keys)
        begins = np.flatnonzero(starts)
        whole = slice(begins[0], begins[-1])
        exact = np.zeros(len(rewards))
        for t in range(begins[-1] - 1, begins[0] - 1, -1):
            goes_on = 1.0 - starts[t + 1]
            error = rewards[t] + GAMMA * goes_on * values[t + 1] - values[t]
            exact[t] = error + GAMMA * decay * goes_on * exact[t + 1]
        found[decay] = float(np.abs(kept - exact)[whole].max())
    text = f"advantages of a rollout are off by {found[0.9]:.3f} at most, with lambda 0.9"
    if found[0.9] < 1e-3:
        yield Finding(name, "ok", text)
    elif found[0.0] < 1e-3:
        yield Finding(name, "fault", f"{text}, and right with 0", "traces", "0")
    else:
        yield Finding(name, "unsaid", f"{text}, and by {found[0.0]:.3f} with 0")


# --- policies -------------------------------------------------------------------------------------


def probe_choice(lab: Lab) -> Iterator[Finding]:
    """The agent learns the action that pays, and always takes it in evaluation."""
    name = "what it does when evaluated"
    trained = [lab.begin(world) for world in (ARM_0, ARM_1)]
    chosen = [_share(each, 400) for each in trained]
    text = (
        f"it does action 1 in {chosen[0]:.1%} of 400 where 0 pays, in {chosen[1]:.1%} where 1 does"
    )
    right = "0 % and 100 %"
    if chosen[0] > 0.6 and chosen[1] < 0.4:  # the reverse of what pays
        if lab.subject.target == "states" or lab.subject.target is None:
            yield Finding(name, "fault", text, "advantage-sign", right)
        else:
            yield Finding(name, "unsaid", f"{text}: no fault known here explains it")
    elif all(0 < share < 1 for share in chosen) or (
        chosen[0] < 0.4 and chosen[1] > 0.6 and chosen != [0, 1]
    ):
        yield Finding(name, "fault", text, "explores-in-evaluation", right)
    elif chosen == [0, 1]:
        yield Finding(name, "ok", text)
    else:
        yield Finding(name, "unsaid", text)


def _share(trained: Trained, n: int) -> float:
    return float(np.mean([trained.act(0) for _ in range(n)]))


def probe_entropy(lab: Lab) -> Iterator[Finding]:
    """Without rewards, the entropy term keeps the policy random."""
    name, subject = "the entropy term", lab.subject
    if not (subject.accepts("ent_coef") and isinstance(subject, ClassSubject)):
        return
    spreads = []
    for weight in (1e-3, 0.5):
        trained = lab.begin(EQUAL_ARMS, ent_coef=weight)
        assert isinstance(trained, TrainedModel)
        spreads.append(float(trained.drawn_actions(0, 1000).std()))
    text = (
        f"actions vary by {spreads[0]:.2f} with a weight of 0.001, and by {spreads[1]:.2f} with 0.5"
    )
    if spreads[1] < 0.3 and spreads[1] < spreads[0]:
        yield Finding(name, "fault", text, "entropy-sign", "about 0.5 in both")
    else:
        yield Finding(name, "ok", text)


# --- schedules ------------------------------------------------------------------------------------


def probe_schedules(lab: Lab) -> Iterator[Finding]:
    """Schedules that fall do fall in the course of training, and those that rise do rise."""
    subject = lab.subject
    if not isinstance(subject, ClassSubject):
        yield from _probe_exploration(lab)
        return
    from stable_baselines3.common.utils import LinearSchedule

    rate = {**subject.base, **subject.typed}.get("learning_rate", 0.1)
    if subject.accepts("value_step_size"):
        text = "values have a step size of their own, which has no schedule"
        yield Finding("the schedule of the learning rate", "skipped", text)
    elif subject.accepts("learning_rate") and isinstance(rate, float) and not subject.uses_ratio:
        name = "the schedule of the learning rate"
        rate /= 10 if subject.is_on_policy else 1  # or each rollout is overfitted
        falling = _moves(lab, LinearSchedule(rate, rate / 20, 1.0))
        rising = _moves(lab, LinearSchedule(rate / 20, rate, 1.0))
        if falling is None or rising is None:
            yield Finding(name, "unsaid", "values do not move with random rewards")
        else:
            early, late = np.array(falling) / np.array(rising)
            text = (
                f"values move {early:.2f} times as much where it falls to a twentieth as where it "
                f"rises from there, early in training, and {late:.2f} times late"
            )
            fault = "schedule-backwards" if early < 0.8 else "schedule-constant"
            state: State = "ok" if late < 0.6 else "fault"
            right = "more than once, and less than once"
            yield Finding(name, state, text, "" if state == "ok" else fault, right)
    yield from _probe_exploration(lab)


def _moves(lab: Lab, schedule: Any) -> tuple[float, float] | None:
    """How much values move from one reading to the next, early in a training and late."""
    from stable_baselines3.common.callbacks import BaseCallback

    subject = lab.subject
    assert isinstance(subject, ClassSubject)
    trained = TrainedModel(subject, COIN, lab.seed, {"learning_rate": schedule})
    rollout = int({**subject.base, **subject.typed}.get("n_steps", 1))
    every = max(20, rollout) if subject.is_on_policy else 20

    class Reader(BaseCallback):
        readings: list[Floats] = []  # noqa: RUF012 (one reader, one list)

        def _on_step(self) -> bool:
            if self.n_calls % every == 0 and (values := trained.values()) is not None:
                self.readings.append(values)
            return True

    reader = Reader()
    reader.readings = []
    trained.train(max(2 * subject.steps, 24 * every), reader)
    if len(reader.readings) < 16:
        return None
    moves = np.abs(np.diff(np.array(reader.readings), axis=0)).mean(axis=(1, 2))
    n = len(moves)
    early, late = moves[: n // 6].mean(), moves[-n // 4 :].mean()
    return (float(early), float(late)) if min(early, late) > 1e-9 else None


def _probe_exploration(lab: Lab) -> Iterator[Finding]:
    name, subject = "the schedule of exploration", lab.subject
    is_set = subject.accepts("exploration_initial_eps") and subject.accepts("exploration_final_eps")
    changes: dict[str, Any] = {}
    if is_set:
        changes = {"exploration_initial_eps": 1.0, "exploration_final_eps": 0.0}
    if isinstance(subject, ClassSubject) and not is_set:
        return
    if is_set and subject.accepts("exploration_fraction"):
        changes["exploration_fraction"] = 0.5
    if subject.accepts("learning_starts"):
        changes["learning_starts"] = 10
    changes |= stepwise(subject)
    if isinstance(subject, ClassSubject) and subject.typed.get("engine") == "compiled":
        yield Finding(name, "skipped", "compiled training does not record actions")
        return
    trained = lab.begin(World(((1, 0),), noise=1e-9), 2 * subject.steps, **changes)
    is_other = np.array(trained.record.actions) != trained.act(0)
    n = len(is_other)  # without the first steps, before anything is learnt
    early, late = float(is_other[n // 8 : n // 4].mean()), float(is_other[-n // 4 :].mean())
    text = f"the best action is not taken in {early:.1%} of the first steps, {late:.1%} of the last"
    if late > early + 0.1:
        yield Finding(name, "fault", text, "schedule-backwards", "less at the end")
    elif is_set and late > 0.15:
        yield Finding(name, "fault", text, "schedule-constant", "0 % at the end")
    elif is_set and early < 0.15:
        yield Finding(name, "unsaid", text)
    else:
        yield Finding(name, "ok", text)


# --- seeds and files ------------------------------------------------------------------------------


def probe_seeds(lab: Lab) -> Iterator[Finding]:
    """The same seed gives the same training, whatever the state of the global generators."""
    name, results, agents = "seeds", [], []
    steps = 130 if lab.subject.is_on_policy else 300
    for state in (1, 1, 2):
        _set_global_generators(state)
        half = {"exploration_initial_eps": 0.5, "exploration_final_eps": 0.5}
        trained = lab.begin(SAFE_FORK, steps, **half)
        agents.append(trained)
        values = trained.values()
        acted = [trained.act(state) for state in range(SAFE_FORK.n_states)]
        found = acted if values is None else [*values.ravel(), *acted]
        results.append((tuple(trained.record.actions), tuple(found)))
    first, again, other = results
    if first != again and (both := _held_by_both(*agents[:2])):
        text = f"two agents have the same {both}, and two trainings with the same seed differ"
        yield Finding(name, "fault", text, "shared-buffer", "one for each")
    elif first != again:
        text = "two trainings with the same seed differ, in the same state of the global generators"
        yield Finding(name, "fault", text, "not-reproducible", "none")
    elif first != other:
        text = "two trainings with the same seed differ if NumPy's, Python's and PyTorch's global "
        yield Finding(name, "fault", f"{text}generators do", "global-generator", "none")
    else:
        yield Finding(name, "ok", "three trainings with the same seed are the same")


def _held_by_both(one: Trained, other: Trained) -> str:
    """The name of a mutable attribute that two models share; empty if there is none."""
    import torch as th
    from stable_baselines3.common.buffers import BaseBuffer

    kinds = (BaseBuffer, np.ndarray, th.Tensor, th.nn.Module, list, dict, deque)
    held = [vars(getattr(each, "model", None) or each) for each in (one, other)]
    names = [
        name
        for name, value in held[0].items()
        if isinstance(value, kinds) and value is held[1].get(name)
    ]
    return names[0] if names else ""


def _set_global_generators(state: int) -> None:
    import torch as th

    random.seed(state)
    np.random.seed(state)  # noqa: NPY002 (whether a learner draws from it is what is asked)
    th.manual_seed(state)


def probe_files(lab: Lab) -> Iterator[Finding]:
    """A loaded model equals the saved one."""
    name, subject = "saving and loading", lab.subject
    if not isinstance(subject, ClassSubject):
        return
    from stable_baselines3.common.utils import LinearSchedule

    changes: dict[str, Any] = {"exploration_initial_eps": 0.9, "exploration_final_eps": 0.1}
    rate = {**subject.base, **subject.typed}.get("learning_rate", 0.1)
    if subject.accepts("learning_rate") and isinstance(rate, float) and not subject.uses_ratio:
        changes["learning_rate"] = LinearSchedule(rate, rate / 20, 1.0)
    trained = lab.begin(CHAIN, 300, **changes)
    assert isinstance(trained, TrainedModel)
    model: Any = trained.model
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "model.zip")
        try:
            model.save(path)
            loaded = subject.cls.load(path, device="cpu")
        except Exception as error:  # noqa: BLE001 (user code may raise anything)
            text = f"it cannot be saved and loaded: {type(error).__name__}: {one_line(error)}"
            yield Finding(name, "unsaid", text)
            return
    lost = _lost(trained, model, loaded)
    for fault, text in lost.items():
        yield Finding(name, "fault", text, fault, "the same")
    if not lost:
        yield Finding(name, "ok", "values, optimizers and schedules are the same after loading")


def _lost(trained: TrainedModel, model: Any, loaded: Any) -> dict[str, str]:
    """What a loaded model has lost, by fault."""
    lost, before = {}, trained.values()
    trained.model = loaded
    after = trained.values()
    is_same = before is None or (after is not None and bool(np.allclose(before, after)))
    if not (is_same and _same(model.policy.state_dict(), loaded.policy.state_dict())):
        told = [[] if each is None else np.round(each, 2).tolist() for each in (before, after)]
        lost["zip-forgets-tables"] = f"values {told[0]} are {told[1]} after loading"
    there, now = _optimizers(model), _optimizers(loaded)
    for place, optimizer in there.items():
        if place not in now or not _same(optimizer.state_dict(), now[place].state_dict()):
            n = len(optimizer.state_dict()["state"])
            lost["zip-forgets-optimizer"] = f"{place}: the state of {n} parameters is not the same"
    for key in ("lr_schedule", "exploration_schedule", "clip_range"):
        schedules = getattr(model, key, None), getattr(loaded, key, None)
        if callable(schedules[0]):
            first, second = (
                [float(each(p)) if callable(each) else each for p in (1.0, 0.5)]
                for each in schedules
            )
            if first != second:
                lost["zip-forgets-schedules"] = f"{key} goes {first}, after loading {second}"
    for key in ("num_timesteps", "_current_progress_remaining", "exploration_rate"):
        pair = getattr(model, key, None), getattr(loaded, key, None)
        if pair[0] != pair[1]:
            lost["zip-forgets-schedules"] = f"{key} was {pair[0]}, after loading {pair[1]}"
    return lost


def _optimizers(model: Any) -> dict[str, Any]:
    """All optimizers of a model, by the path of their attribute."""
    from torch.optim import Optimizer

    holders = {"": model, "policy": model.policy}
    holders |= {key: each for key, each in vars(model).items() if hasattr(each, "optimizer")}
    holders |= {
        f"policy.{key}": each
        for key, each in getattr(model.policy, "_modules", {}).items()
        if hasattr(each, "optimizer")
    }
    found = {}
    for place, holder in holders.items():
        for key, value in vars(holder).items():
            if isinstance(value, Optimizer):
                found[f"{place}.{key}".strip(".")] = value
    return found


def _same(one: Any, other: Any) -> bool:
    """Whether nested dictionaries and lists of tensors and numbers are equal."""
    import torch as th

    if isinstance(one, th.Tensor):
        return isinstance(other, th.Tensor) and th.equal(one, other)
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    return bool(one == other)


Probe = Callable[[Lab], Iterator[Finding]]
PROBES: tuple[Probe, ...] = (
    probe_ends,
    probe_discount,
    probe_cuts,
    probe_next_action,
    probe_ratio,
    probe_target_network,
    probe_age,
    probe_copies,
    probe_n_steps,
    probe_traces,
    probe_choice,
    probe_entropy,
    probe_schedules,
    probe_seeds,
    probe_files,
)
NEEDS_VALUES = frozenset(PROBES[:10]) | {probe_schedules}
