"""What a study is asked to do, as one immutable value, and its YAML file.

Files are read strictly; mistakes are named with file and line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from agents import ALGORITHMS
from experiments import run_limits
from pipeline.environments import check_env_id, with_maps_read
from pipeline.errors import UserError, shown, unknown
from pipeline.files import LONGEST_NAME, plain, portable_name, write_text
from pipeline.settings.hyperparams import override
from pipeline.settings.values import coerce
from pipeline.settings.yaml import key_lines, read_yaml
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
    """One of the agents that are compared."""

    label: str  #: what it is called in tables and figures
    algo: str  #: its name in the table of agents
    #: Hyperparameters, which change those of its file.
    settings: dict[str, Any] = field(default_factory=dict)
    #: Whether to begin with the entry of ``hyperparams/<algo>.yml``; otherwise with the defaults of
    #: its constructor.
    tuned: bool = True
    #: A file of hyperparameters to begin with, instead of that one; None for that one.
    conf_file: Path | None = None
    summary: str = ""  #: a few words on it, for the report
    #: The place in a study file that asks for it, for error messages.
    where: str = field(default="", compare=False)
    group: str = ""  #: for one of a sweep, the label that its members share
    swept: dict[str, Any] = field(default_factory=dict)  #: its values of what is swept


@dataclass(frozen=True)
class EnvironmentSpec:
    """One of the environments that they are compared on."""

    label: str  #: what it is called in tables and figures
    env_id: str  #: its Gymnasium id
    #: Hyperparameters of every agent here, such as ``env_kwargs`` and ``n_timesteps``, which change
    #: those of the agents' files.
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class QuickSpec:
    """How a study is cut down for a first look."""

    seeds: int = 2  #: how many seeds then
    budget: float = 0.1  #: share of each run's steps or episodes


@dataclass(frozen=True)
class StudySpec:
    """A study: every agent on every environment with every seed."""

    name: str  #: the name of its folder
    title: str  #: one line on what it asks
    agents: tuple[AgentSpec, ...]  #: what is compared
    environments: tuple[EnvironmentSpec, ...]  #: where
    n_seeds: int = 10  #: how many seeds there are
    description: str = ""  #: what it asks, and what is known beforehand
    #: Environment steps between two evaluations, or None for twenty in a run.
    eval_freq: int | None = None
    eval_episodes: int = 20  #: episodes of each evaluation that has to be sampled
    metric: Metric = "final"  #: what the verdicts are about
    #: Difference of the metric within which two agents count as equivalent; None for 2 % of the way
    #: from the best random or constant policy to the optimum, where that is known.
    margin: float | None = None
    #: Whether an agent's run and another's with the same seed share their randomness, as those of
    #: bandits whose arms and rewards are drawn by the seed: they are then compared seed by seed.
    shared_randomness: bool = False
    #: Return that counts as solved; None for 95 % of that way, or else what the environment has
    #: registered.
    threshold: float | None = None
    #: Episodes in each row of the table of training returns; 0 for no table.
    episodes_table: int = 0
    quick: QuickSpec = field(default_factory=QuickSpec)  #: how it is cut down for a first look
    is_quick: bool = False  #: whether it has been
    #: Names of modules of the user's, whose classes settings may name.
    gym_packages: tuple[str, ...] = ()
    user_modules: tuple[UserModule, ...] = ()  #: the same, as another process can import them
    tensorboard: bool = False  #: whether each run writes a TensorBoard log
    render_every: int = 0  #: episodes between two that are filmed; 0 for no films
    #: Whether the page links to others that play the first training of each agent.
    learning_pages: bool = False
    #: The formats that figures are written in: "png", "svg", "pdf".
    figures: Sequence[str] = ("png", "svg")
    run_timeout: float | None = None  #: seconds that each run may take; None for no limit
    run_memory: int | None = None  #: bytes of memory that each run may take; None for no limit
    source: Path | None = None  #: the file that it was read from, or None
    first_seed: int = 0  #: the first of them; the others follow it

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


# --- Study files.

# The studies that come with the project.
_SHIPPED = Path(__file__).resolve().parents[1] / "studies"

MOST_AGENTS = 10_000

BUDGETS = ("n_timesteps", "n_episodes")

# Keys of a study, and what their values must be.
_STUDY_VALUES: dict[str, Any] = {
    "title": str,
    "description": str,
    "n_timesteps": int,
    "n_episodes": int,
    "tuned": bool,
    "eval_freq": int,
    "eval_episodes": int,
    "metric": Metric,
    "margin": float,
    "shared_randomness": bool,
    "threshold": float,
    "episodes_table": int,
}
# Limits of each run, written as on the command line.
_LIMITS: dict[str, Callable[[str], float]] = {
    "run_timeout": run_limits.seconds,
    "run_memory": run_limits.memory,
}
_PARTS = ("agents", "environments", "seeds", "settings", "sweep", "quick")
_STUDY_KEYS = (*_STUDY_VALUES, *_LIMITS, *_PARTS)
_AGENT_KEYS = ("algo", "tuned", "conf_file", "summary", "sweep")
_QUICK_VALUES: dict[str, Any] = {"seeds": int, "budget": float}
_NOT_NEGATIVE = ("margin", "episodes_table", "first")
_SEEDS = {"first": "first_seed", "count": "n_seeds"}
_AT_LEAST_ONE = ("seeds", "count", "n_timesteps", "n_episodes", "eval_freq", "eval_episodes")

Keys = tuple[str | int, ...]


@dataclass(frozen=True)
class _Document:
    """A study file and where things stand in it."""

    path: Path
    lines: Mapping[Keys, int]

    def at(self, *keys: str | int) -> str:
        """Where a value stands, as ``file:line``."""
        return f"{self.path}:{self.lines.get(keys, 1)}"

    def mapping(self, value: Any, *keys: str | int) -> dict[str, Any]:
        """The value, if it maps names to values or, inside the document, is left empty."""
        if value is None and keys:
            return {}
        if not (isinstance(value, dict) and all(isinstance(key, str) for key in value)):
            what = str(keys[-1]) if keys else "a study"
            raise UserError(f"{self.at(*keys)}: {what} must map names to values")
        return value

    def check_names(self, names: Iterable[str], known: Iterable[str], *keys: str | int) -> None:
        """Refuse a name that is not known."""
        known = list(known)
        for name in names:
            if name not in known:
                raise unknown(f"{self.at(*keys, name)}: unknown key", name, known)

    def values(
        self, data: Mapping[str, Any], kinds: Mapping[str, Any], *keys: str | int
    ) -> dict[str, Any]:
        """The plain values among ``data``, each as its kind asks."""
        result = {}
        for key, kind in kinds.items():
            if data.get(key) is None:
                continue
            place = f"{self.at(*keys, key)}: {key}"
            result[key] = coerce(data[key], kind, place)
            if key in _AT_LEAST_ONE and result[key] < 1:
                raise UserError(f"{place} must be at least 1, not {result[key]}")
            if key in _NOT_NEGATIVE and result[key] < 0:
                raise UserError(f"{place} must be at least 0, not {result[key]}")
            if key == "budget" and not 0 < result[key] <= 1:
                raise UserError(f"{place} must be a share above 0 and up to 1, not {result[key]}")
        return result

    def check_budget(self, data: Mapping[str, Any], *keys: str | int) -> None:
        """Refuse two budgets in one place."""
        if all(data.get(key) is not None for key in BUDGETS):
            place = self.at(*keys, BUDGETS[1])
            raise UserError(f"{place}: give {' or '.join(BUDGETS)}, not both")


def find_study(given: str) -> Path:
    """The file that is meant: the one of that path, or else the shipped study of that name.

    Args:
        given: a path, or for a shipped study also its bare name: ``mine-maze``,
            ``mine-maze.yml`` or ``studies/mine-maze.yml``.

    Raises:
        UserError: if it is a plain name, and there is neither.
    """
    path = Path(given)
    if path.is_file() or path.parent not in (Path(), Path("studies")):
        return path
    shipped = {known.stem: known for known in sorted(_SHIPPED.glob("*.yml"))}
    name = path.name.removesuffix(".yml")
    if name not in shipped:
        raise unknown(f"{given}: cannot be read: no such file, and no study", name, shipped)
    return shipped[name]


def read_study(path: Path) -> StudySpec:
    """Read a study file, whose name is the study's.

    Raises:
        UserError: if it cannot be read or says something that is not understood.
    """
    data = read_yaml(path)
    document = _Document(path, key_lines(path))
    data = document.mapping(data)
    document.check_names(data, _STUDY_KEYS)
    values = {"title": path.stem, **document.values(data, _STUDY_VALUES)}
    values |= {**_run_limits(document, data), **_seeds(document, data.get("seeds"))}
    document.check_budget(data)
    shared = document.mapping(data.get("settings"), "settings")
    document.check_budget(shared, "settings")
    budget = {key: values.pop(key) for key in BUDGETS if key in values}
    tuned = values.pop("tuned", True)
    quick = document.mapping(data.get("quick"), "quick")
    document.check_names(quick, _QUICK_VALUES, "quick")
    return StudySpec(
        name=path.stem,
        agents=_agents(document, data, tuned),
        environments=_environments(document, data, layered(shared, budget)),
        quick=QuickSpec(**document.values(quick, _QUICK_VALUES, "quick")),
        source=path,
        **values,
    )


def write_study(root: Path, study: StudySpec) -> None:
    """Write what a study was asked for as a study file in its folder, so that others can do it.

    What flags changed is in it, the rows of maps are too, and agents' own files of hyperparameters
    are copied beside it. Of a quick look there is none.
    """
    if study.is_quick:
        return
    groups: dict[str, list[AgentSpec]] = {}
    for agent in study.agents:
        groups.setdefault(agent.group or agent.label, []).append(agent)
    agents: dict[str, Any] = {}
    for label, members in groups.items():
        entry = _swept_entry(members)
        entries = {member.label: _agent_entry(member, member.settings) for member in members}
        entries = entries if entry is None else {label: entry}
        for environment in study.environments:
            entries = {key: with_maps_read(environment.env_id, e) for key, e in entries.items()}
        if (conf_file := members[0].conf_file) is not None:
            copied = Path("settings", f"{file_name(label)}.yml")
            (root / copied).parent.mkdir(exist_ok=True)
            write_text(root / copied, conf_file.read_text(encoding="utf-8"))
            entries = {label: {**e, "conf_file": copied.as_posix()} for label, e in entries.items()}
        agents |= entries
    data = {key: getattr(study, key) for key in _STUDY_VALUES if hasattr(study, key)}
    limits = {key: str(limit) for key in _LIMITS if (limit := getattr(study, key)) is not None}
    data |= {"seeds": {key: getattr(study, name) for key, name in _SEEDS.items()}, **limits}
    data["quick"] = vars(study.quick)
    data["environments"] = {
        environment.label: {
            "id": environment.env_id,
            **with_maps_read(environment.env_id, environment.settings),
        }
        for environment in study.environments
    }
    data["agents"] = agents
    known = {key: value for key, value in data.items() if value not in (None, "")}
    text = yaml.safe_dump(plain(known), sort_keys=False, allow_unicode=True)
    write_text(root / "study.yml", text)


def _agent_entry(agent: AgentSpec, settings: Mapping[str, Any]) -> dict[str, Any]:
    tuned = {} if agent.tuned or agent.conf_file is not None else {"tuned": False}
    summary = {"summary": agent.summary} if agent.summary else {}
    return {"algo": agent.algo, **tuned, **summary, **settings}


def _swept_entry(members: Sequence[AgentSpec]) -> dict[str, Any] | None:
    """One entry for the members of a sweep; None if there is none that means just them."""
    first = members[0]
    kept = {key: value for key, value in first.settings.items() if key not in first.swept}
    agent = replace(first, label=first.group or first.label, settings=kept, swept={}, group="")
    sweep = {
        key: list({repr(m.swept[key]): m.swept[key] for m in members}.values())
        for key in first.swept
    }
    found = swept(agent, sweep)
    alone = [replace(a, label=a.label.removeprefix(f"{agent.label} with ")) for a in found]
    if [replace(member, group=agent.label) for member in members] not in (found, alone):
        return None
    return {**_agent_entry(agent, kept), **({"sweep": sweep} if sweep else {})}


def _seeds(document: _Document, given: Any) -> dict[str, int]:
    """How many seeds, or the first and how many."""
    if given is None:
        return {}
    if not isinstance(given, dict):
        return {"n_seeds": document.values({"seeds": given}, {"seeds": int})["seeds"]}
    document.check_names(document.mapping(given, "seeds"), _SEEDS, "seeds")
    values = document.values(given, dict.fromkeys(_SEEDS, int), "seeds")
    return {_SEEDS[key]: value for key, value in values.items()}


def _run_limits(document: _Document, data: Mapping[str, Any]) -> dict[str, float]:
    limits = {}
    for key, read in _LIMITS.items():
        if data.get(key) is not None:
            try:
                limits[key] = read(str(data[key]))
            except ValueError as error:
                raise UserError(f"{document.at(key)}: {key} {error}") from error
    return limits


def _entries(
    document: _Document, data: Mapping[str, Any], key: str
) -> dict[str, tuple[Keys, dict[str, Any]]]:
    """What stands under ``key`` by its labels, written as a list of names or as a mapping."""
    value = data.get(key)
    if isinstance(value, list) and all(isinstance(item, str) for item in value):
        entries: dict[str, tuple[Keys, dict[str, Any]]] = {
            item: ((key, index), {}) for index, item in enumerate(value)
        }
        if len(entries) < len(value):
            raise UserError(f"{document.at(key)}: {key} names one of them twice")
    elif isinstance(value, list):
        raise UserError(f"{document.at(key)}: {key} must list names, or map them to settings")
    else:
        entries = {
            label: ((key, label), document.mapping(entry, key, label))
            for label, entry in document.mapping(value, key).items()
        }
    if not entries:
        raise UserError(f"{document.at(key)}: {key} must list at least one name")
    for keys, entry in entries.values():
        document.check_budget(entry, *keys)
    return entries


def _agents(document: _Document, data: Mapping[str, Any], tuned: bool) -> tuple[AgentSpec, ...]:
    shared_sweep = _sweep(document, data)
    agents: list[AgentSpec] = []
    for label, (keys, entry) in _entries(document, data, "agents").items():
        algo = entry.get("algo", label)
        if not (isinstance(algo, str) and algo in ALGORITHMS):
            place = document.at(*keys, "algo") if "algo" in entry else document.at(*keys)
            raise unknown(f"{place}: unknown agent", str(algo), ALGORITHMS)
        values = document.values(entry, {"tuned": bool, "summary": str}, *keys)
        values["conf_file"] = _conf_file(document, entry, keys)
        settings = {key: entry[key] for key in entry if key not in _AGENT_KEYS}
        values = {"tuned": tuned, "where": document.at(*keys), **values}
        agent = AgentSpec(label, algo, settings, **values)
        sweep = {**shared_sweep, **_sweep(document, entry, *keys)}
        n_agents = len(agents) + math.prod(map(len, sweep.values()))
        if n_agents > MOST_AGENTS:
            place = document.at(*keys)
            raise UserError(
                f"{place}: {n_agents:,} agents up to here; a study has {MOST_AGENTS:,} at most"
            )
        agents += swept(agent, sweep)
    if len({agent.group for agent in agents}) == 1 and agents[0].swept:
        agents = [replace(a, label=a.label.removeprefix(f"{a.group} with ")) for a in agents]
    return tuple(agents)


def _conf_file(document: _Document, entry: Mapping[str, Any], keys: Keys) -> Path | None:
    """The agent's own file of hyperparameters, from the study's folder; it need not be tuned."""
    given = entry.get("conf_file")
    if given is None:
        return None
    place = f"{document.at(*keys, 'conf_file')}: conf_file"
    path = document.path.parent / str(coerce(given, str, place))
    if entry.get("tuned") is False:
        raise UserError(f"{place} and tuned: false contradict each other: leave one out")
    if not path.is_file():
        raise UserError(f"{place}: there is no file {path}")
    return path


def _sweep(document: _Document, data: Mapping[str, Any], *keys: str | int) -> dict[str, list[Any]]:
    sweep = document.mapping(data.get("sweep"), *keys, "sweep")
    for name, values in sweep.items():
        if not (isinstance(values, list) and values):
            place = document.at(*keys, "sweep", name)
            raise UserError(f"{place}: {name} must be a list of values, not {shown(values)}")
    return sweep


def _as_texts(values: Sequence[Any]) -> list[str]:
    """Values as labels have them: numbers with four digits where these tell them apart."""
    short = [f"{v:.4g}" if isinstance(v, float) else str(v) for v in values]
    return short if len(set(short)) == len(set(map(str, values))) else [str(v) for v in values]


def swept(agent: AgentSpec, sweep: Mapping[str, Sequence[Any]]) -> list[AgentSpec]:
    """The agent once for each combination of the values that are swept, labelled by these."""
    agents = []
    texts = {name: _as_texts(values) for name, values in sweep.items()}
    for places in product(*(range(len(values)) for values in sweep.values())):
        at = dict(zip(sweep, places, strict=True))
        chosen = {name: sweep[name][place] for name, place in at.items()}
        each = [f"{symbol(name)} = {texts[name][place]}" for name, place in at.items()]
        label = " with ".join([agent.label, *each])
        settings = layered(agent.settings, chosen)
        agents.append(
            replace(agent, label=label, settings=settings, group=agent.label, swept=chosen)
        )
    return agents


def _environments(
    document: _Document, data: Mapping[str, Any], shared: Mapping[str, Any]
) -> tuple[EnvironmentSpec, ...]:
    environments = []
    for label, (keys, entry) in _entries(document, data, "environments").items():
        env_id = entry.get("id", label)
        if not isinstance(env_id, str):
            raise UserError(f"{document.at(*keys, 'id')}: id must be a text, not {shown(env_id)}")
        try:
            check_env_id(env_id)
        except UserError as error:
            place = document.at(*keys, "id") if "id" in entry else document.at(*keys)
            raise UserError(f"{place}: {error}") from error
        own = {key: value for key, value in entry.items() if key not in ("id", "as_it_comes")}
        values = document.values(entry, {"as_it_comes": bool}, *keys)
        if values.get("as_it_comes"):
            own = {**AS_IT_COMES, **own}
        environments.append(EnvironmentSpec(label, env_id, layered(shared, own)))
    return tuple(environments)
