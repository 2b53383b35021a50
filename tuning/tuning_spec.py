"""What a tuning is asked to do, as one immutable value, and what a setting is worth to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from agents import ALGORITHMS
from experiments.study import COSTS, METRICS, AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError
from pipeline.files import plain

Sampler = Literal["tpe", "gp", "random", "grid"]
Objective = Literal["mean", "iqm", "lower"]
SAMPLERS: tuple[Sampler, ...] = get_args(Sampler)
OBJECTIVES: tuple[Objective, ...] = get_args(Objective)

# What a run is judged by: a figure of compare's, the score, or what a threshold took.
FIGURES = ("score", *METRICS, "steps", "seconds")
CHEAPER_IS_BETTER = (*COSTS, "steps", "seconds")

AUTO = "auto"
SHIPPED = "shipped"
LOWER = 0.25

# What may change when a tuning goes on; all else makes another tuning.
_MAY_CHANGE = ("study", "n_trials", "retest", "retest_seeds", "first_retest_seed")


@dataclass(frozen=True)
class TuningSpec:
    """A search over settings of one agent on one environment, and the re-test of what it finds."""

    #: The agent, called `SHIPPED`, as it is without the search, the environment, and what every run
    #: has in common. Its seeds are those of trials. What the agent's ``settings`` say holds in
    #: every trial, whatever is suggested.
    study: StudySpec
    n_trials: int = 100  #: how many settings to try
    figure: str = AUTO  #: one of `FIGURES`; or `AUTO`, until it is known what the runs are
    objective: Objective = "mean"  #: how a setting is judged by its seeds, see `judged`
    sampler: Sampler = "tpe"  #: what suggests settings
    pruner: str = "auto"  #: what ends trials early
    n_startup_trials: int = 10  #: drawn at random before the sampler learns from them
    seed: int = 0  #: of the sampler, and of the order of seeds
    search_space: Path | None = None  #: a file with the space; None for the agent's own
    retest: int = 3  #: how many of the best are run again on other seeds
    retest_seeds: int = 20  #: on how many
    first_retest_seed: int = 1000  #: the first of them

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
        """Make sure that the seeds of the search are none of the re-test's."""
        shared = sorted(set(self.seeds) & set(self.held_out))
        if self.retest and shared:
            raise UserError(
                f"seed {shared[0]} is one of the search and of the re-test: what is chosen by its "
                "seeds is judged on others; see --first-seed and --first-retest-seed"
            )

    def identity(self, shipped: Mapping[str, Any], space: Mapping[str, Any]) -> dict[str, Any]:
        """What makes it this tuning and no other, as JSON."""
        entry = self.searched(shipped)
        data = plain(
            {
                **{key: value for key, value in vars(self).items() if key not in _MAY_CHANGE},
                **({"search_engine": entry["engine"]} if entry.keys() - shipped.keys() else {}),
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


def judged(figures: Sequence[float], objective: Objective, *, is_cost: bool) -> float:
    """What a setting is worth by its runs.

    Args:
        figures: of its runs, at least one.
        objective: ``mean``; ``iqm``, the mean of the middle half; ``lower``, the quarter below
            which the worst lie.
        is_cost: whether the lower figure is the better; ``lower`` is then the quarter above which
            the worst lie.
    """
    values = np.sort(np.asarray(figures, dtype=np.float64))
    if objective == "mean":
        return float(values.mean())
    if objective == "iqm":
        cut = len(values) // 4
        return float(values[cut : len(values) - cut].mean())
    return float(np.quantile(values, 1 - LOWER if is_cost else LOWER))
