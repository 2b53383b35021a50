"""What a tuning is asked to do, as one immutable value, and what a setting is worth to it."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from agents import ALGORITHMS
from experiments.study import COSTS, METRICS, AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError, one_line, shown
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


# What ``--storage`` names, and in a line what a storage fails of: Optuna itself is loaded later.

OWN_FILE = "trials.db"
KNOWN = "a file for a journal, sqlite:///FILE, postgresql://..., mysql://..., grpc://HOST:PORT"
# Whose errors are the storage's.
_LIBRARIES = frozenset({"optuna", "sqlalchemy", "sqlite3", "grpc", "json"})
_DATABASES = ("sqlite", "postgresql", "mysql", "mariadb")
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*(?=://)", re.IGNORECASE)
_SECRET = re.compile(r"(?<=://)([^\s/@:]*):[^\s/@]*@")


def kind_of(given: str) -> Literal["journal", "proxy", "database"]:
    """What a storage is by its name."""
    scheme = _SCHEME.match(given)
    if scheme is None:
        return "journal"
    name = scheme[0].partition("+")[0].lower()
    if name not in (*_DATABASES, "grpc"):
        raise UserError(f"--storage: {shown(without_secret(given))} is no storage: {KNOWN}")
    return "proxy" if name == "grpc" else "database"


def without_secret(text: str) -> str:
    """The text with the password of each address in it left out."""
    return _SECRET.sub(r"\1:***@", text)


@contextlib.contextmanager
def failing_in_a_line(given: str | None) -> Iterator[None]:
    """Say in one line what the storage fails of, whenever it does: full, gone, or damaged."""
    try:
        yield
    except Exception as error:
        if not _LIBRARIES & {kind.__module__.partition(".")[0] for kind in type(error).__mro__}:
            raise
        name = OWN_FILE if given is None else f"--storage {without_secret(given)}"
        goes_on = "; what is done stays, and the same command goes on"
        if isinstance(error, json.JSONDecodeError):
            name, goes_on = f"{name} is damaged", ""
        raise UserError(f"{name}: {reason_of(error)}{goes_on}") from error


def reason_of(error: Exception) -> str:
    """What a library says in a line, without its questions, its manual's address and passwords."""
    cause = error.__cause__ if type(error).__name__ == "StorageInternalError" else None
    said = one_line(cause or error)
    for rest in ("(Background on", "[SQL: "):
        said = said.partition(rest)[0]
    return without_secret(said.strip())
