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

from agents.bandits.base import BanditAlgorithm
from agents.bandits.linear import LinearBanditAgent
from agents.bandits.linear_rules import Regressions
from agents.bandits.results import BatchResult
from agents.bandits.rewards import check_kinds
from agents.bandits.rollout import Moments, Pending, Pulls, Scratch, run_regressions, run_tables
from agents.bandits.table_bandit import TableBandit
from agents.bandits.tables import Tables
from agents.bandits.thompson import Thompson
from agents.bandits.worlds import NotBatchable, World, check_world, world_of
from agents.common.schedules import ScheduleRow, schedule_row
from agents.registry import load_algorithm
from envs.known_models import time_limit

DEFAULT_MOMENTS = (10, 100, 1000)

# Where the agents are defined whose rules are compiled; a subclass may change anything.
_KNOWN_MODULES = tuple(
    f"agents.bandits.{name}" for name in ("bounds", "linear", "preferences", "thompson", "values")
)


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
        NotBatchable: saying why, where there is no compiled copy; `run_one_by_one` does it then.
        ValueError: if an argument does not fit.
    """
    cls = load_algorithm(algorithm) if isinstance(algorithm, str) else algorithm
    if not issubclass(cls, BanditAlgorithm) or cls.__module__ not in _KNOWN_MODULES:
        raise NotBatchable(f"{cls.__name__} may act and learn in its own way")
    env = gym.make(env_id, **(env_kwargs or {}))
    try:
        check_world(env)
        agent: Any = cls(env=env, **(kwargs or {}))
        check_kinds(agent, agent.env)
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
        raise NotBatchable("an episode never ends")
    if pulls is None:
        return limit
    if not 1 <= pulls <= limit:
        raise ValueError(f"pulls must lie between 1 and {limit}, an episode, not {pulls}")
    return pulls


def compiled_schedule(schedule: Any) -> ScheduleRow:
    """The schedule as compiled code reads it.

    Raises:
        NotBatchable: if it is a Python function.
    """
    row = schedule_row(schedule)
    if row is None:
        raise NotBatchable("a schedule is a Python function")
    return row


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
        seeds: np.ndarray[Any, np.dtype[np.int64]],
        pulls: int | None,
        moments: Sequence[int],
    ) -> None:
        self.agent, self.env, self.seeds = agent, env, seeds
        self.n_pulls = checked_pulls(env, pulls)
        self.exploration = compiled_schedule(agent.exploration_schedule)
        self.learning_rate = compiled_schedule(agent.lr_schedule)
        self.settings = agent.settings
        shape = (len(seeds), self.n_pulls)
        self.pulls = Pulls(
            np.empty(shape, np.int16),
            np.empty(shape, np.float32),
            np.empty(shape),
            np.empty(shape, np.int32),
        )
        self.known = {
            name: np.repeat(value.numpy()[None], len(seeds), axis=0)
            for name, value in agent.policy.state_dict().items()
        }
        self.moments = run_moments(moments, self.n_pulls)
        self._make_room()

    def _make_room(self) -> None:
        n_arms, bandit = self.agent.n_arms, self.env.unwrapped
        n_features = getattr(bandit, "n_features", 0) or bandit.n_contexts  # type: ignore[attr-defined]
        size = min(bandit.batch_size, self.n_pulls)  # type: ignore[attr-defined]
        self.pending = Pending(
            np.empty(size, np.int64),
            np.empty((size, n_features)),
            np.empty(size, np.int64),
            np.empty(size),
            np.empty(size),
        )
        self.scratch = Scratch(
            np.empty(n_arms), np.empty(n_arms), np.empty(2), np.empty(n_features)
        )
        kept = isinstance(self.agent, Thompson)
        shape = (len(self.seeds), len(self.moments) if kept else 0, 0, n_arms)
        if isinstance(self.agent, TableBandit):
            shape = (*shape[:2], len(self.agent.policy.scores), n_arms)
        self.kept = Tables(np.empty(0), np.empty(shape), np.empty(shape, np.int64))

    def run(self, index: int) -> None:
        """One run."""
        seed = int(self.seeds[index])
        self.env.reset(seed=seed)
        world = world_of(self.env)
        self.agent.env = None
        self.agent.set_random_seed(seed)
        rngs = self.env.unwrapped.np_random, self.agent.rng
        pulls = Pulls(*(each[index] for each in self.pulls))
        if isinstance(self.agent, LinearBanditAgent):
            run_regressions(
                world,
                self.settings,
                Regressions(**{name: each[index] for name, each in self.known.items()}),
                self.exploration,
                *rngs,
                pulls,
                self.pending,
                self.scratch,
            )
        else:
            self._run_tables(index, world, rngs, pulls)

    def _run_tables(
        self,
        index: int,
        world: World,
        rngs: tuple[np.random.Generator, np.random.Generator],
        pulls: Pulls,
    ) -> None:
        kept = self.kept.sums[index], self.kept.counts[index]
        moments = np.array(self.moments[: len(kept[0])], dtype=np.int64)
        run_tables(
            world,
            self.settings,
            Tables(**{name: each[index] for name, each in self.known.items()}),
            self.agent.ignore_context,
            self.exploration,
            self.learning_rate,
            *rngs,
            pulls,
            self.pending,
            Moments(moments, *kept),
            self.scratch,
        )

    def result(self) -> BatchResult:
        """What all runs came to."""
        n_contexts = self.env.unwrapped.n_contexts  # type: ignore[attr-defined]
        estimates = coefficients = posteriors = None
        if isinstance(self.agent, LinearBanditAgent):
            coefficients = self.known["coefficients"]
            if n_contexts > 0:
                estimates = coefficients.transpose(0, 2, 1)
        else:
            estimates = self.agent.estimates(Tables(**self.known))
        if isinstance(self.agent, Thompson):
            posteriors = self.agent.posterior(self.kept)
        return BatchResult(
            self.seeds,
            self.pulls.arms,
            self.pulls.rewards,
            self.pulls.regrets,
            self.pulls.contexts if n_contexts > 1 else None,
            estimates,
            coefficients,
            self.moments if posteriors is not None else (),
            posteriors,
        )
