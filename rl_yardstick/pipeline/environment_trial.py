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
from numbers import Real
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
SEED_OF_ACTIONS = 1_000  # with `SEED`, a space would draw the numbers that the environment draws
MOST_SECONDS = 2.0  # after which a slow environment has been played long enough
KNOWN = ("rl_yardstick", "gymnasium", "ale_py")
WITHOUT_EPISODE = "rl_yardstick.envs.wrappers.WithoutEpisodeInfo"
UNUSABLE = ("old-api", "observation-not-in-space")  # nothing can learn there
# By the name of each kind of finding, the worst first: its level, and how to mend it.
KINDS = json.loads(Path(__file__).with_name("environment_findings.json").read_text("utf-8"))
ACTION, START = "observation, reward, terminated, truncated, info", "observation, info"
TYPES = object, Real, bool | np.bool_, bool | np.bool_, Mapping  # of `ACTION`
STATISTICS = ("RecordEpisodeStatistics", "Monitor")  # wrappers that write info["episode"]
RESERVED = {"episode", "terminal_observation", "TimeLimit.truncated", "final_obs", "final_info"}


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, and where it was first seen."""

    level: str
    name: str  #: one of `KINDS`
    what: str
    where: str  #: a step, an attribute, a file and line; may be empty
    mend: str

    def __str__(self) -> str:
        where = f" ({self.where})" if self.where else ""
        return f"{self.level:<6}  {self.name}: {self.what}{where}; {self.mend}"


class Findings(dict[str, Finding]):
    """The first finding of each name."""

    def __init__(self) -> None:
        super().__init__()
        self.since = time.monotonic()  #: when the environment was last called

    def add(self, name: str, what: str, where: str = "") -> None:
        """Add a finding, unless that name was found before; long texts are shortened."""
        level, mend = KINDS[name]
        self.setdefault(name, Finding(level, name, " ".join(what.split())[:160], where, mend))


class Step(NamedTuple):
    """The outcome of a step, with digests in place of observations."""

    obs: int
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    start: int | None = None  #: the first observation of the next episode, if this one ended
    seconds: float = 0.0


def play(
    found: Findings,
    env: Env,
    n_steps: int,
    before: Callable[[], object] = lambda: None,
    same_action: bool = False,
) -> list[Step]:
    """Play episodes with random actions, the same ones each time, and look at every step.

    ``before`` is called before each step; ``same_action`` repeats an episode's first action.
    """
    # An environment may make its own space anew, or seed it, in `reset`.
    space, actions = env.observation_space, copy.deepcopy(env.action_space)
    actions.seed(SEED_OF_ACTIONS)
    obs, action, until = env.reset(seed=SEED)[0], None, time.monotonic() + MOST_SECONDS
    _look_at_observation(found, space, obs, "step 0")
    steps = [Step(seen := digest(obs))]
    while len(steps) <= n_steps and time.monotonic() < until:
        where = f"step {len(steps)}"
        before()
        action = action if same_action and action is not None else chosen(env, actions)
        found.since, begin = time.monotonic(), time.perf_counter()
        outcome = env.step(copy.deepcopy(action))
        seconds = time.perf_counter() - begin
        if digest(obs) != seen:
            found.add("observation-in-place", "a step changes the last observation", where)
        obs, _, terminated, truncated, _ = outcome
        _look_at_observation(found, space, obs, where)
        reward, seen = _look_at_outcome(found, layers_of(env), outcome, where), digest(obs)
        step = Step(seen, reward, bool(terminated), bool(truncated), seconds=seconds)
        if terminated or truncated:
            obs, action = env.reset()[0], None
            _look_at_observation(found, space, obs, where)
            step = step._replace(start=(seen := digest(obs)))
        steps.append(step)
    return steps


def layers_of(env: Any) -> list[Any]:
    """The wrappers of an environment from the outermost on, and the environment itself."""
    return [env, *(layers_of(env.env) if isinstance(env, gym.Wrapper) else [])]


def digest(value: Any) -> int:
    """A hash of an observation, equal where all numbers and texts are."""
    if isinstance(value, Mapping | tuple):
        parts = value.values() if isinstance(value, Mapping) else value
        return hash(tuple(map(digest, parts)))
    array = np.asarray(value)
    return hash(array.shape if array.dtype.hasobject else array.tobytes())


def chosen(env: Env, actions: Any) -> Any:
    """A random action, a valid one where the environment has masks."""
    masks = action_masks(env)
    if masks is None or not isinstance(actions, spaces.Discrete):
        return actions.sample()
    return actions.sample(mask=masks.astype(np.int8))


def first_difference(one: list[Step], other: list[Step]) -> str:
    """The first step in which two plays differ; empty if there is none."""
    pairs = enumerate(zip(one, other, strict=False))
    return next((f"step {number}" for number, (a, b) in pairs if a[:5] != b[:5]), "")


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
    actions = copy.deepcopy(env.action_space)
    actions.seed(SEED)
    for call, wanted in (("reset", START), ("step", ACTION)):
        if call == "step":
            given = env.step(actions.sample())
        if not isinstance(given, tuple) or len(given) != len(wanted.split()):
            told = f"{len(given)} values" if isinstance(given, tuple) else "one value"
            found.add("old-api", f"{call} returns {told}, not {wanted}", call)
            return


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
    is_finite = is_number and bool(np.isfinite(array).all())
    if is_finite and space.contains(obs) and (is_array or not isinstance(space, spaces.Box)):
        return
    name, told = "observation-not-in-space", f"the observation {shown(obs)} is not in {space}"
    if isinstance(space, spaces.Box) and array.shape != space.shape:
        told = f"the observation has the shape {array.shape}, and its space the shape {space.shape}"
    elif is_number and not is_finite:
        name, told = "observation-nan", "the observation holds nan or infinity"
    elif isinstance(space, spaces.Box) and is_number:
        name, kind = "observation-dtype", array.dtype if is_array else f"a {type(obs).__name__}"
        told = f"observations are {kind}, and their space is {space.dtype}"
        if not ((array >= space.low) & (array <= space.high)).all():
            told = f"observations leave their space: values from {array.min():g} to {array.max():g}"
            name = "observation-out-of-bounds"
    found.add(name, told, where)


def _look_at_outcome(found: Findings, layers: list[Any], outcome: Any, where: str) -> float:
    """Look at the types, numbers and names in the rest of an outcome; return the reward."""
    for name, kind, value in zip(ACTION.split(", "), TYPES, outcome, strict=True):
        if not isinstance(value, kind):
            found.add("outcome-type", f"{name} is {shown(value)}", where)
    _, reward, terminated, truncated, info = outcome
    reward = float(reward) if isinstance(reward, Real) else 0.0
    if not math.isfinite(reward):
        found.add("reward-nan", f"the reward is {reward}", where)
        reward = 0.0
    limits: list[Any] = [layer for layer in layers if isinstance(layer, gym.wrappers.TimeLimit)]
    if not truncated and any(one._elapsed_steps >= one._max_episode_steps for one in limits):
        found.add("truncation-lost", "a time limit ends the episode, and truncated is False", where)
    is_counted = any(type(layer).__name__ in STATISTICS for layer in layers)
    own = RESERVED & info.keys() if isinstance(info, Mapping) else set()
    if "episode" in own and not (is_counted and (terminated or truncated)):
        found.add("info-episode", "the environment's own info['episode'] is left out", where)
    for key in own - {"episode"}:
        if key != "TimeLimit.truncated" or info[key] != (truncated and not terminated):
            found.add("info-key", f"the environment's own info[{key!r}] is overwritten", where)
    return reward


def tried(spec: TrainSpec) -> tuple[TrainSpec, list[str]]:
    """The spec, with a wrapper where the environment needs one, and notes on the environment.

    Raises UserError where nothing can learn. The state of global generators is as before.
    """
    if getattr(creator_of(spec.env_id), "__module__", "").partition(".")[0] in KNOWN:
        return spec, []
    import torch as th

    states = random.getstate(), np.random.get_state(), th.get_rng_state()  # noqa: NPY002
    make = partial(make_single_env, spec, training=True, disable_env_checker=True)
    found = Findings()
    with suppress(Exception, SystemExit):  # of the user's code: training will meet it
        with closing(make()) as env:
            look_at_calls(found, env.unwrapped)
        with closing(make()) as env, closing(make()) as other:
            if not found:
                look_at_seed(found, play(found, env, N_STEPS), play(found, other, N_STEPS))
    random.setstate(states[0])
    np.random.set_state(states[1])  # noqa: NPY002
    th.set_rng_state(states[2])
    for one in [found[name] for name in UNUSABLE if name in found]:
        place = f"at {one.where} " if one.where.startswith("step ") else ""
        raise UserError(f"{spec.env_id}: {place}{one.what}; {one.mend}")
    if "info-episode" in found:
        spec = spec.changed(env_wrapper=[*spec.env_wrapper, Component(name=WITHOUT_EPISODE)])
    return spec, [f"{one.what} (from {one.where} on): {one.mend}" for one in found.values()]
