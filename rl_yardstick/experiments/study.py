"""The specification of a study as one value, its YAML file, and sweeps over settings."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic import dataclasses as checked

from rl_yardstick.agents.registry import ALGORITHMS
from rl_yardstick.pipeline.components import arguments_of
from rl_yardstick.pipeline.environments import check_env_id, map_name
from rl_yardstick.pipeline.errors import UserError, as_user_error, shown, unknown
from rl_yardstick.pipeline.files import plain, portable_name
from rl_yardstick.pipeline.settings import (
    BUDGETS,
    layered,
    parse_assignments,
    read_yaml,
    shipped_hyperparams,
)
from rl_yardstick.pipeline.spec import TrainSpec

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
COSTS = ("regret",)  # metrics of which less is better
OF_TRAINING = ("training", "last_episodes")  # mean returns of training episodes
# Settings of a training variant of the environment, with the values that switch it off.
AS_IT_COMES: dict[str, Any] = {"train_env_kwargs": None, "train_env_wrapper": None}
MOST_PAIRS = 10  # of agent and environment, for two seeds of each in a quick look
_SHIPPED = Path(__file__).resolve().parents[1] / "studies"

# Symbols of settings in labels and on axes, as usual in the field; their spelling in file names.
_SYMBOLS = {
    "learning_rate": "α",
    "gamma": "γ",
    "exploration_initial_eps": "ε",
    "trace_decay": "λ",
    "gae_lambda": "λ",
    "kappa": "κ",
    "initial_q": "initial Q",
}
_SPELT = {"α": "alpha", "γ": "gamma", "ε": "epsilon", "λ": "lambda", "κ": "kappa"}


def symbol(setting: str) -> str:
    """The symbol of a setting for labels and axes, or else its name."""
    return _SYMBOLS.get(setting, setting)


def file_name(label: str) -> str:
    """The label as the name of a folder."""
    label = re.sub(r"(\w) = ", lambda found: f"{_SPELT.get(found[1], found[1])}=", label)
    return portable_name(re.sub(r"[^\w.=+,-]+", "_", label).strip("_.") or "_")


def _number(value: Any) -> Any:
    """YAML reads 1e5 as text, and Python counts True as 1."""
    if isinstance(value, bool):
        raise ValueError(f"must be a number, not {shown(value)}")
    with suppress(ValueError):
        return float(value) if isinstance(value, str) else value
    return value


_Count = Annotated[int, BeforeValidator(_number), Field(ge=1)]
_FromZero = Annotated[int, BeforeValidator(_number), Field(ge=0)]
_Float = Annotated[float, BeforeValidator(_number)]


@dataclass(frozen=True)
class AgentSpec:
    """One of the compared agents."""

    label: str  #: its name in tables and figures
    algo: str  #: its name in the table of agents
    settings: dict[str, Any] = field(default_factory=dict)  #: which override those of its file
    tuned: bool = True  #: whether to start from the shipped file, or else from the defaults
    conf_file: Path | None = None  #: another file of hyperparameters to start from
    summary: str = ""  #: a short description for the report
    where: str = field(default="", compare=False)  #: the file with its settings, for messages
    group: str = ""  #: for a member of a sweep, the common label
    swept: dict[str, Any] = field(default_factory=dict)  #: its values of the swept settings


@dataclass(frozen=True)
class EnvironmentSpec:
    """One of the environments of a study."""

    label: str  #: its name in tables and figures
    env_id: str  #: its Gymnasium id
    #: Hyperparameters of every agent here, which override those of the agents' files.
    settings: dict[str, Any] = field(default_factory=dict)
    map_name: str = ""  #: the file of its map, if the label names it

    @property
    def folder(self) -> str:
        """The label as a file name; for an id, the same name as in `train.py`."""
        usual = f"{self.env_id} ({self.map_name})" if self.map_name else self.env_id
        is_id = self.label == usual
        return file_name(self.env_id.replace("/", "-") if is_id else self.label)


@checked.dataclass(frozen=True, config={"extra": "forbid"})
class QuickSpec:
    """The reduction of a study for a quick look."""

    seeds: _Count | None = None  #: None for 2, or 1 with more than `MOST_PAIRS`
    #: The share of each run's budget; None: see `plan.QUICK_STEPS`.
    budget: Annotated[_Float, Field(gt=0, le=1)] | None = None


@dataclass(frozen=True)
class StudySpec:
    """A study: every agent on every environment with every seed."""

    name: str  #: the name of its folder
    title: str  #: its question in one line
    agents: tuple[AgentSpec, ...]  #: the compared agents
    environments: tuple[EnvironmentSpec, ...]  #: their environments
    n_seeds: int = 10  #: the number of seeds
    description: str = ""  #: its question, and earlier knowledge
    eval_freq: int | None = None  #: steps between two evaluations; None for twenty in a run
    eval_episodes: int = 20  #: episodes of each sampled evaluation
    metric: Metric = "final"  #: the metric of the verdicts
    #: Difference of the metric within which two agents are tied; None: 0.02 of the score.
    margin: float | None = None
    #: Whether runs with the same seed share their randomness, as on bandits whose arms and rewards
    #: are drawn by the seed; if so, agents are compared seed by seed.
    shared_randomness: bool = False
    threshold: float | None = None  #: return that counts as solved; None: `results.threshold_of`
    episodes_table: int = 0  #: episodes per row in the table of training returns; 0 for no table
    quick: QuickSpec = field(default_factory=QuickSpec)  #: its reduction for a quick look
    is_quick: bool = False  #: whether it is reduced
    gym_packages: tuple[str, ...] = ()  #: modules that the user typed
    tensorboard: bool = False  #: whether each run writes a TensorBoard log
    render_every: int = 0  #: episodes between two films; 0 for no films
    diagnose: bool = False  #: whether evaluations compare values and gradients with exact ones
    learning_pages: bool = False  #: whether the page links to pages that play first trainings
    figures: tuple[str, ...] = ("png", "svg")  #: formats of figures: "png", "svg", "pdf"
    exact_model: str = "auto"  #: where none is published: see `TrainSpec`
    run_timeout: float | None = None  #: seconds that each run may take; None for no limit
    first_seed: int = 0  #: the first seed; the others follow it
    against: str = ""  #: label of the only agent to compare the others with; empty for all pairs
    figure: str = ""  #: the final figure of runs that were done elsewhere, in words

    @property
    def seeds(self) -> range:
        """The seeds."""
        return range(self.first_seed, self.first_seed + self.n_seeds)

    @property
    def metric_words(self) -> str:
        """The metric of the verdicts, in words."""
        return (self.metric == "final" and self.figure) or METRIC_WORDS[self.metric]

    def quickened(self) -> StudySpec:
        """The study with few seeds and a small budget, in a separate folder."""
        n_pairs = len(self.agents) * len(self.environments)
        n_seeds = self.quick.seeds or (1 if n_pairs > MOST_PAIRS else 2)
        name = f"{self.name}-quick"
        return replace(self, name=name, n_seeds=min(n_seeds, self.n_seeds), is_quick=True)


def with_maps_named(study: StudySpec) -> StudySpec:
    """The study with the file of its map in the label of an environment, where that is its id."""
    environments = []
    for one in study.environments:
        found = {map_name(one.env_id, layered(one.settings, a.settings)) for a in study.agents}
        name = found.pop() if one.label == one.env_id and len(found) == 1 else ""
        label = f"{one.label} ({name})" if name else one.label
        environments.append(replace(one, label=label, map_name=name))
    return replace(study, environments=tuple(environments))


# --- sweeps ---------------------------------------------------------------------------------------


def swept(agent: AgentSpec, sweep: Mapping[str, Sequence[Any]]) -> Iterator[AgentSpec]:
    """The agent for each combination of swept values, labelled by these values."""
    texts = {name: _as_texts(values) for name, values in sweep.items()}
    for places in product(*(range(len(values)) for values in sweep.values())):
        at = dict(zip(sweep, places, strict=True))
        chosen = {name: sweep[name][place] for name, place in at.items()}
        each = [f"{symbol(name)} = {texts[name][place]}" for name, place in at.items()]
        label, settings = " with ".join([agent.label, *each]), layered(agent.settings, chosen)
        yield replace(agent, label=label, settings=settings, group=agent.label, swept=chosen)


def _as_texts(values: Sequence[Any]) -> list[str]:
    """Values for labels: numbers with four digits if these distinguish them."""
    short = [f"{v:.4g}" if isinstance(v, float) else str(v) for v in values]
    return short if len(set(short)) == len(set(map(str, values))) else [str(v) for v in values]


# --- study files ----------------------------------------------------------------------------------


def seconds(value: Any) -> float:
    """A time such as 90, 90s, 10m, 2h or 1d."""
    found = re.fullmatch(r"(\d*\.?\d+(?:e\d+)?)\s*(|s|m|min|h|d)", str(value).strip())
    if found is None or not float(found[1]) > 0:
        raise ValueError(f"must be a time such as 90s, 10m or 2h, not {shown(value)}")
    units = {"m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
    return float(found[1]) * units.get(found[2], 1.0)


def _by_label(value: Any) -> Any:
    """Entries by label, from a list of names or a mapping."""
    if isinstance(value, list) and all(isinstance(item, str) for item in value):
        if len(set(value)) < len(value):
            raise ValueError("names one of them twice")
        value = dict.fromkeys(value)
    elif isinstance(value, list):
        raise ValueError("must list names, or map them to settings")
    if not value:
        raise ValueError("must list at least one name")
    return {key: entry or {} for key, entry in value.items()} if isinstance(value, dict) else value


_Sweep = dict[str, Annotated[list[Any], Field(min_length=1)]]


class _Part(BaseModel):
    """A mapping in a study file, whose unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid")


class _Open(BaseModel):
    """A mapping whose other keys are hyperparameters."""

    model_config = ConfigDict(extra="allow", protected_namespaces=())

    @property
    def settings(self) -> dict[str, Any]:
        return dict(self.__pydantic_extra__ or {})


class _Agent(_Open):
    algo: str | None = None
    tuned: bool | None = None
    conf_file: str | None = None
    summary: str = ""
    sweep: _Sweep | None = None


class _Environment(_Open):
    id: str | None = None
    as_it_comes: bool = False


class _Seeds(_Part):
    first: _FromZero = 0
    count: _Count = 10


class _File(_Part):
    title: str = ""
    description: str = ""
    agents: Annotated[dict[str, _Agent], BeforeValidator(_by_label)] = Field({})
    environments: Annotated[dict[str, _Environment], BeforeValidator(_by_label)] = Field({})
    seeds: Annotated[
        _Seeds, BeforeValidator(lambda n: n if isinstance(n, dict) else {"count": n})
    ] = _Seeds()
    settings: dict[str, Any] = {}
    sweep: _Sweep = {}
    quick: QuickSpec = QuickSpec()
    n_timesteps: _Count | None = None
    n_episodes: _Count | None = None
    tuned: bool = True
    eval_freq: _Count | None = None
    eval_episodes: _Count = 20
    metric: Metric = "final"
    margin: Annotated[_Float, Field(ge=0)] | None = None
    shared_randomness: bool = False
    threshold: _Float | None = None
    episodes_table: _FromZero = 0
    diagnose: bool = False
    run_timeout: Annotated[float, BeforeValidator(seconds)] | None = None


# Keys that mean the same as fields of `StudySpec`.
_SAME = (
    *("description", "eval_freq", "eval_episodes", "metric", "margin", "shared_randomness"),
    *("threshold", "episodes_table", "diagnose", "run_timeout", "quick"),
)


def find_study(given: str) -> Path:
    """The given path, or that of a shipped study such as ``mine-maze``, ``studies/mine-maze.yml``.

    Raises UserError if it is a plain name, and neither exists.
    """
    path = Path(given)
    if path.is_file() or path.parent not in (Path(), Path("studies")):
        return path
    shipped = {known.stem: known for known in sorted(_SHIPPED.glob("*.yml"))}
    name = path.name.removesuffix(".yml")
    if name not in shipped:
        raise unknown(f"{given}: no such file, and no shipped study", name, shipped)
    return shipped[name]


def read_study(path: Path) -> StudySpec:
    """Read a study file; its name is the study's name.

    Raises UserError if it cannot be read, or contains unknown or invalid settings.
    """
    data = read_yaml(path)
    if not (isinstance(data, dict) and all(isinstance(key, str) for key in data)):
        raise UserError(f"{path}: a study must map names to values")
    given = {key: value for key, value in data.items() if value is not None}
    try:  # lists of names that are missing are read too
        file = _File.model_validate({"agents": None, "environments": None, **given})
    except ValidationError as error:
        raise _in_one_line(path, error) from None
    budgets = file.model_dump(include={*BUDGETS}, exclude_none=True)
    agents = tuple(_agents(path, file))
    shared, environments = layered(file.settings, budgets), []
    for label, entry in file.environments.items():
        env_id = label if entry.id is None else entry.id
        with as_user_error(str(path), UserError):
            check_env_id(env_id)
        own = {**(AS_IT_COMES if entry.as_it_comes else {}), **entry.settings}
        environments.append(EnvironmentSpec(label, env_id, layered(shared, own)))
    return StudySpec(
        name=path.stem,
        title=file.title or path.stem,
        agents=agents,
        environments=tuple(environments),
        n_seeds=file.seeds.count,
        first_seed=file.seeds.first,
        **{key: getattr(file, key) for key in _SAME},
    )


_PARTS: Mapping[tuple[str, ...], Any] = {(): _File, ("quick",): QuickSpec, ("seeds",): _Seeds}


def _in_one_line(path: Path, error: ValidationError) -> UserError:
    """The first mistake, with the keys that lead to it."""
    first = error.errors()[0]
    *outer, key = [str(key) for key in first["loc"] if key != "[key]"]
    place, value = ": ".join([str(path), *outer]), first["input"]
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return unknown(f"{place}: unknown key", key, _PARTS[tuple(outer)].__pydantic_fields__)
    if first["type"] == "literal_error":
        return unknown(f"{place}: unknown {key}", str(value), METRICS)
    if first["type"] == "value_error":
        return UserError(f"{place}: {key} {first['msg'].removeprefix('Value error, ')}")
    reason = first["msg"].replace("Input should", "must").replace("List should", "must")
    reason = reason.partition(" or instance of")[0].partition(", unable")[0].partition(" after")[0]
    return UserError(f"{place}: {key} {reason}, not {shown(value)}")


def _agents(path: Path, file: _File) -> list[AgentSpec]:
    agents: list[AgentSpec] = []
    for label, entry in file.agents.items():
        algo = label if entry.algo is None else entry.algo
        if algo not in ALGORITHMS:
            raise unknown(f"{path}: unknown agent", algo, ALGORITHMS)
        conf_file = None if entry.conf_file is None else path.parent / entry.conf_file
        if conf_file is not None and not conf_file.is_file():
            raise UserError(f"{path}: {label}: conf_file: there is no file {conf_file}")
        agent = AgentSpec(
            label,
            algo,
            entry.settings,
            tuned=file.tuned if entry.tuned is None else entry.tuned,
            conf_file=conf_file,
            summary=entry.summary,
            where=str(path),
        )
        agents += swept(agent, {**file.sweep, **(entry.sweep or {})})
    if len({agent.group for agent in agents}) == 1 and agents[0].swept:
        agents = [replace(a, label=a.label.removeprefix(f"{a.group} with ")) for a in agents]
    return agents


# --- changes of the settings of an agent, over four seeds, as evidence for causes -----------------

SHIPPED, AS_IT_IS = "as shipped", "as it is"


def intervention_study(spec: TrainSpec, changes: Sequence[str], name: str) -> StudySpec:
    """Make a study of the agent of the run ``name``, as shipped, unchanged and with each change.

    Changes are typed as ``key:value``, or several of these separated by spaces.

    Raises UserError if a change cannot be parsed.
    """
    own, shipped = spec.hyperparams, shipped_hyperparams(spec)
    typed = {change: parse_assignments(change.split(), "--test") for change in changes}
    settings = {change: layered(own, values) for change, values in typed.items()}
    first = dict([*settings.items()][:1])  # the likeliest change is trained first
    unchanged = {SHIPPED: shipped, AS_IT_IS: own}
    if {**own, "engine": None} == {**shipped, "engine": None}:
        unchanged = {f"{SHIPPED}, {AS_IT_IS}": own}
    # Compiled code if possible, unless the settings name an engine.
    has_auto = "=auto" in arguments_of(spec.algo).get("engine", ())
    fast: dict[str, Any] = {"engine": "auto"} if has_auto else {}
    agents = [
        AgentSpec(change, spec.algo, {**fast, **values}, tuned=False)
        for change, values in {**first, **unchanged, **settings}.items()
    ]
    # Two models of one name share a folder only if their settings are the same.
    digest = sha256(repr(sorted(plain(own).items())).encode()).hexdigest()[:8]
    environment = f"{spec.env_id} ({spec.map_name})" if spec.map_name else spec.env_id
    return StudySpec(
        name=file_name(f"explain_{name}_{digest}"),
        title=f"What helps {spec.algo} on {environment}",
        agents=tuple(agents),
        environments=(EnvironmentSpec(environment, spec.env_id, map_name=spec.map_name),),
        n_seeds=4,
        gym_packages=tuple(spec.gym_packages),
    )
