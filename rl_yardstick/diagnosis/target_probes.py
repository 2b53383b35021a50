"""Probes of targets: values in tiny worlds, or under settings, that differ in one thing.

The values of a correct learner do not depend on that thing, or change by a known amount. Single
values only describe. A probe returns None where it does not apply.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rl_yardstick.diagnosis.faults import UNEXPLAINED, Finding, checked
from rl_yardstick.diagnosis.probe_worlds import ARM_0, CHAIN, SAFE_FORK, World
from rl_yardstick.diagnosis.subjects import GAMMA, ClassSubject, Lab, Subject
from rl_yardstick.mdp.transition_model import Floats

SEES_START = replace(CHAIN, end_shows=0)
START_PAYS = World(((5, 5), (1, 1)))
END_PAYS_MORE = World(((0, 0), (2, 2)))
LOOP = replace(CHAIN, ends=False, cut=4)
DEAR_FORK = World(((0, 0), (1, -4)))
STAIRS = World(((0.5, 0.5), (0, 0), (1, 1), (0, 0), (1, 1)))


def probe_ends(lab: Lab) -> Finding:
    """The observation at the end has no value, and the next episode does not count."""
    plain, seeing = lab.settled(CHAIN), lab.settled(SEES_START)
    shown = f"the last state is worth {plain[1]:.2f}"
    seen = f"{shown}, and {seeing[1]:.2f} where the end looks like the start"
    if abs(seeing[1] - plain[1]) > 0.25:
        return Finding("fault", seen, "bootstraps-at-terminal", "1 in both")
    paid = lab.settled(START_PAYS)
    if abs(paid[1] - plain[1]) > 0.25:
        text = f"{shown}, and {paid[1]:.2f} where the first step of an episode pays 5"
        right, moved = "1 in both; the first state's changes by 5", paid[0] - plain[0]
        if moved >= 2.5:
            return Finding("fault", text, "bootstraps-at-terminal", right)
        text += f"; the first state's own value changes by {moved:.2f}"
        return Finding("fault", text, "shared-buffer", right)
    if abs(plain[1] - 1) > 0.25:
        return Finding("unsaid", f"{shown} and not 1: {UNEXPLAINED}")
    return Finding("ok", seen)


def probe_discount(lab: Lab) -> Finding:
    """Where the end pays 1 more, the state before it is worth gamma more."""
    less, more = lab.settled(CHAIN), lab.settled(END_PAYS_MORE)
    gain = float(more[1] - less[1])
    if gain < 0.5:
        return Finding("unsaid", f"a reward that is higher by 1 adds {gain:.2f} to its state")
    seen = float(more[0] - less[0]) / gain
    text = f"a state's value grows by {seen:.2f} where that of the next grows by 1"
    faults = {
        "discount-twice": abs(seen - GAMMA**2) < 0.08,
        "discount-missing": abs(seen - 1) < 0.1,
        "target-never-copied": abs(seen) < 0.3 and has_target(lab.subject),
    }
    for fault, is_seen in faults.items():
        if is_seen:
            return Finding("fault", text, fault, f"gamma, which is {GAMMA}")
    if abs(seen - GAMMA) > 0.08:
        return Finding("unsaid", f"{text} and not by {GAMMA}: {UNEXPLAINED}")
    return Finding("ok", text)


def probe_cuts(lab: Lab) -> Finding:
    """Neither a time limit nor the start of the next episode changes a value."""
    cut, paid = lab.settled(LOOP), lab.settled(replace(LOOP, pays=START_PAYS.pays))
    text = f"a state that pays 1 for ever is worth {cut[1]:.2f}"
    right = f"{1 / (1 - GAMMA):g} in both"
    if abs(paid[1] - cut[1]) > 1:
        text += f", and {paid[1]:.2f} where the first step of an episode pays 5"
        return Finding("fault", text, "reset-observation", right)
    long = lab.settled(replace(LOOP, cut=40))
    text += f" under a limit of 4 steps, and {long[1]:.2f} under one of 40"
    if long[1] - cut[1] > 0.8:
        return Finding("fault", text, "no-bootstrap-at-truncation", right)
    if abs(cut[1] * (1 - GAMMA) - 1) > 0.2:
        return Finding("unsaid", f"{text} and not {right}: {UNEXPLAINED}")
    return Finding("ok", text)


def probe_next_action(lab: Lab) -> Finding:
    """The cost of a bad action lowers targets that follow the policy, not those that maximise."""
    target = lab.subject.target
    if target is None:
        return Finding("skipped", "what does it claim to be? --kind q_learning or sarsa")
    if target == "states" or lab.subject.spaces[1] == "box":
        return Finding("skipped", "it has no values of two actions")
    safe, _ = lab.mean(SAFE_FORK)
    dear, share = lab.mean(DEAR_FORK)
    seen, expected = float(safe[0] - dear[0]), GAMMA * 4 * share
    text = (
        f"a state's value falls by {seen:.2f} where an action after it, done {share:.0%} of the "
        "time, costs 4 more"
    )
    if expected < 0.3:
        text = f"the bad action is done in {share:.0%} of the visits only: let it explore more"
        return Finding("unsaid", text)
    if target == "maximises":
        fault = "importance-ratio" if lab.subject.uses_ratio else "follows-instead-of-maximises"
        return checked(seen > 0.5 * expected, text, fault, "0")
    fault = "maximises-instead-of-follows"
    return checked(seen < 0.25 * expected, text, fault, f"about {expected:.2f}")


def probe_ratio(lab: Lab) -> Finding | None:
    """Off-policy returns are weighted; PPO's clipping bounds the policy change of one rollout."""
    subject = lab.subject
    if subject.uses_ratio:
        whole, half = lab.settled(SAFE_FORK), lab.settled(replace(SAFE_FORK, quits=0.5))
        share = float(half[0] / max(whole[0], 1e-9))
        text = f"a state that half of the time ends at once keeps {share:.2f} of its value"
        return checked(abs(share - 0.5) >= 0.08, text, "importance-ratio", "0.50")
    if not all(map(subject.accepts, ("clip_range", "n_epochs", "n_steps", "batch_size"))):
        return None
    once = {"n_steps": 64, "batch_size": 64, "n_epochs": 150, "learning_rate": 1e-3}
    moved = []
    for clip_range in (0.2, 0.5):
        trained = lab.begin(ARM_0, 64, clip_range=clip_range, **once)
        moved.append(float((trained.drawn_actions(0, 2000) == 0).mean()))
    low, high = moved
    text = (
        f"one rollout moves a probability from about 0.5 to {low:.2f} where the ratio is "
        f"clipped at 1.2, and to {high:.2f} where at 1.5"
    )
    if high < 0.15 or (high > 0.5 and (high > 0.92 or low > 0.75)):
        return Finding("fault", text, "importance-ratio", "to 0.6, and to 0.75")
    return Finding("ok" if 0.5 < low < high else "unsaid", text)


# --- stored data ----------------------------------------------------------------------------------


def has_target(subject: Subject) -> bool:
    """Whether the subject has a target network whose updates can be set."""
    is_set = subject.accepts("target_update_interval") or subject.accepts("tau")
    return is_set and "DeepQLearning" not in subject.ancestors


def probe_target_network(lab: Lab) -> Finding | None:
    """A target network that is never updated passes on nothing that is learnt."""
    subject, text = lab.subject, ""
    if not has_target(subject):
        return None
    # The library's SAC restarts the interval in each call of train: with one gradient step it
    # always updates.
    settings = {"target_update_interval": 10**9} if subject.target == "maximises" else {}
    for setting, value in {**settings, "tau": 1e-9}.items():
        if not subject.accepts(setting):
            continue
        change = {setting: value}
        less, more = lab.settled(CHAIN, **change), lab.settled(END_PAYS_MORE, **change)
        seen = float(more[0] - less[0])
        text = f"with {setting} {value:g}, an end that pays 1 more adds {seen:.2f}"
        if abs(seen) > 0.35:
            return Finding("fault", text, "target-always-copied", "0")
    return Finding("ok", text)


def probe_age(lab: Lab) -> Finding | None:
    """Old rewards that have changed since are forgotten."""
    subject, steps = lab.subject, lab.subject.steps
    if not (subject.accepts("buffer_size") or subject.is_on_policy):
        return None
    changes = {"buffer_size": steps // 2} if subject.accepts("buffer_size") else {}
    always = lab.settled(CHAIN)
    trained = lab.begin(replace(CHAIN, pays_after=steps), 3 * steps, **changes)
    values = trained.state_values()
    text = (
        f"a state that pays only after {steps:,} steps is worth {values[1]:.2f} after "
        f"{3 * steps:,}, and one that always pays {always[1]:.2f}"
    )
    if always[1] - values[1] > 0.25:
        return Finding("fault", text, "stale-buffer", "the same")
    buffer = getattr(trained.model, "rollout_buffer", None)
    if buffer is not None:
        learnt = np.ravel(buffer.actions).astype(int)
        if not np.array_equal(learnt, trained.record.actions[-len(learnt) :]):
            text = "the last rollout that was learnt from is not the last one that was collected"
            return Finding("fault", text, "stale-buffer", "the same actions")
    return Finding("ok", text)


def _told(values: Floats) -> str:
    return " and ".join(f"{value:.2f}" for value in values)


# --- several steps --------------------------------------------------------------------------------


def probe_n_steps(lab: Lab) -> Finding | None:
    """Values are the same whatever the number of steps of a target."""
    subject, fault = lab.subject, "n-step-return"
    is_class = isinstance(subject, ClassSubject)
    if not subject.accepts("n_steps") or (not is_class and subject.target == "states"):
        return None  # for a script it may mean the length of a rollout
    if subject.is_on_policy and (subject.accepts("n_epochs") or "A2C" not in subject.ancestors):
        return None
    one = lab.settled(STAIRS, n_steps=1)
    pays = np.array(STAIRS.pays)[:, 0]
    right = np.array([pays[s:] @ GAMMA ** np.arange(len(pays) - s) for s in range(len(pays))])
    if np.abs(one - right).max() >= 0.25:
        return Finding("skipped", "values are wrong with one step already")
    several = lab.settled(STAIRS, n_steps=3)
    text = f"values are {_told(one)} with one step, and {_told(several)} with 3"
    if np.abs(one - several).max() > 0.2:
        return Finding("fault", text, fault, _told(right))
    one, several = lab.settled(LOOP, n_steps=1), lab.settled(LOOP, n_steps=3)
    if abs(one[1] - several[1]) > 0.8:
        text = (
            f"a state that pays 1 for ever is worth {one[1]:.2f} with one step, and "
            f"{several[1]:.2f} with 3, under a limit of 4"
        )
        return Finding("fault", text, fault, f"{1 / (1 - GAMMA):g} in both")
    return Finding("ok", text)


def probe_advantages(lab: Lab) -> Finding | None:
    """The advantages in the rollout buffer are the sum that defines them."""
    if not (lab.subject.is_on_policy and lab.subject.accepts("gae_lambda")):
        return None
    found = {}
    for decay in (0.0, 0.9):
        trained = lab.begin(STAIRS, 128, gae_lambda=decay, n_steps=64)
        buffer: Any = getattr(trained.model, "rollout_buffer", None)
        if not hasattr(buffer, "advantages"):
            return Finding("skipped", "it has no rollout buffer of the library's")
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
        return Finding("ok", text)
    if found[0.0] < 1e-3:
        return Finding("fault", f"{text}, and right with 0", "traces", "0")
    return Finding("unsaid", f"{text}, and by {found[0.0]:.3f} with 0")


def probe_traces(lab: Lab) -> Finding | None:
    """Credit decays by gamma times lambda with each step back, and ends with the episode."""
    subject, decay = lab.subject, 0.5
    if not subject.accepts("trace_decay"):
        return None
    settings = {"trace_decay": decay, "learning_rate": 0.5}
    greedy = {**settings, "exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}
    found: Any = lab.begin(World(((0, 0), (0, 0), (1, 1))), 3, **greedy).values()
    first = np.max(found, axis=1)
    ratio = first[1] / first[2] if first[2] else np.nan
    text = f"after one episode a state's value is {ratio:.2f} times that of the next state"
    right = f"gamma x lambda, which is {GAMMA * decay:g}"
    if not abs(ratio - GAMMA * decay) < 0.05 or abs(first[0] - ratio**2 * first[2]) > 0.05:
        return Finding("fault", text, "traces", right)
    found = lab.begin(World(((5, 5), (0, 0), (1, 1))), 4, **greedy).values()
    later = np.max(found, axis=1)
    if abs(later[2] - first[2]) > 0.05:
        told = f"the next episode's first reward changes the last state from {first[2]:.2f} to "
        return Finding("fault", f"{told}{later[2]:.2f}", "traces", "it changes nothing")
    return Finding("ok", text)
