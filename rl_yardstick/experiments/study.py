"""The specification of a study as one immutable value, and its YAML file.

Files are read strictly; errors name file and line.
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

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.experiments import run_limits
from rl_yardstick.pipeline.environments import check_env_id, map_name, titled, with_maps_read
from rl_yardstick.pipeline.errors import UserError, shown, unknown
from rl_yardstick.pipeline.files import LONGEST_NAME, plain, portable_name, write_text
from rl_yardstick.pipeline.runs import environment_name
from rl_yardstick.pipeline.settings.hyperparams import override
from rl_yardstick.pipeline.settings.values import coerce
from rl_yardstick.pipeline.settings.yaml import key_lines, read_yaml
from rl_yardstick.pipeline.user_modules import UserModule

Metric = Literal["final", "best", "area", "training", "last_episodes", "regret"]
METRICS = get_args(Metric)

Keep = Literal["all", "figures"]

METRIC_WORDS: dict[str, str] = {
    "final": "return of the final policy",
    "best": "return of the best policy during training",
    "area": "mean return over the learning curve",
    "training": "mean return of all training episodes",
    "last_episodes": "mean return of the last 100 training episodes",
    "regret": "regret of a run",
}

# For these metrics, lower is better.
COSTS = ("regret",)


# Metrics that are mean returns of training episodes.
OF_TRAINING = ("training", "last_episodes")


# Settings that are mappings: these are merged key by key.
MERGED = ("env_kwargs", "train_env_kwargs", "eval_env_kwargs")


# Settings of a training variant of the environment, with the values that switch it off.
AS_IT_COMES: dict[str, Any] = {"train_env_kwargs": None, "train_env_wrapper": None}


def layered(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with ``changes`` applied."""
    merged = {
        key: {**settings[key], **changes[key]}
        for key in MERGED
        if isinstance(settings.get(key), dict) and isinstance(changes.get(key), dict)
    }
    return override(settings, {**changes, **merged})


# Symbols of settings in labels and on axes, as usual in the field.
_SYMBOLS = {
    "learning_rate": "α",
    "gamma": "γ",
    "exploration_initial_eps": "ε",
    "trace_decay": "λ",
    "gae_lambda": "λ",
    "kappa": "κ",
    "initial_q": "initial Q",
}
# Their spelling in file names.
_SPELT = {"α": "alpha", "γ": "gamma", "ε": "epsilon", "λ": "lambda", "κ": "kappa"}


def symbol(setting: str) -> str:
    """The symbol of a setting for labels and axes, or else its name."""
    return _SYMBOLS.get(setting, setting)


def file_name(label: str, longest: int = LONGEST_NAME) -> str:
    """The label as a folder name of at most ``longest`` bytes."""
    label = re.sub(r"(\w) = ", lambda found: f"{_SPELT.get(found[1], found[1])}=", label)
    return portable_name(re.sub(r"[^\w.=+,-]+", "_", label).strip("_.") or "_", longest)


@dataclass(frozen=True)
class AgentSpec:
    """One of the compared agents."""

    label: str  #: its name in tables and figures
    algo: str  #: its name in the table of agents
    #: Hyperparameters that override those of its file.
    settings: dict[str, Any] = field(default_factory=dict)
    #: Whether to start from the entry of ``hyperparams/<algo>.yml``; otherwise from the defaults of
    #: its constructor.
    tuned: bool = True
    #: Another file of hyperparameters to start from; None for the shipped one.
    conf_file: Path | None = None
    summary: str = ""  #: a short description for the report
    #: Its place in a study file, for error messages.
    where: str = field(default="", compare=False)
    group: str = ""  #: for a member of a sweep, the common label
    swept: dict[str, Any] = field(default_factory=dict)  #: its values of the swept settings


@dataclass(frozen=True)
class EnvironmentSpec:
    """One of the environments of a study."""

    label: str  #: its name in tables and figures
    env_id: str  #: its Gymnasium id
    #: Hyperparameters of every agent here, such as ``env_kwargs`` and ``n_timesteps``, which
    #: override those of the agents' files.
    settings: dict[str, Any] = field(default_factory=dict)
    map_name: str = ""  #: the file of its map, if the label names it

    @property
    def folder(self) -> str:
        """The label as a file name; for an id, the same name as in `train.py`."""
        is_id = self.label == titled(self.env_id, self.map_name)
        return file_name(environment_name(self.env_id) if is_id else self.label)


@dataclass(frozen=True)
class QuickSpec:
    """The reduction of a study for a quick look."""

    #: The number of seeds; None for 2, or 1 with more than ten pairs of agent and environment.
    seeds: int | None = None
    #: Share of each run's steps or episodes; None for 200,000 steps at most, or 20,000 where the
    #: agent is no table. An episode counts as 100 steps.
    budget: float | None = None


@dataclass(frozen=True)
class StudySpec:
    """A study: every agent on every environment with every seed."""

    name: str  #: the name of its folder
    title: str  #: its question in one line
    agents: tuple[AgentSpec, ...]  #: the compared agents
    environments: tuple[EnvironmentSpec, ...]  #: their environments
    n_seeds: int = 10  #: the number of seeds
    description: str = ""  #: its question, and earlier knowledge
    #: Environment steps between two evaluations; None for twenty evaluations in a run.
    eval_freq: int | None = None
    eval_episodes: int = 20  #: episodes of each sampled evaluation
    metric: Metric = "final"  #: the metric of the verdicts
    #: Difference of the metric within which two agents are tied; None: 0.02 of the score;
    #: nothing is tied where there is no score.
    margin: float | None = None
    #: Whether runs of different agents with the same seed share their randomness, as on bandits
    #: whose arms and rewards are drawn by the seed; if so, they are compared seed by seed.
    shared_randomness: bool = False
    #: Return that counts as solved; None for the point at 95 % of that gap if the optimum is exact,
    #: else for the environment's registered threshold.
    threshold: float | None = None
    #: Episodes per row in the table of training returns; 0 for no table.
    episodes_table: int = 0
    quick: QuickSpec = field(default_factory=QuickSpec)  #: its reduction for a quick look
    is_quick: bool = False  #: whether it is reduced
    #: Names of the user's modules, whose classes settings may name.
    gym_packages: tuple[str, ...] = ()
    user_modules: tuple[UserModule, ...] = ()  #: the same, importable in another process
    tensorboard: bool = False  #: whether each run writes a TensorBoard log
    render_every: int = 0  #: episodes between two films; 0 for no films
    #: Whether values and gradients are compared with exact ones at evaluations.
    diagnose: bool = False
    #: Whether the page links to pages that play the first training of each agent.
    learning_pages: bool = False
    #: The file formats of figures: "png", "svg", "pdf".
    figures: Sequence[str] = ("png", "svg")
    run_timeout: float | None = None  #: seconds that each run may take; None for no limit
    run_memory: int | None = None  #: bytes of memory that each run may take; None for no limit
    source: Path | None = None  #: its file, or None
    first_seed: int = 0  #: the first seed; the others follow it
    #: ``"figures"`` to keep figures and curves of runs in files, and few of their folders.
    keep: Keep | None = None
    #: Label of the only agent to compare the others with; empty for all pairs.
    against: str = ""

    @property
    def seeds(self) -> range:
        """The seeds."""
        return range(self.first_seed, self.first_seed + self.n_seeds)

    def quickened(self) -> StudySpec:
        """The study with few seeds and a small budget, in a separate folder."""
        n_pairs = len(self.agents) * len(self.environments)
        return replace(
            self,
            name=f"{self.name}-quick",
            n_seeds=min(self.quick.seeds or (1 if n_pairs > MOST_PAIRS else 2), self.n_seeds),
            is_quick=True,
        )


# --- Study files.

# The studies that are shipped with the project.
_SHIPPED = Path(__file__).resolve().parents[1] / "studies"

MOST_AGENTS = 10_000
MOST_PAIRS = 10  # of agent and environment, for two seeds of each in a quick look

BUDGETS = ("n_timesteps", "n_episodes")

# Keys of a study, and the types of their values.
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
    "keep": Keep,
    "diagnose": bool,
}
# Limits of each run, in the format of the command line.
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
    """A study file with the line numbers of its values."""

    path: Path
    lines: Mapping[Keys, int]

    def at(self, *keys: str | int) -> str:
        """The place of a value, as ``file:line``."""
        return f"{self.path}:{self.lines.get(keys, 1)}"

    def mapping(self, value: Any, *keys: str | int) -> dict[str, Any]:
        """The value if it is a mapping, or empty inside the document; otherwise an error."""
        if value is None and keys:
            return {}
        if not (isinstance(value, dict) and all(isinstance(key, str) for key in value)):
            what = str(keys[-1]) if keys else "a study"
            raise UserError(f"{self.at(*keys)}: {what} must map names to values")
        return value

    def check_names(self, names: Iterable[str], known: Iterable[str], *keys: str | int) -> None:
        """Refuse an unknown name."""
        known = list(known)
        for name in names:
            if name not in known:
                raise unknown(f"{self.at(*keys, name)}: unknown key", name, known)

    def values(
        self, data: Mapping[str, Any], kinds: Mapping[str, Any], *keys: str | int
    ) -> dict[str, Any]:
        """Check and convert the plain values among ``data`` by their types."""
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
        """Refuse two budgets in one mapping."""
        if all(data.get(key) is not None for key in BUDGETS):
            place = self.at(*keys, BUDGETS[1])
            raise UserError(f"{place}: give {' or '.join(BUDGETS)}, not both")


def find_study(given: str) -> Path:
    """Find a study file: the given path, or else the shipped study of that name.

    Args:
        given: a path, or for a shipped study also its bare name: ``mine-maze``,
            ``mine-maze.yml`` or ``studies/mine-maze.yml``.

    Raises:
        UserError: if it is a plain name, and neither exists.
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
    """Read a study file; its name is the study's name.

    Raises:
        UserError: if it cannot be read, or contains unknown or invalid settings.
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


def with_maps_named(study: StudySpec) -> StudySpec:
    """The study with the file of its map in the label of an environment, where that is its id."""
    environments = []
    for one in study.environments:
        found = {map_name(one.env_id, layered(one.settings, a.settings)) for a in study.agents}
        name = found.pop() if one.label == one.env_id and len(found) == 1 else ""
        environments.append(replace(one, label=titled(one.label, name), map_name=name))
    return replace(study, environments=tuple(environments))


def write_study(root: Path, study: StudySpec) -> None:
    """Write the study's specification as a study file in its folder, so that others can repeat it.

    The file includes changes by flags and the rows of maps; agents' own files of hyperparameters
    are copied beside it. A quick look has no such file.
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
    data["quick"] = {key: value for key, value in vars(study.quick).items() if value is not None}
    data["environments"] = {
        environment.label: {
            "id": environment.env_id,
            **with_maps_read(environment.env_id, environment.settings),
        }
        for environment in study.environments
    }
    data["agents"] = agents
    data["diagnose"] = study.diagnose or None
    known = {key: value for key, value in data.items() if value not in (None, "")}
    text = yaml.safe_dump(plain(known), sort_keys=False, allow_unicode=True)
    write_text(root / "study.yml", text)


def _agent_entry(agent: AgentSpec, settings: Mapping[str, Any]) -> dict[str, Any]:
    tuned = {} if agent.tuned or agent.conf_file is not None else {"tuned": False}
    summary = {"summary": agent.summary} if agent.summary else {}
    return {"algo": agent.algo, **tuned, **summary, **settings}


def _swept_entry(members: Sequence[AgentSpec]) -> dict[str, Any] | None:
    """One entry for all members of a sweep; None if no entry gives exactly these members."""
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
    """The seeds as a number, or as first seed and number."""
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
    """Read the entries under ``key`` by label, from a list of names or a mapping."""
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
    """The agent's own file of hyperparameters, relative to the study; refuses ``tuned: false``."""
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
    """Values for labels: numbers with four digits if these distinguish them."""
    short = [f"{v:.4g}" if isinstance(v, float) else str(v) for v in values]
    return short if len(set(short)) == len(set(map(str, values))) else [str(v) for v in values]


def swept(agent: AgentSpec, sweep: Mapping[str, Sequence[Any]]) -> list[AgentSpec]:
    """The agent for each combination of swept values, labelled by these values."""
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
