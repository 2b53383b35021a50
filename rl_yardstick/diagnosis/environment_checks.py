"""Checks an environment for what makes trainings fail, or learn something else than was meant.

Nothing is trained: copies of the environment play at random, with the same seeds and actions, alone
and beside another copy.
"""

from __future__ import annotations

import copy
import pickle
import random
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
from gymnasium import spaces

from rl_yardstick.envs.model_of.check import seeded_globally
from rl_yardstick.mdp.transition_model import TransitionModel
from rl_yardstick.pipeline import environment_trial as trial
from rl_yardstick.pipeline.environment_trial import Finding, Findings, layers_of, play
from rl_yardstick.pipeline.errors import UserError, one_line, own_calls

N_PLAYED, N_LONG, N_SEEDED = 1000, 6000, 120  # steps, as far as they take two seconds
SLOW, LONG, HUGE = 0.003, 3.0, 1000.0  # seconds of a step, of one that hangs; a reward
LATE = "the checks took too long here"  # what the command exits with after some seconds


def examine(make: Callable[[], Any]) -> list[Finding]:
    """What is wrong with an environment, of which ``make`` makes a new copy; the worst first."""
    found = Findings()
    with warnings.catch_warnings(), redirect_stdout(StringIO()):
        warnings.simplefilter("ignore")
        for check in (check_calls_and_spaces, check_play, check_seeds):
            try:
                check(found, make)
            except (Exception, SystemExit) as error:  # the environment may raise any
                if isinstance(error, UserError) and not found:
                    raise
                is_late = error.args == (LATE,)
                calls = traceback.extract_tb(error.__traceback__)[: -1 if is_late else None]
                last = (own_calls(error) or calls)[-1]
                where = f"{Path(last.filename).name}:{last.lineno}"
                told = LATE if is_late else f"{type(error).__name__}: {one_line(error)}"
                is_stuck = is_late and time.monotonic() - found.since > LONG
                found.add("hangs" if is_stuck else "slow" if is_late else "crash", told, where)
                break
            if found.keys() & {"old-api", "no-space"}:
                break
    return [found[name] for name in trial.KINDS if name in found]


def check_calls_and_spaces(found: Findings, make: Callable[[], Any]) -> None:
    """The calls, the spaces, the order of wrappers, and `copy.deepcopy` for look-ahead."""
    env, known = make(), {}
    names = [type(layer).__name__ for layer in layers_of(env)]  # the outermost first
    for place, name in enumerate(names):
        if name in trial.STATISTICS and "TimeLimit" in names[:place]:
            found.add("wrapper-order", f"{name} never sees the time limit", " > ".join(names))
    for name in ("observation_space", "action_space"):
        known[name] = space = getattr(env.unwrapped, name, None)
        if not isinstance(space, spaces.Space):
            found.add("no-space", f"{name} is no gymnasium space", name)
            return
        if "start=" in str(space):  # also in a part
            found.add("space-start", f"{space} does not count from 0", name)
    before = copy.deepcopy(known)
    trial.look_at_calls(found, env.unwrapped)
    for name, old in before.items():
        new = getattr(env.unwrapped, name)
        if new != old:
            found.add("space-changed", f"reset or step turns {old} into {new}", name)
        elif new is not known[name]:
            found.add("space-remade", "reset makes an equal space anew", name)
    try:
        copy.deepcopy(env.unwrapped)
    except Exception as error:  # noqa: BLE001  # an attribute may raise any
        found.add("not-copyable", f"{type(error).__name__}: {one_line(error)}")


def check_play(found: Findings, make: Callable[[], Any]) -> None:
    """What the model, and the lengths and rewards of random episodes show."""
    env = make()
    has_goal = look_at_model(found, env.unwrapped)
    steps = play(found, env, N_PLAYED)
    if not any(step.reward for step in steps) or not _lengths(steps):
        steps = play(found, env, N_LONG)
    seconds, told = float(np.median([one.seconds for one in steps])), f"in {len(steps) - 1:,} steps"
    if seconds > SLOW:
        found.add("slow", f"a step takes {1000 * seconds:.1f} ms")
    largest, lengths = max(abs(step.reward) for step in steps), _lengths(steps)
    if largest > HUGE:
        found.add("reward-huge", f"rewards reach {largest:,.0f}; 1 is best for networks")
    if not has_goal and len(steps) > N_PLAYED:
        if not largest and "outcome-type" not in found:
            found.add("reward-never", f"no reward {told} at random")
        if not lengths and "TimeLimit" not in str(env):
            found.add("no-end", f"no episode ended {told}, and there is no time limit")
    if len(lengths) == 1 and min(lengths) >= 10 and not any(step.truncated for step in steps):
        others = play(found, env, 5 * min(lengths), same_action=True)
        ends = {step.obs for step in steps if step.terminated}
        before = [step.obs for step in steps if not step.terminated]
        is_seen = ends.isdisjoint(before) and len({*before}) < len(before) / 2  # in observations
        is_seen |= "observation-not-in-space" not in found and _shows_end(env)
        if _lengths(others) == lengths and not is_seen:
            found.add("limit-as-terminated", f"all episodes terminate after {min(lengths)} steps")
    with suppress(Exception):  # refusing a step after an end is right
        base, is_over = env.unwrapped, False
        base.reset(seed=trial.SEED)
        base.action_space.seed(trial.SEED)
        for _ in range(2 * max(lengths, default=0)):
            was_over, (_, reward, is_over, *_) = is_over, base.step(base.action_space.sample())
            if was_over and reward and not is_over:
                found.add("step-after-end", f"a step after an end pays {reward:g}")


def _lengths(steps: list[trial.Step]) -> set[int]:
    """The lengths of the episodes that ended."""
    ends = [number for number, one in enumerate(steps) if one.start is not None]
    return {*np.diff([0, *ends]).tolist()}


def _shows_end(env: Any) -> bool:
    """Whether one number of the observation is the same at all ends, and never before."""
    before, ends = list[Any](), list[Any]()
    env.action_space.seed(trial.SEED)
    seen, is_over = env.reset(seed=trial.SEED)[0], False
    while len(ends) < 20:
        seen = env.reset()[0] if is_over else seen
        before.append(spaces.flatten(env.observation_space, seen))
        seen, _, is_over, *_ = env.step(trial.chosen(env, env.action_space))
        if is_over:
            ends.append(spaces.flatten(env.observation_space, seen))
    last = np.array(ends)
    return bool(((last == last[0]).all(axis=0) & (last[0] != before).all(axis=0)).any())


def look_at_model(found: Findings, base: Any) -> bool:
    """Whether a reward and an end can be reached by the model that the environment publishes."""
    table, starts = getattr(base, "P", None), getattr(base, "initial_state_distrib", None)
    if not isinstance(table, Mapping) or starts is None or len(table) > 100_000:
        return False
    model = TransitionModel.from_gymnasium(table, starts)
    possible = model.prob > 0
    met = possible & model.reachable[:, None, None]
    has_reward, has_end = bool(model.reward[met].any()), bool(model.terminated[met].any())
    top = model.reward[possible].max()
    can_pay = max(model.reward[met].max(), 0) >= top - 1e-9
    if not can_pay or (model.terminated[possible].any() and not has_end):
        told = "no episode can end" if can_pay else f"no episode can pay {top:g}"
        count = f"P: {int(model.reachable.sum()):,} of {model.n_states:,} states can be reached"
        found.add("goal-unreachable", told, count)
    return has_reward and has_end


def check_seeds(found: Findings, make: Callable[[], Any]) -> None:
    """The same seed gives the same episodes: in another copy, again, and beside another copy."""
    env, other = make(), make()
    shared = _shared_data(env)
    states = pickle.dumps((random.getstate(), np.random.get_state()))  # noqa: NPY002
    first = play(found, env, N_SEEDED)
    if pickle.dumps((random.getstate(), np.random.get_state())) != states:  # noqa: NPY002
        found.add("global-generator", "it seeds or draws from random or numpy.random")
    changed = [name for name, value in _shared_data(env).items() if shared.get(name) != value]
    second = play(found, other, N_SEEDED)
    survived = _survived(found, make)
    if changed and (at := trial.first_difference(first, second) or survived):
        found.add("shared-state", "a copy changes episodes of all copies", f"{changed[0]}, {at}")
        return
    trial.look_at_seed(found, first, second)
    if survived and "Normalize" not in str(env):  # its statistics remain
        found.add("state-survives-reset", "reset(seed=0) differs the second time", survived)
    seeded = {trial.digest(env.reset(seed=seed)[0]) for seed in range(8)}
    unseeded = {trial.digest(env.reset()[0]) for _ in range(8)}
    if len(unseeded) == 1 and len(seeded) > 2:
        found.add("reset-repeats", "reset() without a seed gives the same start each time")

    def step_beside() -> None:
        _, _, terminated, truncated, _ = other.step(other.action_space.sample())
        if terminated or truncated:
            other.reset()

    other.reset(seed=trial.SEED + 1)
    other.action_space.seed(trial.SEED)
    at = trial.first_difference(first, play(found, make(), N_SEEDED, step_beside))
    if at and not found.keys() & {"seed", "global-generator", "state-survives-reset"}:
        found.add("shared-state", "a copy plays another episode while another copy plays", at)


def _survived(found: Findings, make: Callable[[], Any]) -> str | None:
    """Where an episode differs after others, with the same global numbers; None if nowhere."""

    def played(env: Any, n_steps: int = N_SEEDED) -> list[trial.Step]:
        with seeded_globally(trial.SEED):
            return play(found, env, n_steps)

    with seeded_globally(trial.SEED):
        env = make()
    first, differs = played(env), trial.first_difference
    for before in (0, 1, 2, 3, 5):  # episodes that a reset cuts off
        played(env, before)
        if at := differs(first, played(env)):
            with seeded_globally(trial.SEED):
                other = make()
            return None if differs(first, played(other)) else at
    return None


def _shared_data(env: Any) -> dict[str, str]:
    """Data in the classes and modules of the environment, by name; also of default arguments."""
    kinds = [kind for kind in type(env.unwrapped).__mro__ if kind.__module__ in sys.modules]
    places: list[Any] = [*kinds, *(sys.modules[kind.__module__] for kind in kinds)]
    found = {}
    for place in places:
        for name, value in [*vars(place).items()]:
            data = value.__defaults__ if isinstance(value, FunctionType) else value
            is_data = isinstance(data, list | dict | set | tuple | np.ndarray | int)
            if is_data and name not in ("__builtins__", "__warningregistry__"):
                found[f"{place.__name__}.{name}"] = repr(data)
    return found
