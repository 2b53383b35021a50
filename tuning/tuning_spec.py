"""What a tuning is asked to do, as one immutable value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from agents import ALGORITHMS
from experiments.study import COSTS, METRICS, AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError
from pipeline.files import plain

Sampler = Literal["tpe", "gp", "random", "grid", "cmaes"]
Objective = Literal["mean", "iqm", "lower"]
SAMPLERS: tuple[Sampler, ...] = get_args(Sampler)
OBJECTIVES: tuple[Objective, ...] = get_args(Objective)

# What a run is judged by: a figure of compare's, the score, or what a threshold took.
FIGURES = ("score", *METRICS, "steps", "seconds")
CHEAPER_IS_BETTER = (*COSTS, "steps", "seconds")

AUTO = "auto"

SHIPPED = "shipped"

# What may change when a tuning goes on; all else makes another tuning.
_MAY_CHANGE = ("study", "n_trials", "retest", "retest_seeds", "first_retest_seed")


@dataclass(frozen=True)
class TuningSpec:
    """A search over settings of one agent on one environment, and the re-test of what it finds.

    Attributes:
        study: the agent, called `SHIPPED`, as it is without the search, the environment, and what
            every run has in common. Its seeds are those of trials. What the agent's ``settings``
            say holds in every trial, whatever is suggested.
        n_trials: how many settings to try.
        figure: what a run is judged by, one of `FIGURES`; or `AUTO`, until it is known what the
            runs are.
        objective: how a setting is judged by its seeds: by their mean, their interquartile mean, or
            the quarter below which the worst lie.
        sampler: what suggests settings.
        pruner: what ends trials early.
        n_startup_trials: how many are drawn at random before the sampler learns from them.
        seed: of the sampler, and of the order of seeds.
        search_space: a file with the space to search; None for the agent's own.
        retest: how many of the best are run again on other seeds.
        retest_seeds: on how many.
        first_retest_seed: the first of them.
    """

    study: StudySpec
    n_trials: int = 100
    figure: str = AUTO
    objective: Objective = "mean"
    sampler: Sampler = "tpe"
    pruner: str = "auto"
    n_startup_trials: int = 10
    seed: int = 0
    search_space: Path | None = None
    retest: int = 3
    retest_seeds: int = 20
    first_retest_seed: int = 1000

    @property
    def agent(self) -> AgentSpec:
        """The agent as it is without the search."""
        return self.study.agents[0]

    @property
    def environment(self) -> EnvironmentSpec:
        """Where it is tuned."""
        return self.study.environments[0]

    @property
    def is_cost(self) -> bool:
        """Whether the lower figure is the better."""
        return self.figure in CHEAPER_IS_BETTER

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of every trial, in the order in which all of them go through these."""
        order = np.random.default_rng(self.seed).permutation(self.study.n_seeds)
        return tuple(self.study.first_seed + int(place) for place in order)

    @property
    def held_out(self) -> range:
        """The seeds of the re-test."""
        return range(self.first_retest_seed, self.first_retest_seed + self.retest_seeds)

    def searched(self, entry: Mapping[str, Any]) -> dict[str, Any]:
        """Settings as the search runs them, which may be on another engine than the agent's own.

        The library's agents compile wherever ``auto`` does, unless somebody says otherwise. The
        re-test is of what will be used, and leaves them to the engine that they train in.
        """
        engines = ALGORITHMS[self.agent.algo].engines
        return {**({"engine": "auto"} if "auto" in engines[1:] else {}), **entry}

    def check(self) -> None:
        """Make sure that nothing is judged on what it was chosen by.

        Raises:
            UserError: if seeds of the search are among those of the re-test.
        """
        shared = sorted(set(self.seeds) & set(self.held_out))
        if self.retest and shared:
            raise UserError(
                f"seed {shared[0]} is one of the search and of the re-test: what is chosen by its "
                "seeds is judged on others; see --first-seed and --first-retest-seed"
            )

    def identity(self, shipped: Mapping[str, Any], space: Mapping[str, Any]) -> dict[str, Any]:
        """What makes it this tuning and no other, as JSON.

        Args:
            shipped: all settings of the agent as it is without the search.
            space: the distributions of the space, as JSON.
        """
        kept = {key: value for key, value in vars(self).items() if key not in _MAY_CHANGE}
        entry = self.searched(shipped)
        engine = {"search_engine": entry["engine"]} if entry.keys() - shipped.keys() else {}
        data = plain(
            {
                **kept,
                **engine,
                "algo": self.agent.algo,
                "env": self.environment.env_id,
                "hyperparams": dict(shipped),
                "first_seed": self.study.first_seed,
                "seeds_per_trial": self.study.n_seeds,
                "eval_freq": self.study.eval_freq,
                "eval_episodes": self.study.eval_episodes,
                "threshold": self.study.threshold,
                "search_space": dict(space),
            }
        )
        assert isinstance(data, dict)
        return data
