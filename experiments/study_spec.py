"""What a study is asked to do, as one immutable value."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from pipeline.files import LONGEST_NAME, portable_name
from pipeline.settings.hyperparams import override
from pipeline.user_modules import UserModule

Metric = Literal["final", "best", "area", "training", "last_episodes", "regret"]
METRICS = get_args(Metric)

METRIC_WORDS: dict[str, str] = {
    "final": "return of the final policy",
    "best": "return of the best policy during training",
    "area": "mean return over the learning curve",
    "training": "mean return of all training episodes",
    "last_episodes": "mean return of the last 100 training episodes",
    "regret": "regret of a run",
}

# Of these the lower is the better.
COSTS = ("regret",)


# These are of training episodes, the others of evaluations.
OF_TRAINING = ("training", "last_episodes")


# Settings that map names to values: such mappings are merged name by name.
MERGED = ("env_kwargs", "train_env_kwargs", "eval_env_kwargs")


# What settings change in the environment for training alone; with these it is as it comes.
AS_IT_COMES: dict[str, Any] = {"train_env_kwargs": None, "train_env_wrapper": None}


def layered(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with ``changes`` made to them."""
    merged = {
        key: {**settings[key], **changes[key]}
        for key in MERGED
        if isinstance(settings.get(key), dict) and isinstance(changes.get(key), dict)
    }
    return override(settings, {**changes, **merged})


# What settings are called in labels and on axes: as the field writes them.
_SYMBOLS = {
    "learning_rate": "α",
    "gamma": "γ",
    "exploration_initial_eps": "ε",
    "trace_decay": "λ",
    "gae_lambda": "λ",
    "kappa": "κ",
    "initial_q": "initial Q",
}
# In names of files, on the other hand.
_SPELT = {"α": "alpha", "γ": "gamma", "ε": "epsilon", "λ": "lambda", "κ": "kappa"}


def symbol(setting: str) -> str:
    """A setting as labels and axes call it: the field's letter, or else its own name."""
    return _SYMBOLS.get(setting, setting)


def file_name(label: str, longest: int = LONGEST_NAME) -> str:
    """The label as the name of a folder, of ``longest`` bytes at most."""
    label = re.sub(r"(\w) = ", lambda found: f"{_SPELT.get(found[1], found[1])}=", label)
    return portable_name(re.sub(r"[^\w.=+,-]+", "_", label).strip("_.") or "_", longest)


@dataclass(frozen=True)
class AgentSpec:
    """One of the agents that are compared.

    Attributes:
        label: what it is called in tables and figures.
        algo: its name in the table of agents.
        settings: hyperparameters, which change those of its file.
        tuned: whether to begin with the entry of ``hyperparams/<algo>.yml``; otherwise with the
            defaults of its constructor.
        conf_file: a file of hyperparameters to begin with, instead of that one; None for that one.
        summary: a few words on it, for the report.
        where: the place in a study file that asks for it, for error messages.
        group: for one of a sweep, the label that its members share.
        swept: its values of what is swept.
    """

    label: str
    algo: str
    settings: dict[str, Any] = field(default_factory=dict)
    tuned: bool = True
    conf_file: Path | None = None
    summary: str = ""
    where: str = field(default="", compare=False)
    group: str = ""
    swept: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class EnvironmentSpec:
    """One of the environments that they are compared on.

    Attributes:
        label: what it is called in tables and figures.
        env_id: its Gymnasium id.
        settings: hyperparameters of every agent here, such as ``env_kwargs`` and ``n_timesteps``,
            which change those of the agents' files.
    """

    label: str
    env_id: str
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class QuickSpec:
    """How a study is cut down for a first look.

    Attributes:
        seeds: how many seeds then.
        budget: share of each run's steps or episodes.
    """

    seeds: int = 2
    budget: float = 0.1


@dataclass(frozen=True)
class StudySpec:
    """A study: every agent on every environment with every seed.

    Attributes:
        name: the name of its folder.
        title: one line on what it asks.
        description: what it asks, and what is known beforehand.
        agents: what is compared.
        environments: where.
        n_seeds: how many seeds there are.
        first_seed: the first of them; the others follow it.
        eval_freq: environment steps between two evaluations, or None for twenty in a run.
        eval_episodes: episodes of each evaluation that has to be sampled.
        metric: what the verdicts are about.
        margin: difference of the metric within which two agents count as equivalent; None for 2 %
            of the way from the best random or constant policy to the optimum, where that is known.
        threshold: return that counts as solved; None for 95 % of that way, or else what the
            environment has registered.
        episodes_table: episodes in each row of the table of training returns; 0 for no table.
        quick: how it is cut down for a first look.
        is_quick: whether it has been.
        gym_packages: names of modules of the user's, whose classes settings may name.
        user_modules: the same, as another process can import them.
        tensorboard: whether each run writes a TensorBoard log.
        render_every: episodes between two that are filmed; 0 for no films.
        learning_pages: whether the page links to others that play the first training of each
            agent.
        figures: the formats that figures are written in: "png", "svg", "pdf".
        run_timeout: seconds that each run may take; None for no limit.
        run_memory: bytes of memory that each run may take; None for no limit.
        source: the file that it was read from, or None.
    """

    name: str
    title: str
    agents: tuple[AgentSpec, ...]
    environments: tuple[EnvironmentSpec, ...]
    n_seeds: int = 10
    description: str = ""
    eval_freq: int | None = None
    eval_episodes: int = 20
    metric: Metric = "final"
    margin: float | None = None
    threshold: float | None = None
    episodes_table: int = 0
    quick: QuickSpec = field(default_factory=QuickSpec)
    is_quick: bool = False
    gym_packages: tuple[str, ...] = ()
    user_modules: tuple[UserModule, ...] = ()
    tensorboard: bool = False
    render_every: int = 0
    learning_pages: bool = False
    figures: Sequence[str] = ("png", "svg")
    run_timeout: float | None = None
    run_memory: int | None = None
    source: Path | None = None
    first_seed: int = 0

    @property
    def seeds(self) -> range:
        """The seeds."""
        return range(self.first_seed, self.first_seed + self.n_seeds)

    def quickened(self) -> StudySpec:
        """The study with few seeds and a small budget, in a folder of its own."""
        return replace(
            self,
            name=f"{self.name}-quick",
            n_seeds=min(self.quick.seeds, self.n_seeds),
            is_quick=True,
        )
