"""Bandits as compiled code sees them, and a pull of an arm.

A `BanditModel` makes the same draws from the environment's generator, in the same order, as the
environments in `envs.bandits` do.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from numpy.typing import NDArray

from agents.compiled.compile_envs import NotCompilable
from agents.compiled.generators import generator_of
from agents.compiled.training_records import env_dtype
from envs.bandits import BernoulliBandit, GaussianBandit, LinearBandit, SegmentBandit
from envs.known_models import time_limit
from machine_code.compiling import inlined
from mdp.array_types import Floats, Ints

CLICKS = 0
GAUSSIAN = 1
LINEAR = 2

# Exact types: a subclass may change anything.
_KINDS: dict[type, int] = {
    BernoulliBandit: CLICKS,
    SegmentBandit: CLICKS,
    GaussianBandit: GAUSSIAN,
    LinearBandit: LINEAR,
}
_HARMLESS_WRAPPERS = (OrderEnforcing, PassiveEnvChecker, TimeLimit)

BANDIT_ENV = env_dtype(("regret", np.float64), ("feedback_due", np.bool_))


@inlined
def expect(model: BanditModel) -> float:
    """Fill in the expected reward of each arm now, and return the highest."""
    expected = model.expected
    for arm in range(len(expected)):
        if model.kind == LINEAR:
            expected[arm] = 0.0
            for i in range(len(model.vector)):
                expected[arm] += model.vector[i] * model.arm_parameters[arm, i]
        else:
            expected[arm] = model.means[model.row[0], arm]
    best = expected[0]
    for arm in range(1, len(expected)):
        best = max(best, expected[arm])
    return float(best)


@inlined
def feedback_is_due(model: BanditModel, pulls: int) -> bool:
    """Whether the rewards of the latest pulls come in after ``pulls`` pulls."""
    at_the_end = pulls == model.pulls or (model.time_limit > 0 and pulls == model.time_limit)
    return pulls % model.batch_size == 0 or at_the_end


@inlined
def pull_click(model: BanditModel, arm: int, rng: np.random.Generator) -> float:
    """Reward 0 or 1; one random number decides on it and on the next context."""
    n_contexts = model.means.shape[0]
    old, outcome, uniform = model.row[0], 0, rng.random()
    for k in range(2 * n_contexts):
        if model.outcomes[old, arm, k] > uniform:
            outcome = k
            break
    model.row[0] = outcome % n_contexts
    model.vector[old] = 0.0
    model.vector[model.row[0]] = 1.0
    return 1.0 if outcome < n_contexts else 0.0


@inlined
def pull_noisy(model: BanditModel, arm: int, rng: np.random.Generator) -> float:
    """The expected reward with normal noise, in single precision as vector environments have it."""
    reward = model.expected[arm] + model.reward_std * rng.standard_normal()
    if model.kind == LINEAR:
        for i in range(len(model.vector)):
            model.vector[i] = np.float32(2.0 * rng.random() - 1.0)
    elif model.drift_std > 0.0:
        for other in range(len(model.expected)):
            model.means[0, other] += model.drift_std * rng.standard_normal()
    return float(np.float32(reward))


class BanditModel(NamedTuple):
    """A bandit within an episode. Arrays that its kind does not need hold one number.

    Attributes:
        kind: which dynamics.
        batch_size: pulls between two times at which feedback comes in.
        pulls: after how many it comes in anyway.
        time_limit: after how many the episode ends, and it comes in too; 0 for never.
        reward_std: standard deviation of the noise on a reward.
        drift_std: standard deviation of what is added to all means after each pull.
        means: expected rewards, shape (contexts, arms); changed in place where they drift.
        outcomes: cumulative probabilities of reward and next context, shape (contexts, arms, 2
            contexts).
        arm_parameters: of linear rewards, shape (arms, features).
        row: the present context, shape (1,); changed in place.
        vector: the present context as features, shape (features,); changed in place.
        expected: room for a number for each arm, shape (arms,).
    """

    kind: int
    batch_size: int
    pulls: int
    time_limit: int
    reward_std: float
    drift_std: float
    means: Floats
    outcomes: Floats
    arm_parameters: Floats
    row: Ints
    vector: Floats
    expected: Floats

    @inlined
    def step(self, env: Any, handle: Any) -> None:
        """Pull ``env.action``."""
        rng = generator_of(handle)
        env.regret = expect(self) - self.expected[env.action]
        if self.kind == CLICKS:
            env.reward = pull_click(self, env.action, rng)
        else:
            env.reward = pull_noisy(self, env.action, rng)
        env.monitor_reward = env.reward
        env.terminated = False
        env.next_obs = self.row[0]
        env.feedback_due = feedback_is_due(self, env.elapsed + 1)

    @inlined
    def reset(self, env: Any, handle: Any) -> None:
        """Do nothing: a model is one episode, and the environment itself draws the next."""


class PullRecord(NamedTuple):
    """What happens at each pull; all of shape (pulls,), filled in by the loop.

    Attributes:
        episodes: room for the one episode that ends.
    """

    episodes: NDArray[Any]
    arms: NDArray[np.int16]
    rewards: NDArray[np.float32]
    regrets: Floats
    contexts: NDArray[np.int32]

    @inlined
    def note_step(self, env: Any, i: int, step: int) -> None:
        """Write down the pull at which the episode is."""
        pull = env.elapsed - 1
        self.contexts[pull] = env.obs
        self.arms[pull] = env.action
        self.rewards[pull] = env.reward
        self.regrets[pull] = env.regret

    @inlined
    def note_progress(self, progress: Any, step: int) -> None:
        """Pulls are all that is written down."""


def check_bandit(env: gym.Env[Any, Any]) -> None:
    """Make sure that there is compiled code for the environment and all its wrappers.

    Raises:
        NotCompilable: saying what there is none for.
    """
    while isinstance(env, gym.Wrapper):
        if not isinstance(env, _HARMLESS_WRAPPERS):
            raise NotCompilable(f"{type(env).__name__} may change what the environment does")
        env = env.env
    if type(env) not in _KINDS:
        raise NotCompilable(f"there is no compiled copy of {type(env).__name__}")


def bandit_model(env: gym.Env[Any, Any]) -> BanditModel:
    """The episode that has just begun in ``env``, which `check_bandit` has passed."""
    bandit: Any = env.unwrapped
    kind = _KINDS[type(bandit)]
    nothing = np.zeros((1, 1))
    is_linear = kind == LINEAR
    return BanditModel(
        kind,
        bandit.batch_size,
        bandit.pulls,
        time_limit(env) or 0,
        0.0 if kind == CLICKS else float(bandit.reward_std),
        float(bandit.drift_std) if kind == GAUSSIAN else 0.0,
        nothing if is_linear else np.array(bandit.means, dtype=np.float64),
        np.asarray(bandit.outcome_cumulative) if kind == CLICKS else np.zeros((1, 1, 1)),
        np.asarray(bandit.arm_parameters) if is_linear else nothing,
        np.array([0 if is_linear else bandit.context], dtype=np.int64),
        np.array(bandit.context, dtype=np.float64)
        if is_linear
        else np.eye(bandit.n_contexts)[bandit.context],
        np.empty(bandit.n_arms),
    )
