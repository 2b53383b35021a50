"""The specification of a search as one immutable value, and the value of a setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.experiments.study import COSTS, METRICS, AgentSpec, EnvironmentSpec, StudySpec
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import plain

SAMPLERS, PRUNERS, OBJECTIVES = ("tpe", "random"), ("auto", "none"), ("mean", "iqm", "lower")
STEPS = "steps"  # of training until the learning curve reaches the threshold
FIGURES = ("score", *METRICS, STEPS)  # of a run
AUTO, SHIPPED = "auto", "shipped"
# What may differ when a search continues: its length, and all about the re-test.
_MAY_CHANGE = {"study", "n_trials", "retest", "retest_seeds", "first_retest_seed", "until_decided"}
_MAY_CHANGE |= {"max_retest_seeds"}


@dataclass(frozen=True)
class TuningSpec:
    """A search over settings of one agent on one environment, and the re-test of the best."""

    #: The agent with its initial settings, called `SHIPPED`, the environment, and the common
    #: settings of all runs. Its seeds are the seeds of trials. The agent's ``settings`` are fixed
    #: in every trial.
    study: StudySpec
    n_trials: int = 100  #: number of settings to try
    figure: str = AUTO  #: one of `FIGURES`; or `AUTO`, until the kind of runs is known
    objective: str = "mean"  #: the value of a setting over its seeds, see `value`
    sampler: str = "tpe"  #: the sampler of settings
    pruner: str = "auto"  #: "auto": trials end early by `searching.is_hopeless`; or "none"
    n_startup_trials: int = 10  #: random trials before the sampler learns
    seed: int = 0  #: seed of the sampler, and of the order of seeds
    search_space: Path | None = None  #: a file with the space; None for the agent's own
    retest: int = 3  #: number of best settings in the re-test on held-out seeds
    retest_seeds: int = 20  #: number of held-out seeds
    first_retest_seed: int = 1000  #: the first held-out seed
    until_decided: bool = False  #: whether the re-test grows until its winner is decided
    max_retest_seeds: int | None = None  #: the most held-out seeds then; None for 80

    @property
    def agent(self) -> AgentSpec:
        """The agent with its initial settings."""
        return self.study.agents[0]

    @property
    def environment(self) -> EnvironmentSpec:
        """The environment of the search."""
        return self.study.environments[0]

    @property
    def is_cost(self) -> bool:
        """Whether a lower figure is better."""
        return self.figure in (*COSTS, STEPS)

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of every trial, in their common order."""
        order = np.random.default_rng(self.seed).permutation(self.study.n_seeds)
        return tuple(self.study.first_seed + int(place) for place in order)

    def searched(self, entry: Mapping[str, Any]) -> dict[str, Any]:
        """Settings for runs of the search, which may use another engine than the agent's own.

        In the search, the library's agents use ``engine: auto`` unless the settings name an engine.
        The re-test uses the engine of normal training.
        """
        engines = ALGORITHMS[self.agent.algo].engines
        return {**({"engine": "auto"} if "auto" in engines[1:] else {}), **entry}

    def value(self, figures: Sequence[float] | Floats) -> float:
        """The value of a setting by the figures of its runs, at least one.

        It is their mean, or with the objective ``iqm`` the mean of the middle half, with ``lower``
        the quartile on the side of the worst runs.
        """
        values = np.sort(np.asarray(figures, np.float64))
        if self.objective == "lower":
            return float(np.quantile(values, 0.75 if self.is_cost else 0.25))
        cut = len(values) // 4 if self.objective == "iqm" else 0
        return float(values[cut : len(values) - cut].mean())

    def check(self) -> None:
        """Check that search and re-test share no seeds, and that a re-test can grow."""
        from rl_yardstick.experiments.plan import MOST_SEEDS

        most = least = self.retest_seeds
        if self.until_decided:
            if not self.retest:
                raise UserError("--until-decided is about the re-test: leave out --retest 0")
            if self.objective != "mean" or self.figure == STEPS:
                raise UserError(
                    "--until-decided decides means of scores, returns or regrets: leave it out, or "
                    f"--objective {self.objective} --metric {self.figure}"
                )
            most = self.max_retest_seeds or max(MOST_SEEDS, least)
        elif self.max_retest_seeds is not None:
            raise UserError("--max-retest-seeds belongs to --until-decided: give both")
        if most < least:
            raise UserError(f"--max-retest-seeds is {most}, the re-test begins with {least} seeds")
        held_out = range(self.first_retest_seed, self.first_retest_seed + most)
        shared = sorted(seed for seed in self.seeds if seed in held_out)
        if self.retest and shared:
            raise UserError(
                f"seed {shared[0]} is one of the search and of the re-test: what is chosen by its "
                "seeds is judged on others; see --first-seed and --first-retest-seed"
            )

    def identity(self, shipped: Mapping[str, Any], space: Mapping[str, Any]) -> dict[str, Any]:
        """What must be the same when a search continues, as JSON."""
        of_runs = ("n_seeds", "first_seed", "eval_freq", "eval_episodes", "threshold")
        found: dict[str, Any] = {
            **{key: value for key, value in vars(self).items() if key not in _MAY_CHANGE},
            **{key: getattr(self.study, key) for key in of_runs},
            "algo": self.agent.algo,
            "env": self.environment.env_id,
            "hyperparams": dict(shipped),
            "search_engine": self.searched(shipped).get("engine"),
            "search_space": dict(space),
        }
        return dict(plain(found))
