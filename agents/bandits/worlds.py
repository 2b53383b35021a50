"""Bandits as compiled code sees them, and a pull of an arm.

A world makes the same draws from the environment's generator, in the same order, as the
environments in `envs.bandits` do.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from numpy.typing import NDArray

from envs.bandits import BernoulliBandit, GaussianBandit, LinearBandit, SegmentBandit
from envs.known_models import time_limit
from mdp.machine_code import inlined

CLICKS = 0
GAUSSIAN = 1
LINEAR = 2

NEVER = 2**62

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Exact types: a subclass may change anything.
_KINDS: dict[type, int] = {
    BernoulliBandit: CLICKS,
    SegmentBandit: CLICKS,
    GaussianBandit: GAUSSIAN,
    LinearBandit: LINEAR,
}
_HARMLESS_WRAPPERS = (OrderEnforcing, PassiveEnvChecker, TimeLimit)


class NotBatchable(ValueError):  # noqa: N818  # a reason, which callers may take as an answer
    """Why runs cannot be compiled as a batch."""


class World(NamedTuple):
    """A bandit within an episode. Arrays that its kind does not need hold one number.

    Attributes:
        kind: which dynamics.
        batch_size: pulls between two times at which feedback comes in.
        pulls: after how many it comes in anyway.
        limit: after how many the episode ends, and it comes in too.
        reward_std: standard deviation of the noise on a reward.
        drift_std: standard deviation of what is added to all means after each pull.
        means: expected rewards, shape (contexts, arms); changed in place where they drift.
        outcomes: cumulative probabilities of reward and next context, shape (contexts, arms, 2
            contexts).
        arm_parameters: of linear rewards, shape (arms, features).
        row: the present context, shape (1,); changed in place.
        vector: the present context as features, shape (features,); changed in place.
    """

    kind: int
    batch_size: int
    pulls: int
    limit: int
    reward_std: float
    drift_std: float
    means: Floats
    outcomes: Floats
    arm_parameters: Floats
    row: Ints
    vector: Floats


def check_world(env: gym.Env[Any, Any]) -> None:
    """Make sure that there is compiled code for the environment and all its wrappers.

    Raises:
        NotBatchable: saying what there is none for.
    """
    while isinstance(env, gym.Wrapper):
        if not isinstance(env, _HARMLESS_WRAPPERS):
            raise NotBatchable(f"{type(env).__name__} may change what the environment does")
        env = env.env
    if type(env) not in _KINDS:
        raise NotBatchable(f"there is no compiled copy of {type(env).__name__}")


def world_of(env: gym.Env[Any, Any]) -> World:
    """The episode that has just begun in ``env``, which `check_world` has passed."""
    bandit: Any = env.unwrapped
    kind = _KINDS[type(bandit)]
    nothing = np.zeros((1, 1))
    is_linear = kind == LINEAR
    return World(
        kind,
        bandit.batch_size,
        bandit.pulls,
        time_limit(env) or NEVER,
        0.0 if kind == CLICKS else float(bandit.reward_std),
        float(bandit.drift_std) if kind == GAUSSIAN else 0.0,
        nothing if is_linear else np.array(bandit.means, dtype=np.float64),
        np.asarray(bandit.outcome_cumulative) if kind == CLICKS else np.zeros((1, 1, 1)),
        np.asarray(bandit.arm_parameters) if is_linear else nothing,
        np.array([0 if is_linear else bandit.context], dtype=np.int64),
        np.array(bandit.context, dtype=np.float64)
        if is_linear
        else np.eye(bandit.n_contexts)[bandit.context],
    )


@inlined
def expect(world: World, expected: Floats) -> float:
    """Fill in the expected reward of each arm now, and return the highest."""
    for arm in range(len(expected)):
        if world.kind == LINEAR:
            expected[arm] = 0.0
            for i in range(len(world.vector)):
                expected[arm] += world.vector[i] * world.arm_parameters[arm, i]
        else:
            expected[arm] = world.means[world.row[0], arm]
    best = expected[0]
    for arm in range(1, len(expected)):
        best = max(best, expected[arm])
    return float(best)


@inlined
def feedback_is_due(world: World, pulls: int) -> bool:
    """Whether the rewards of the latest pulls come in after ``pulls`` pulls."""
    return pulls % world.batch_size == 0 or pulls in (world.pulls, world.limit)


@inlined
def pull_click(world: World, arm: int, rng: np.random.Generator) -> float:
    """Reward 0 or 1; one random number decides on it and on the next context."""
    n_contexts = world.means.shape[0]
    old, outcome, uniform = world.row[0], 0, rng.random()
    for k in range(2 * n_contexts):
        if world.outcomes[old, arm, k] > uniform:
            outcome = k
            break
    world.row[0] = outcome % n_contexts
    world.vector[old] = 0.0
    world.vector[world.row[0]] = 1.0
    return 1.0 if outcome < n_contexts else 0.0


@inlined
def pull_arm(world: World, arm: int, expected: Floats, rng: np.random.Generator) -> float:
    """The reward of ``arm``, in single precision as vector environments hand it on; in place.

    Args:
        world: the bandit.
        arm: what is pulled.
        expected: from `expect`, shape (arms,).
        rng: the environment's generator.
    """
    if world.kind == CLICKS:
        return pull_click(world, arm, rng)
    reward = expected[arm] + world.reward_std * rng.standard_normal()
    if world.kind == LINEAR:
        for i in range(len(world.vector)):
            world.vector[i] = np.float32(2.0 * rng.random() - 1.0)
    elif world.drift_std > 0.0:
        for other in range(len(expected)):
            world.means[0, other] += world.drift_std * rng.standard_normal()
    return float(np.float32(reward))
