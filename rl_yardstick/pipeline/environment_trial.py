"""Plays an environment at random, and looks at every step: is it what Gymnasium asks for?

Before anything learns on a user's environment, two copies are tried for some steps (`tried`);
``check-env`` plays longer. Environments of Gymnasium and of this project are not tried.
"""

from __future__ import annotations

import copy
import json
import math
import random
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rl_yardstick.envs.wrappers import action_masks
from rl_yardstick.pipeline.environments import Env, creator_of, make_single_env
from rl_yardstick.pipeline.errors import UserError, shown
from rl_yardstick.pipeline.spec import Component, TrainSpec

SEED, N_STEPS = 0, 200
MOST_SECONDS = 5.0  # after which a slow environment has been tried long enough
LARGE = 10_000  # bytes of an observation of which the hash is enough
KNOWN = ("rl_yardstick", "gymnasium", "ale_py")
WITHOUT_EPISODE = "rl_yardstick.envs.wrappers.WithoutEpisodeInfo"
UNUSABLE = ("old-api", "observation-not-in-space")  # nothing can learn there
STATISTICS = ("RecordEpisodeStatistics", "Monitor")  # wrappers that write info["episode"]
RESERVED = ("terminal_observation", "TimeLimit.truncated", "final_obs", "final_info")
# By the name of each kind of finding: its level, and how to mend it.
KINDS = json.loads(Path(__file__).with_name("environment_findings.json").read_text("utf-8"))
ACTION, START = "observation, reward, terminated, truncated, info", "observation, info"


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, and where it was first seen."""

    level: str
    name: str  #: one of `KINDS`
    what: str
    where: str  #: a step, an attribute, a file and line; may be empty
    mend: str


class Findings(dict[str, Finding]):
    """The first finding of each name."""

    def add(self, name: str, what: str, where: str = "") -> None:
        """Add a finding, unless that name was found before; long texts are shortened."""
        level, mend = KINDS[name]
        text = " ".join(what.split())
        self.setdefault(name, Finding(level, name, text[:160], where, mend))


class Step(NamedTuple):
    """The outcome of a step, or the start of an episode."""

    obs: Any
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    is_start: bool = False
    seconds: float = 0.0


# --- playing --------------------------------------------------------------------------------------


def play(
    env: Env,
    n_steps: int,
    until: float,
    found: Findings,
    seed: int | None = SEED,
    before: Callable[[], object] = lambda: None,
    same_action: bool = False,
) -> list[Step]:
    """Play episodes with random actions, the same ones each time, and look at every step.

    No step begins after the moment ``until`` of `time.monotonic`. The seed is that of the first
    reset. ``before`` is called before each step; ``same_action`` repeats an episode's first action.
    """
    # An environment may make its own space anew, or seed it, in `reset`.
    space, actions, layers = env.observation_space, copy.deepcopy(env.action_space), layers_of(env)
    actions.seed(SEED)
    obs, _ = env.reset(seed=seed)
    steps, action = [Step(_kept(obs), is_start=True)], None
    _look_at_observation(found, space, obs, "step 0")
    for number in range(1, n_steps + 1):
        if time.monotonic() > until:
            break
        where = f"step {number}"
        before()
        action = action if same_action and action is not None else _chosen(env, actions)
        given, begin = copy.deepcopy(action), time.perf_counter()
        outcome = env.step(given)
        seconds = time.perf_counter() - begin
        if not same(given, action):
            found.add("action-changed", "step changes the array of its action", where)
        if not same(_kept(obs), steps[-1].obs):
            found.add("observation-in-place", "a step changes the last observation", where)
        obs, _, terminated, truncated, _ = outcome
        _look_at_observation(found, space, obs, where)
        ends = bool(terminated), bool(truncated)
        paid = _look_at_outcome(found, layers, outcome, where)
        steps.append(Step(_kept(obs), paid, *ends, seconds=seconds))
        if any(ends):
            obs, action = env.reset()[0], None
            steps.append(Step(_kept(obs), is_start=True))
            _look_at_observation(found, space, obs, where)
    return steps


def layers_of(env: Any) -> list[Any]:
    """The wrappers of an environment from the outermost on, and the environment itself."""
    return [env, *(layers_of(env.env) if isinstance(env, gym.Wrapper) else [])]


def _chosen(env: Env, actions: Any) -> Any:
    """A random action, a valid one where the environment has masks."""
    masks = action_masks(env)
    if masks is None or not isinstance(actions, spaces.Discrete):
        return actions.sample()
    return actions.sample(mask=masks.astype(np.int8))


def _kept(obs: Any) -> Any:
    """A copy of an observation, or the hash of a large one."""
    if not isinstance(obs, np.ndarray):
        return copy.deepcopy(obs)
    return hash(obs.tobytes()) if obs.nbytes > LARGE else obs.copy()


def same(one: Any, other: Any) -> bool:
    """Whether two observations, or lists of them, are equal; nan is equal to nan."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float | np.ndarray):
        is_float = np.asarray(one).dtype.kind == "f"
        return bool(np.array_equal(one, other, equal_nan=is_float))
    return bool(one == other)


def first_difference(one: list[Step], other: list[Step]) -> str:
    """The first step in which two plays differ; empty if there is none."""
    pairs = list(zip(one, other, strict=False))
    at = next((k for k, (a, b) in enumerate(pairs) if not same(a[:4], b[:4])), None)
    return "" if at is None else f"step {sum(not step.is_start for step in one[: at + 1])}"


# --- looking --------------------------------------------------------------------------------------


def look_at_calls(found: Findings, env: Any) -> None:
    """Whether the environment has the calls of Gym before version 0.26."""
    try:
        given = env.reset(seed=SEED, options=None)
    except TypeError as error:
        if "keyword argument" not in str(error):
            raise
        told = "Gymnasium calls reset(seed=..., options=...), which the environment does not take"
        found.add("old-api", told, "reset")
        return
    if not isinstance(given, tuple) or len(given) != 2:
        found.add("old-api", f"reset returns one value, not {START}", "reset")
        return
    given = env.step(copy.deepcopy(env.action_space).sample())
    if not isinstance(given, tuple) or len(given) != 5:
        told = f"{len(given)} values" if isinstance(given, tuple) else "one value"
        found.add("old-api", f"step returns {told}, not {ACTION}", "step")


def look_at_seed(found: Findings, one: list[Step], other: list[Step]) -> None:
    """Whether two copies with the seed `SEED` played the same."""
    if at := first_difference(one, other):
        sums = [f"{sum(step.reward for step in steps):g}" for steps in (one, other)]
        told = " and ".join(sums) if sums[0] != sums[1] else "other steps the second time"
        found.add("seed", f"the environment is not reproducible: seed {SEED} gave {told}", at)


def _look_at_observation(found: Findings, space: Any, obs: Any, where: str) -> None:
    """Whether an observation lies in its space, and has finite numbers."""
    if isinstance(space, spaces.Dict) and isinstance(obs, dict) and {*obs} == {*space}:
        for key in space:
            _look_at_observation(found, space[key], obs[key], where)
        return
    array = np.asarray(obs) if isinstance(space, spaces.Box) else np.zeros(0)
    is_number, is_array = array.dtype.kind in "fiub", isinstance(obs, np.ndarray)
    is_finite = is_number and (is_array or not array.size) and bool(np.isfinite(array).all())
    if is_finite and space.contains(obs):
        return
    name, told = "observation-not-in-space", f"the observation {shown(obs)} is not in {space}"
    if isinstance(space, spaces.Box) and array.shape != space.shape:
        told = f"the observation has the shape {array.shape}, and its space the shape {space.shape}"
    elif isinstance(space, spaces.Box) and is_number:
        if not np.isfinite(array).all():
            name, told = "observation-nan", "the observation holds nan or infinity"
        elif not ((array >= space.low) & (array <= space.high)).all():
            told = f"observations leave their space: values from {array.min():g} to {array.max():g}"
            name = "observation-out-of-bounds"
        else:
            kind = array.dtype if is_array else f"a {type(obs).__name__}"
            told = f"observations are {kind}, and their space is {space.dtype}"
            name = "observation-dtype"
    found.add(name, told, where)


def _look_at_outcome(found: Findings, layers: list[Any], outcome: Any, where: str) -> float:
    """Look at the types and names in the rest of a step's outcome; return the reward."""
    _, reward, terminated, truncated, info = outcome
    if np.ndim(reward) or isinstance(reward, str | complex | None):
        found.add("reward-type", f"the reward is {shown(reward)}", where)
        reward = np.asarray(reward).flat[0] if np.ndim(reward) else 0.0
    elif not np.isfinite(reward):
        found.add("reward-nan", f"the reward is {reward}", where)
    if not all(isinstance(value, bool | np.bool_) for value in (terminated, truncated)):
        found.add("end-type", f"terminated, truncated are {terminated!r}, {truncated!r}", where)
    for layer in [each for each in layers if isinstance(each, gym.wrappers.TimeLimit)]:
        taken: Any = layer._elapsed_steps
        if not truncated and taken >= layer._max_episode_steps:
            told = "the time limit ends the episode, and truncated is False"
            found.add("truncation-lost", told, where)
    if not isinstance(info, Mapping):
        found.add("info-type", f"info is {shown(info)}", where)
        info = {}
    has_statistics = any(type(layer).__name__ in STATISTICS for layer in layers)
    if "episode" in info and not (has_statistics and (terminated or truncated)):
        told = "the environment's own info['episode'] is left out of trainings"
        found.add("info-episode", told, where)
    for key in info.keys() & {*RESERVED}:
        if key != "TimeLimit.truncated" or info[key] != (truncated and not terminated):
            found.add("info-key", f"the environment's own info[{key!r}] is overwritten", where)
    return float(reward)


# --- before a training ----------------------------------------------------------------------------


def tried(spec: TrainSpec) -> tuple[TrainSpec, list[str]]:
    """The spec, with a wrapper where the environment needs one, and notes on the environment.

    Raises UserError where nothing can learn. The state of global generators is as before.
    """
    if getattr(creator_of(spec.env_id), "__module__", "").partition(".")[0] in KNOWN:
        return spec, []
    import torch as th

    states = random.getstate(), np.random.get_state(), th.get_rng_state()  # noqa: NPY002
    found = Findings()
    with suppress(Exception, SystemExit):  # of the user's code: training will meet it
        _look_at_two_copies(found, spec)
    random.setstate(states[0])
    np.random.set_state(states[1])  # noqa: NPY002
    th.set_rng_state(states[2])
    for one in [found[name] for name in UNUSABLE if name in found]:
        place = f"at {one.where} " if one.where.startswith("step ") else ""
        raise UserError(f"{spec.env_id}: {place}{one.what}; {one.mend}")
    if "info-episode" in found:
        spec = spec.changed(env_wrapper=[*spec.env_wrapper, Component(name=WITHOUT_EPISODE)])
    return spec, [f"{one.what} (from {one.where} on): {one.mend}" for one in found.values()]


def _look_at_two_copies(found: Findings, spec: TrainSpec) -> None:
    make = partial(make_single_env, spec, training=True, disable_env_checker=True)
    with closing(make()) as env:
        look_at_calls(found, env.unwrapped)
    if found:
        return
    with closing(make()) as env:
        one = play(env, N_STEPS, time.monotonic() + MOST_SECONDS, found)
    with closing(make()) as env:
        n_steps = sum(not step.is_start for step in one)
        look_at_seed(found, one, play(env, n_steps, math.inf, found))
