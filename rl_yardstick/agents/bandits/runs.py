"""Many independent runs of one bandit agent: compiled in a batch, or one by one."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

from rl_yardstick.agents.bandits.choosing import Regressions, ScoreTables
from rl_yardstick.agents.bandits.linear import LinearBanditAgent
from rl_yardstick.agents.bandits.rules import Thompson
from rl_yardstick.agents.bandits.tables import TableBandit
from rl_yardstick.agents.compiled.engine import check_class
from rl_yardstick.agents.compiled.env_states import COMPENSATED_SUM
from rl_yardstick.agents.compiled.learning_algorithm import compiled_schedule
from rl_yardstick.agents.compiled.loop import learn_from_last_step, run_block
from rl_yardstick.agents.compiled.references import generator_of, handles_of
from rl_yardstick.agents.compiled.worlds import EPISODE, NotCompilable, env_dtype
from rl_yardstick.agents.registry import load_algorithm
from rl_yardstick.envs.bandits import BernoulliBandit, GaussianBandit, LinearBandit, SegmentBandit
from rl_yardstick.envs.known_models import time_limit
from rl_yardstick.envs.wrappers import ActionMasks
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints

# Bandits for compiled code, and a pull of an arm.
#
# A `BanditModel` makes the same draws from the environment's generator, in the same order, as the
# environments in `envs.bandits` do.

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
    """Whether the feedback of the latest pulls is due after ``pulls`` pulls."""
    at_the_end = pulls == model.pulls or (model.time_limit > 0 and pulls == model.time_limit)
    return pulls % model.batch_size == 0 or at_the_end


@inlined
def pull_click(model: BanditModel, arm: int, rng: np.random.Generator) -> float:
    """Reward 0 or 1; one random number decides on the reward and the next context."""
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
    """The expected reward with normal noise, in single precision as in vector environments."""
    reward = model.expected[arm] + model.reward_std * rng.standard_normal()
    if model.kind == LINEAR:
        for i in range(len(model.vector)):
            model.vector[i] = np.float32(2.0 * rng.random() - 1.0)
    elif model.drift_std > 0.0:
        for other in range(len(model.expected)):
            model.means[0, other] += model.drift_std * rng.standard_normal()
    return float(np.float32(reward))


class BanditModel(NamedTuple):
    """A bandit within an episode. Arrays that its kind does not need hold one number."""

    kind: int  # `CLICKS`, `GAUSSIAN` or `LINEAR`
    batch_size: int  # pulls from one feedback to the next
    pulls: int  # after this number of pulls feedback is due in any case
    time_limit: int  # pulls after which the episode ends, and feedback is due; 0 for never
    reward_std: float  # standard deviation of the noise on a reward
    drift_std: float  # standard deviation of the noise added to all means after each pull
    means: Floats  # expected rewards, shape (contexts, arms); changed in place where they drift
    # Cumulative probabilities of reward and next context, shape (contexts, arms, 2 contexts).
    outcomes: Floats
    arm_parameters: Floats  # of linear rewards, shape (arms, features)
    row: Ints  # the present context, shape (1,); changed in place
    vector: Floats  # the present context as features, shape (features,); changed in place
    expected: Floats  # scratch: expected rewards now, shape (arms,)

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
        """Do nothing: a model is one episode; the environment itself draws the next one."""


class PullRecord(NamedTuple):
    """The record of each pull; all but `episodes` of shape (pulls,), filled in by the loop."""

    episodes: NDArray[Any]  # buffer for the one episode that ends
    arms: NDArray[np.int16]
    rewards: NDArray[np.float32]
    regrets: Floats
    contexts: NDArray[np.int32]

    @inlined
    def note_step(self, env: Any, i: int, step: int) -> None:
        """Record the latest pull of the episode."""
        pull = env.elapsed - 1
        self.contexts[pull] = env.obs
        self.arms[pull] = env.action
        self.rewards[pull] = env.reward
        self.regrets[pull] = env.regret


def check_bandit(env: gym.Env[Any, Any]) -> None:
    """Raise `NotCompilable` if the environment or a wrapper has no compiled counterpart."""
    while isinstance(env, gym.Wrapper):
        if not isinstance(env, _HARMLESS_WRAPPERS):
            raise NotCompilable(f"{type(env).__name__} may change what the environment does")
        env = env.env
    if type(env) not in _KINDS:
        raise NotCompilable(f"there is no compiled copy of {type(env).__name__}")


def bandit_model(env: gym.Env[Any, Any]) -> BanditModel:
    """The episode that has just begun in ``env``, which must have passed `check_bandit`."""
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


@dataclass(frozen=True)
class BatchResult:
    """A row for each run, a column for each pull."""

    seeds: Ints  # of the runs, shape (n_runs,)
    arms: NDArray[np.int16]  # int16 of shape (n_runs, pulls)
    rewards: NDArray[np.float32]  # float32 of shape (n_runs, pulls)
    # Best expected reward less that of the arm, at each pull, float64 of shape (n_runs, pulls).
    regrets: Floats
    # Int32 of shape (n_runs, pulls); None if there is only one context, or contexts are vectors.
    contexts: NDArray[np.int32] | None = None
    # Of the mean rewards at the end, shape (n_runs, contexts, arms), nan where the agent has none;
    # None for agents without a table.
    estimates: Floats | None = None
    # Of linear agents at the end, shape (n_runs, arms, features); None for others.
    coefficients: Floats | None = None
    moments: tuple[int, ...] = ()  # numbers of pulls after which posteriors are recorded
    # Of Thompson sampling, shape (n_runs, moments, contexts, arms, 2): parameters of the Beta
    # distribution, or mean and standard deviation; None for others.
    posteriors: Floats | None = None

    @property
    def optimal(self) -> Bools:
        """Whether the arm was a best one, shape (n_runs, pulls)."""
        return np.asarray(self.regrets == 0.0)


# Thousands of independent runs of one agent, each a fresh agent and one episode.
#
# A run with seed s is bit for bit the same as ``learn(pulls)`` of
# ``Agent(env=Monitor(gym.make(env_id)), seed=s)``.

DEFAULT_MOMENTS = (10, 100, 1000)


def run_batch(
    algorithm: str | type[Any],
    kwargs: Mapping[str, Any] | None,
    env_id: str,
    env_kwargs: Mapping[str, Any] | None,
    seeds: Iterable[int],
    pulls: int | None = None,
    moments: Sequence[int] = DEFAULT_MOMENTS,
) -> BatchResult:
    """Run the agent once for each seed.

    Args:
        algorithm: a bandit agent's name in the registry, or its class.
        kwargs: arguments of its constructor, without environment and seed.
        env_id: a bandit.
        env_kwargs: its arguments.
        seeds: of the runs; each seeds an agent and its environment.
        pulls: pulls of a run, at most those of an episode (the default).
        moments: numbers of pulls after which Thompson sampling's posteriors are recorded, beside
            the end.

    Raises:
        NotCompilable: with the reason, if there is no compiled copy; use `run_one_by_one` then.
        ValueError: if an argument does not fit.
    """
    cls = load_algorithm(algorithm) if isinstance(algorithm, str) else algorithm
    if not issubclass(cls, TableBandit | LinearBanditAgent):
        raise NotCompilable(f"{cls.__name__} acts and learns in Python")
    check_class(cls)
    env = gym.make(env_id, **(env_kwargs or {}))
    try:
        check_bandit(env)
        agent: Any = cls(env=env, **(kwargs or {}))
        agent.check_kinds(agent.env)
        agent.check_compilable()
        runs = Runs(agent, env, np.array(list(seeds), dtype=np.int64), pulls, moments)
        for index in range(len(runs.seeds)):
            runs.run(index)
    finally:
        env.close()
    return runs.result()


def checked_pulls(env: gym.Env[Any, Any], pulls: int | None) -> int:
    """The length of a run."""
    limit = time_limit(env)
    if limit is None:
        raise NotCompilable("an episode never ends")
    if pulls is None:
        return limit
    if not 1 <= pulls <= limit:
        raise ValueError(f"pulls must lie between 1 and {limit}, an episode, not {pulls}")
    return pulls


class Runs:
    """All runs of a batch, with arrays for their results."""

    def __init__(
        self,
        agent: Any,
        env: gym.Env[Any, Any],
        seeds: Ints,
        pulls: int | None,
        moments: Sequence[int],
    ) -> None:
        self.agent, self.env, self.seeds = agent, env, seeds
        self.n_pulls = checked_pulls(env, pulls)
        self.moments: tuple[int, ...] = ()
        if isinstance(agent, Thompson):
            within = {moment for moment in moments if 0 < moment < self.n_pulls}
            self.moments = (*sorted(within), self.n_pulls)
        bandit: Any = env.unwrapped
        self.capacity = min(bandit.batch_size, self.n_pulls)
        shape = (len(seeds), self.n_pulls)
        self.arms = np.empty(shape, np.int16)
        self.rewards = np.empty(shape, np.float32)
        self.regrets = np.empty(shape)
        self.contexts = np.empty(shape, np.int32)
        self.known: dict[str, Any] = {
            name: np.repeat(value.numpy()[None], len(seeds), axis=0)
            for name, value in agent.policy.state_dict().items()
        }
        self.kept: dict[str, Any] = {
            name: np.empty((len(seeds), len(self.moments), *known.shape[1:]), known.dtype)
            for name, known in self.known.items()
        }
        self.start: NDArray[Any] = agent.progress()  # of a training, at its first pull
        self.start["total_timesteps"], self.start["remaining"] = self.n_pulls, 1.0
        for name, schedule in agent.schedules().items():
            self.start[f"{name}_schedule"] = compiled_schedule(schedule)

    def run(self, index: int) -> None:
        """Do one run, in blocks that end at the moments."""
        seed = int(self.seeds[index])
        self.env.reset(seed=seed)
        self.agent.env = None
        self.agent.set_random_seed(seed)
        model = bandit_model(self.env)
        handles = handles_of([self.env.unwrapped.np_random])
        agent = self._compiled_agent(index, model)
        record = PullRecord(
            np.zeros(1, dtype=EPISODE),
            self.arms[index],
            self.rewards[index],
            self.regrets[index],
            self.contexts[index],
        )
        envs, progress = np.zeros(1, dtype=BANDIT_ENV), self.start.copy()
        envs["obs"] = model.row
        done = 0
        for moment, end in enumerate(self.moments or (self.n_pulls,)):
            arguments = model, agent, envs, handles, progress[0], record, end - done, 2
            run_block(*arguments, COMPENSATED_SUM)
            learn_from_last_step(agent, envs, progress[0])
            done = end
            for name, kept in self.kept.items():
                if self.moments:
                    kept[index, moment] = self.known[name][index]

    def _compiled_agent(self, index: int, model: BanditModel) -> Any:
        known: dict[str, Any] = {name: each[index] for name, each in self.known.items()}
        rng = self.agent.rng
        if isinstance(self.agent, LinearBanditAgent):
            models = Regressions(**known)
            return self.agent.compiled_agent(rng, models, self.capacity, model.vector)
        return self.agent.compiled_agent(rng, ScoreTables(**known), self.capacity)

    def result(self) -> BatchResult:
        """The results of all runs."""
        n_contexts, posteriors = self.env.unwrapped.n_contexts, None  # type: ignore[attr-defined]
        if isinstance(self.agent, Thompson):
            posteriors = self.agent.posterior(ScoreTables(**self.kept))
        return BatchResult(
            self.seeds,
            self.arms,
            self.rewards,
            self.regrets,
            self.contexts if n_contexts > 1 else None,
            moments=self.moments,
            posteriors=posteriors,
            **_knowledge(self.agent, self.known),
        )


class PullLog(BaseCallback):
    """Records each pull from the environments' ``info``, in about 25 bytes.

    If an environment does not know the expected rewards of its arms, these and the regrets are nan,
    and no arm counts as optimal.
    """

    def __init__(self) -> None:
        super().__init__()
        self._obs: Any = None
        self._columns: dict[str, array[Any]] = {
            "arms": array("h"),
            "rewards": array("f"),
            "expected_rewards": array("d"),
            "regrets": array("d"),
            "matched": array("b"),
            "contexts": array("i"),
        }

    def _on_training_start(self) -> None:
        self._obs = self.model._last_obs
        if not isinstance(self.training_env.observation_space, spaces.Discrete):
            self._columns.pop("contexts", None)

    def _on_step(self) -> bool:
        infos, columns = self.locals["infos"], self._columns
        columns["arms"].extend(np.ravel(self.locals["actions"]).tolist())
        columns["rewards"].extend(self.locals["rewards"].tolist())
        columns["expected_rewards"].extend(i.get("expected_reward", np.nan) for i in infos)
        columns["regrets"].extend(info.get("regret", np.nan) for info in infos)
        columns["matched"].extend(info.get("matched", True) for info in infos)
        if "contexts" in columns:
            columns["contexts"].extend(np.ravel(self._obs).tolist())
        self._obs = self.locals["new_obs"]
        return True

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All pulls so far."""
        n_envs = self.training_env.num_envs
        arrays: dict[str, NDArray[Any]] = {
            name: np.array(column).reshape(-1, n_envs).T for name, column in self._columns.items()
        }
        arrays["matched"] = arrays["matched"].astype(np.bool_)
        arrays["optimal"] = arrays["regrets"] == 0.0
        return arrays


def run_one_by_one(
    algorithm: str | type[Any],
    kwargs: Mapping[str, Any] | None,
    env_id: str,
    env_kwargs: Mapping[str, Any] | None,
    seeds: Iterable[int],
    pulls: int | None = None,
) -> BatchResult:
    """The same as `run_batch`, step by step, for any agent that fits.

    Arguments as there; agents of Stable-Baselines3 need ``policy`` in ``kwargs``. Posteriors are
    not recorded.
    """
    cls = load_algorithm(algorithm) if isinstance(algorithm, str) else algorithm
    numbers = list(seeds)
    runs = [_run(cls, kwargs or {}, env_id, env_kwargs or {}, seed, pulls) for seed in numbers]
    names = ("arms", "rewards", "regrets", "contexts", "estimates", "coefficients")
    found: dict[str, Any] = {
        name: np.stack([run[name] for run in runs]) for name in names if name in runs[0]
    }
    return BatchResult(np.array(numbers, dtype=np.int64), **found)


def _run(
    cls: type[Any],
    kwargs: Mapping[str, Any],
    env_id: str,
    env_kwargs: Mapping[str, Any],
    seed: int,
    pulls: int | None,
) -> dict[str, Any]:
    """The arrays of one run, without their first axis."""
    made = gym.make(env_id, **env_kwargs)
    env = Monitor(ActionMasks(made) if kwargs.get("mask_actions") else made)
    log = PullLog()
    try:
        n_pulls = checked_pulls(env, pulls)
        agent = cls(env=env, seed=seed, **kwargs)
        agent.learn(n_pulls, callback=log)
        # Agents that collect whole rollouts take more steps than asked for.
        run = {name: array[0, :n_pulls] for name, array in log.arrays().items()}
    finally:
        env.close()
    if getattr(env.unwrapped, "n_contexts", 0) <= 1:
        run.pop("contexts", None)
    known = {name: value.cpu().numpy() for name, value in agent.policy.state_dict().items()}
    return {**run, **_knowledge(agent, known)}


def _knowledge(agent: Any, known: Mapping[str, Any]) -> dict[str, Any]:
    """A bandit agent's estimates and coefficients, given the tables of one or of many runs."""
    if isinstance(agent, TableBandit):
        tables = ScoreTables(known["scores"], known["sums"], known["counts"])
        return {"estimates": agent.estimates(tables)}
    if not isinstance(agent, LinearBanditAgent):
        return {}
    found = {"coefficients": known["coefficients"]}
    if isinstance(agent.observation_space, spaces.Discrete):
        found["estimates"] = known["coefficients"].swapaxes(-1, -2)
    return found
