"""Checks an environment for what makes trainings fail, or learn something else than was meant.

Nothing is trained: copies of the environment play at random, with the same seeds and actions, alone
and together, watched and not. `CHECKS` has the checks in their order.
"""

from __future__ import annotations

import contextlib
import copy
import io
import pickle
import random
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rl_yardstick.mdp.transition_model import TransitionModel
from rl_yardstick.pipeline import environment_trial
from rl_yardstick.pipeline.environment_trial import (
    SEED,
    STATISTICS,
    Finding,
    Findings,
    Step,
    first_difference,
    layers_of,
    look_at_calls,
    look_at_seed,
    same,
)
from rl_yardstick.pipeline.errors import one_line

SECONDS = 16.0  # for all checks; a step that hangs is the environment's
N_PLAYED, N_LONG, N_SEEDED, N_WATCHED = 1000, 6000, 120, 10  # steps
N_STARTS, START_STEPS = 8, 20  # plays that are compared with each other, and their steps
MOST_STATES = 100_000  # of a model that is read
SLOW, HUGE = 0.003, 1000.0  # seconds of a step; a reward
LEVELS = ("breaks", "bites", "note")
# Where one of these was found, two plays may differ for that reason.
UNREPEATABLE = {"seed", "global-generator", "shared-state", "state-survives-reset"}


@dataclass
class Examination:
    """What the checks of one environment share."""

    make: Callable[..., Any]  #: makes a copy; takes a render mode, or nothing
    until: float  #: the moment of `time.monotonic` after which no step begins
    found: Findings = field(default_factory=Findings)
    has_goal: bool = False  #: whether the model shows that rewards and ends can be reached

    def play(self, env: Any, n_steps: int, **options: Any) -> list[Step]:
        """Play for at most two seconds."""
        until = min(self.until, time.monotonic() + 2)
        return environment_trial.play(env, n_steps, until, self.found, **options)


def examine(make: Callable[..., gym.Env[Any, Any]], seconds: float = SECONDS) -> list[Finding]:
    """What is wrong with an environment, the worst first.

    ``make`` makes a new copy, and is also called with ``render_mode``. No step begins after that
    many seconds.
    """
    one, printed = Examination(make, time.monotonic() + seconds), io.StringIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(printed):
        warnings.simplefilter("ignore")
        for check, failure in CHECKS.items():
            try:
                check(one)
            except gym.error.DependencyNotInstalled:
                continue
            except (Exception, SystemExit) as error:  # noqa: BLE001  # the environment may raise any
                last = traceback.extract_tb(error.__traceback__)[-1]
                where = f"{last.filename.rpartition('/')[2]}:{last.lineno}"
                one.found.add(failure, f"{type(error).__name__}: {one_line(error)}", where)
            is_late = time.monotonic() > one.until
            if is_late or one.found.keys() & {"old-api", "no-space"}:
                break
    if is_late:
        one.found.add("slow", f"{seconds:g} s were too short for all checks")
    if len(printed.getvalue()) > 200:
        one.found.add("prints", f"it prints while it plays: {printed.getvalue()[:40]!r}")
    return sorted(one.found.values(), key=lambda finding: LEVELS.index(finding.level))


# --- spaces, calls, and the published model -------------------------------------------------------


def check_spaces_and_calls(one: Examination) -> None:
    """Spaces that trainings cannot use, or that `reset` makes anew; calls of an old Gym."""
    base, known = one.make().unwrapped, {}
    for name in ("observation_space", "action_space"):
        known[name] = space = getattr(base, name, None)
        if not isinstance(space, spaces.Space):
            one.found.add("no-space", f"{name} is no gymnasium space", name)
            return
        for path, leaf in _leaves(space):
            if np.any(getattr(leaf, "start", 0)):
                one.found.add("space-start", f"{leaf} does not count from 0", f"{name}{path}")
    if isinstance(base.action_space, spaces.Box) and not base.action_space.is_bounded():
        one.found.add("action-bounds", "actions have no bounds", "action_space")
    before = copy.deepcopy(known)
    look_at_calls(one.found, base)
    for name, old in before.items():
        new = getattr(base, name)
        if new != old:
            one.found.add("space-changed", f"reset or step turns {old} into {new}", name)
        elif new is not known[name]:
            one.found.add("space-remade", "reset makes an equal space anew", name)


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The parts of a space or of an observation, and where they lie in it."""
    if not isinstance(value, Mapping | tuple | spaces.Tuple):
        yield path, value
        return
    for key, part in value.items() if isinstance(value, Mapping) else enumerate(value):
        yield from _leaves(part, f"{path}[{key!r}]")


def check_model(one: Examination) -> None:
    """A goal that cannot be reached, by the model that the environment publishes."""
    base = one.make().unwrapped
    table, starts = getattr(base, "P", None), getattr(base, "initial_state_distrib", None)
    if hasattr(base, "transition_model"):
        model = base.transition_model()
    elif isinstance(table, Mapping) and starts is not None and len(table) <= MOST_STATES:
        model = TransitionModel.from_gymnasium(table, starts)
    else:
        return
    possible = model.prob > 0
    met = possible & model.reachable[:, None, None]
    # The rows of states in which episodes end mean nothing.
    is_last = np.isin(np.arange(model.n_states), model.next_state[possible & model.terminated])
    asked = possible & (model.reachable | ~is_last)[:, None, None]
    top, has_end = model.reward[asked].max(), bool(model.terminated[met].any())
    one.has_goal = has_end and bool(model.reward[met].any())
    can_pay = max(model.reward[met].max(), 0) >= top - 1e-9
    if not can_pay or (model.terminated[asked].any() and not has_end):
        told = "no episode can end" if can_pay else f"no episode can pay {top:g}"
        count = f"P: {int(model.reachable.sum()):,} of {model.n_states:,} states can be reached"
        one.found.add("goal-unreachable", told, count)


# --- long random play -----------------------------------------------------------------------------


def check_play(one: Examination) -> None:
    """Single steps, and what lengths, rewards and observations of random episodes show."""
    env, limit = one.make(), gym.wrappers.TimeLimit
    steps = one.play(env, N_PLAYED)
    if not any(step.reward for step in steps) or not any(map(_ends, steps)):
        steps = one.play(env, N_LONG)
    taken = [step for step in steps if not step.is_start]
    seconds, told = float(np.median([step.seconds for step in taken])), f"in {len(taken):,} steps"
    if seconds > SLOW:
        one.found.add("slow", f"a step takes {1000 * seconds:.1f} ms")
    largest = max((abs(step.reward) for step in taken if np.isfinite(step.reward)), default=0.0)
    if largest > HUGE:
        one.found.add("reward-huge", f"rewards reach {largest:,.0f}; 1 is best for networks")
    if len(taken) >= N_PLAYED:
        if not largest and not one.has_goal:
            one.found.add("reward-never", f"no reward {told} at random")
        has_limit = any(isinstance(layer, limit) for layer in layers_of(env))
        if not any(map(_ends, steps)) and not one.has_goal and not has_limit:
            one.found.add("no-end", f"no episode ended {told}, and there is no time limit")
        has_choice = getattr(env.observation_space, "n", 2) > 1
        if has_choice and all(same(steps[0].obs, step.obs) for step in steps):
            one.found.add("observation-constant", f"the observation never changes {told}")
    lengths = {*_lengths(steps)}
    if len(lengths) == 1 and min(lengths) >= 10 and not _shows_the_end(steps):
        others = one.play(env, 5 * min(lengths), same_action=True)
        if {*_lengths(others)} == lengths and not any(step.truncated for step in steps):
            told = f"all episodes are terminated after exactly {min(lengths)} steps"
            one.found.add("limit-as-terminated", told)


def _ends(step: Step) -> bool:
    return step.terminated or step.truncated


def _lengths(steps: list[Step]) -> list[int]:
    """The lengths of the episodes that ended."""
    ends = [number for number, step in enumerate(steps) if _ends(step)]
    return [int(n) for n in np.diff([-1, *ends]) - 1]


def _shows_the_end(steps: list[Step]) -> bool:
    """Whether some number in the observations differs at every end from all before it."""
    rows = [np.concatenate([np.ravel(x) for _, x in _leaves(step.obs)]) for step in steps]
    if len({row.shape for row in rows}) != 1 or rows[0].dtype.kind not in "fiub":
        return False
    is_end = np.array([*map(_ends, steps)])
    last, before = np.array(rows)[is_end], np.array(rows)[~is_end]
    apart = (last.min(axis=0) > before.max(axis=0)) | (last.max(axis=0) < before.min(axis=0))
    return bool(apart.any())


def check_after_an_end(one: Examination) -> None:
    """A step after the end of an episode."""
    base, is_over = one.make().unwrapped, False
    with contextlib.suppress(Exception):  # refusing such a step is right
        base.reset(seed=SEED)
        for _ in range(N_PLAYED):
            was_over, (_, reward, is_over, *_) = is_over, base.step(base.action_space.sample())
            if was_over and reward and not is_over:
                one.found.add("step-after-end", f"a step after an end pays {reward:g}")
            if was_over or time.monotonic() > one.until:
                return


# --- seeds and copies -----------------------------------------------------------------------------


def check_seeds(one: Examination) -> None:
    """The same seed gives the same episode, another seed another one, whatever was before."""
    env, other = one.make(), one.make()
    states = random.getstate(), np.random.get_state()  # noqa: NPY002
    shared = _shared_values(env)
    first = one.play(env, N_SEEDED)
    if not same(states, (random.getstate(), np.random.get_state())):  # noqa: NPY002
        told = "it seeds or draws from a global generator: random or numpy.random"
        one.found.add("global-generator", told)
    changed = [name for name, value in _shared_values(env).items() if shared.get(name) != value]
    second, again = one.play(other, len(first)), one.play(env, len(first))
    survived = first_difference(first, again)
    if changed and (at := first_difference(first, second) or survived):
        told = "what one copy does changes later episodes of all copies"
        one.found.add("shared-state", told, f"{changed[0]}, {at}")
        return
    look_at_seed(one.found, first, second)
    seeded = [one.play(other, START_STEPS, seed=seed) for seed in range(N_STARTS)]
    n_kinds = sum(all(first_difference(a, b) for b in seeded[:n]) for n, a in enumerate(seeded))
    if survived and "seed" not in one.found:
        kinds = (np.random.Generator, np.random.RandomState, random.Random)
        values = vars(env.unwrapped).items()
        own = [name for name, v in values if isinstance(v, kinds) and name != "_np_random"]
        told = "the second reset with a seed begins another episode than the first"
        if own:
            one.found.add("seed", f"{told}: a generator ignores it", f"self.{own[0]}")
        elif not any("Normalize" in type(layer).__name__ for layer in layers_of(env)):
            one.found.add("state-survives-reset", told, survived)
    elif n_kinds > 2:
        unseeded = [one.play(env, START_STEPS, seed=None) for _ in range(N_STARTS)]
        if not any(first_difference(unseeded[0], start) for start in unseeded):
            told = "reset() without a seed gives the same episode each time, and seeds others"
            one.found.add("reset-repeats", told, "reset")


def _shared_values(env: Any) -> dict[str, bytes]:
    """Data in the classes and modules of the environment, pickled, by name."""
    found = {}
    for kind in type(env.unwrapped).__mro__:
        module = sys.modules[kind.__module__]
        if module.__name__.startswith(("gymnasium.", "builtins", "typing")):
            continue
        for place, values in ((kind.__name__, vars(kind)), (module.__name__, vars(module))):
            for name, value in [*values.items()]:
                if isinstance(value, list | dict | set | np.ndarray | int) and name[:2] != "__":
                    with contextlib.suppress(Exception):
                        found[f"{place}.{name}"] = pickle.dumps(value)
    return found


def check_copies(one: Examination) -> None:
    """A copy plays the same while another copy plays beside it."""
    beside = one.make()
    beside.reset(seed=SEED + 1)

    def step_beside() -> None:
        _, _, terminated, truncated, _ = beside.step(beside.action_space.sample())
        if terminated or truncated:
            beside.reset()

    together = one.play(one.make(), N_SEEDED, before=step_beside)
    at = first_difference(one.play(one.make(), N_SEEDED), together)
    if at and not UNREPEATABLE & one.found.keys():
        told = "a copy plays another episode while another copy plays"
        one.found.add("shared-state", told, at)


# --- around the environment -----------------------------------------------------------------------


def check_rendering(one: Examination) -> None:
    """Frames, and whether an episode that is watched is the same one."""
    modes = one.make().metadata.get("render_modes") or ()
    mode = next((mode for mode in ("rgb_array", "ansi") if mode in modes), None)
    if mode is None:
        return
    watched = one.make(render_mode=mode)
    watched.reset(seed=SEED)
    frame = np.asarray(watched.render())
    if watched.render_mode != mode:
        one.found.add("render", f"render_mode is {watched.render_mode!r}, not {mode!r}", "__init__")
    elif mode == "rgb_array" and (frame.dtype != np.uint8 or frame.ndim != 3):
        told = f"rgb_array gives {frame.dtype} of the shape {frame.shape}"
        one.found.add("render", told, "render")
    seen = one.play(watched, N_WATCHED, before=watched.render)
    at = first_difference(one.play(one.make(), N_WATCHED), seen)
    if at and not UNREPEATABLE & one.found.keys():
        told = "an episode that is watched is another than one that is not"
        one.found.add("render-changes", told, at)


def check_wrappers_and_copying(one: Examination) -> None:
    """A time limit around the wrapper that counts episodes; `copy.deepcopy` for look-ahead."""
    env = one.make()
    names = [type(layer).__name__ for layer in layers_of(env)]  # the outermost first
    for place, name in enumerate(names):
        if name in STATISTICS and "TimeLimit" in names[:place]:
            told = f"TimeLimit lies around {name}, which never counts what is cut off"
            one.found.add("wrapper-order", told, " > ".join(names))
    env.reset(seed=SEED)
    copy.deepcopy(env.unwrapped)


# The checks in their order, and what it is if one of them raises.
CHECKS = {
    check_spaces_and_calls: "crash",
    check_model: "model",
    check_play: "crash",
    check_after_an_end: "crash",
    check_seeds: "crash",
    check_copies: "crash",
    check_rendering: "render",
    check_wrappers_and_copying: "not-copyable",
}
