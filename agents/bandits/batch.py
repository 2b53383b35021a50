"""Thousands of independent runs of one agent, each a fresh agent and one episode.

    run_batch("ucb", {"c": 2.0, "variant": "sutton_barto"}, "GaussianBandit-v0", {}, range(2000))

A run with seed s does, bit for bit, what ``Agent(env=Monitor(gym.make(env_id)), seed=s)`` does in
``learn(pulls)``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from agents.bandits.batch_result import BatchResult
from agents.bandits.linear_agent import Regressions
from agents.bandits.linear_bandits import LinearBanditAgent
from agents.bandits.reward_checks import check_kinds
from agents.bandits.score_agent import ScoreTables
from agents.bandits.table_bandit import TableBandit
from agents.bandits.thompson import Thompson
from agents.compiled.bandit_model import (
    BANDIT_ENV,
    BanditModel,
    PullRecord,
    bandit_model,
    check_bandit,
)
from agents.compiled.compile_envs import NotCompilable
from agents.compiled.engine_choice import check_class
from agents.compiled.env_state import COMPENSATED_SUM
from agents.compiled.generators import handles_of
from agents.compiled.learning_algorithm import compiled_schedule
from agents.compiled.loop import learn_from_last_step, run_block
from agents.compiled.training_records import EPISODE
from agents.registry import load_algorithm
from envs.known_models import time_limit
from mdp.array_types import Ints

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
        algorithm: a bandit agent's name in the table of agents, or its class.
        kwargs: arguments of its constructor, without environment and seed.
        env_id: a bandit.
        env_kwargs: its arguments.
        seeds: of the runs; each seeds an agent and its environment.
        pulls: pulls of a run, at most an episode, which is the default.
        moments: after how many pulls Thompson sampling's posteriors are kept, beside the last.

    Raises:
        NotCompilable: saying why, where there is no compiled copy; `run_one_by_one` does it then.
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
        check_kinds(agent, agent.env)
        agent.check_compilable()
        runs = Runs(agent, env, np.array(list(seeds), dtype=np.int64), pulls, moments)
        for index in range(len(runs.seeds)):
            runs.run(index)
    finally:
        env.close()
    return runs.result()


def checked_pulls(env: gym.Env[Any, Any], pulls: int | None) -> int:
    """The length of a run.

    Raises:
        ValueError: if it is not within an episode.
    """
    limit = time_limit(env)
    if limit is None:
        raise NotCompilable("an episode never ends")
    if pulls is None:
        return limit
    if not 1 <= pulls <= limit:
        raise ValueError(f"pulls must lie between 1 and {limit}, an episode, not {pulls}")
    return pulls


def run_moments(moments: Sequence[int], n_pulls: int) -> tuple[int, ...]:
    """The moments within a run, and its end."""
    return tuple(sorted({m for m in moments if 0 < m < n_pulls} | {n_pulls}))


class Runs:
    """All runs of a batch, with room for what comes of them.

    Args:
        agent: an agent of the kind, untrained.
        env: the environment that it was built on; each run resets it.
        seeds: of the runs, shape (n_runs,).
        pulls: pulls of a run, or None for an episode.
        moments: when to keep tables.
    """

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
        self.moments = run_moments(moments, self.n_pulls) if isinstance(agent, Thompson) else ()
        bandit: Any = env.unwrapped
        self.capacity = min(bandit.batch_size, self.n_pulls)
        shape = (len(seeds), self.n_pulls)
        self.arms = np.empty(shape, np.int16)
        self.rewards = np.empty(shape, np.float32)
        self.regrets = np.empty(shape)
        self.contexts = np.empty(shape, np.int32)
        self.known = {
            name: np.repeat(value.numpy()[None], len(seeds), axis=0)
            for name, value in agent.policy.state_dict().items()
        }
        self.kept = {
            name: np.empty((len(seeds), len(self.moments), *array.shape[1:]), array.dtype)
            for name, array in self.known.items()
        }
        self.start = self._start_of_training()

    def _start_of_training(self) -> np.ndarray[Any, np.dtype[np.void]]:
        """How far a training is at its first pull.

        Raises:
            NotCompilable: if a schedule is a Python function.
        """
        progress = self.agent.progress()
        progress["total_timesteps"], progress["remaining"] = self.n_pulls, 1.0
        for name, schedule in self.agent.schedules().items():
            progress[f"{name}_schedule"] = compiled_schedule(schedule)
        return np.asarray(progress)

    def run(self, index: int) -> None:
        """One run, in blocks that end at the moments."""
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
            for name, array in self.kept.items():
                if self.moments:
                    array[index, moment] = self.known[name][index]

    def _compiled_agent(self, index: int, model: BanditModel) -> Any:
        known = {name: each[index] for name, each in self.known.items()}
        rng = self.agent.rng
        if isinstance(self.agent, LinearBanditAgent):
            models = Regressions(**known)
            return self.agent.compiled_agent(rng, models, self.capacity, model.vector)
        return self.agent.compiled_agent(rng, ScoreTables(**known), self.capacity)

    def result(self) -> BatchResult:
        """What came of all runs."""
        n_contexts = self.env.unwrapped.n_contexts  # type: ignore[attr-defined]
        estimates = coefficients = posteriors = None
        if isinstance(self.agent, LinearBanditAgent):
            coefficients = self.known["coefficients"]
            if n_contexts > 0:
                estimates = coefficients.transpose(0, 2, 1)
        else:
            estimates = self.agent.estimates(ScoreTables(**self.known))
        if isinstance(self.agent, Thompson):
            posteriors = self.agent.posterior(ScoreTables(**self.kept))
        return BatchResult(
            self.seeds,
            self.arms,
            self.rewards,
            self.regrets,
            self.contexts if n_contexts > 1 else None,
            estimates,
            coefficients,
            self.moments,
            posteriors,
        )
