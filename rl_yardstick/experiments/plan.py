"""Plans the runs of a study: one for each agent, environment and seed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path
from typing import Any
from unicodedata import normalize

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.envs.known_models import time_limit
from rl_yardstick.experiments.study import (
    AS_IT_COMES,
    MERGED,
    AgentSpec,
    EnvironmentSpec,
    QuickSpec,
    StudySpec,
    file_name,
    layered,
)
from rl_yardstick.pipeline.agent_settings import (
    check_algorithm,
    check_fit,
    resolved_spec,
    training_follows,
)
from rl_yardstick.pipeline.digests import DamagedFileError
from rl_yardstick.pipeline.environments import (
    check_env_id,
    check_memory,
    make_single_env,
    map_name,
    usual_kwargs,
    with_maps_read,
)
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import plain
from rl_yardstick.pipeline.models.load import agent_class
from rl_yardstick.pipeline.runs import FINISHED, ReadRun, Run, environment_name
from rl_yardstick.pipeline.settings.hyperparams import (
    Hyperparams,
    NoEntryError,
    read_hyperparams,
    seeds_tuned_on,
    split,
)
from rl_yardstick.pipeline.train_spec import NETWORKS, TrainSpec, completed, remembers

# Fields in which runs with the same settings may differ: output paths, display, and the location
# of modules.
_MAY_DIFFER = (
    "origins",
    "map_name",
    "log_folder",
    "tensorboard_log",
    "gym_packages",
    "user_modules",
    "save_every_n_episodes",
    "verbose",
    "progress",
    "log_interval",
    "pictures",
)


@dataclass(frozen=True)
class PlannedRun:
    """One run of a study."""

    agent: str  #: label of the agent
    environment: str  #: label of the environment
    seed: int  #: its seed
    spec: TrainSpec  #: its specification
    path: Path  #: its folder, which exists once it has finished
    #: Whether it is a batch of all seeds of a bandit agent; ``seed`` is the first.
    is_batch: bool = False
    n_runs: int = 1  #: the number of runs in the batch
    #: Whether some agent here has a memory: then the optimum with memory is the scale of all.
    on_memory_scale: bool = False

    @property
    def labels(self) -> tuple[str, str]:
        """The labels of agent and environment."""
        return self.agent, self.environment

    @property
    def run(self) -> Run:
        """The run folder."""
        return Run(self.path, environment_name(self.spec.env_id))

    def read(self) -> ReadPlannedRun:
        """A copy that reads the record in its folder only once."""
        return ReadPlannedRun(**{field.name: getattr(self, field.name) for field in fields(self)})

    @property
    def is_finished(self) -> bool:
        """Whether the folder contains this run and the run is finished; reads only the record."""
        info = _info(self.run)
        if info.get("state") != FINISHED or info.get("n_runs", 1) != self.n_runs:
            return False
        recorded, wanted = _recorded(info), self.spec.save_every_n_episodes
        return _identity(recorded) == _identity(self.spec.as_data()) and (
            wanted < 1 or self.is_batch or recorded["save_every_n_episodes"] == wanted
        )

    def is_of(self, run: Run) -> bool:
        """Whether a folder's record names this run."""
        info = _info(run)
        return bool(info and _identity(_recorded(info)) == _identity(self.spec.as_data()))

    @property
    def differences(self) -> dict[str, tuple[Any, Any]]:
        """By name, the recorded and requested values of settings in which a finished run differs.

        Empty if no setting differs: then the run is repeated because something is missing, such as
        checkpoints, or new seeds of a batch.
        """
        info = _info(self.run)
        if info.get("state") != FINISHED:
            return {}
        return differences(_recorded(info), self.spec)

    @property
    def is_to_do(self) -> bool:
        """Whether the run is missing; a damaged run is not missing."""
        if self.is_finished:
            return False
        try:
            self.check_record()
        except DamagedFileError:
            return False
        return True

    def check_record(self) -> None:
        """Check that the folder, if it exists, has a valid record.

        Raises:
            DamagedFileError: if its ``run.json`` is missing or damaged.
        """
        path = self.run.info_path
        if not (self.path.is_dir() and any(self.path.iterdir())):
            return
        if not path.exists():
            raise DamagedFileError(path, "is missing")
        if not self.run.recorded_spec():
            raise DamagedFileError(path, "is damaged: it does not say what was asked for")


@dataclass(frozen=True)
class ReadPlannedRun(PlannedRun):
    """A planned run that caches ``run.json``."""

    @cached_property
    def run(self) -> Run:
        """The run folder."""
        return ReadRun(self.path, environment_name(self.spec.env_id))


def _info(run: Run) -> dict[str, Any]:
    """The record of a run; empty if it is damaged."""
    try:
        return run.read_info()
    except DamagedFileError:
        return {}


def _identity(spec: Mapping[str, Any]) -> Any:
    kept = {key: value for key, value in spec.items() if key not in _MAY_DIFFER}
    return plain(kept)


def differences(recorded: Mapping[str, Any], spec: TrainSpec) -> dict[str, tuple[Any, Any]]:
    """By name, the values of settings in which a recorded spec and ``spec`` differ."""
    there = _by_name(_identity(completed(recorded)))
    now = _by_name(_identity(spec.as_data()))
    return {
        name: (there.get(name), now.get(name))
        for name in {**there, **now}
        if there.get(name) != now.get(name)
    }


def _recorded(info: Mapping[str, Any]) -> dict[str, Any]:
    spec = info.get("spec")
    return completed(spec if isinstance(spec, dict) else {})


def _by_name(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by name, including hyperparameters."""
    settings = dict(identity)
    hyperparams = settings.pop("hyperparams", None)
    return {**settings, **(hyperparams if isinstance(hyperparams, dict) else {})}


# --- The plan of a study.

_BYTES_PER_PULL = 24  # arm, reward and regret
MOST_RUNS = 1_000_000

# Settings that a batch supports, besides the agent's own arguments.
_BATCH_SETTINGS = ("n_timesteps", "env_kwargs", "algorithm")


def plan(
    study: StudySpec, root: Path, counts: Mapping[tuple[str, str], int] | None = None
) -> list[PlannedRun]:
    """Plan all runs of a study, ordered by seed, so that agents can be compared early.

    Args:
        study: the study.
        root: its folder.
        counts: by labels of agent and environment, the number of seeds; by default all
            seeds.

    Raises:
        UserError: if an agent's settings are invalid, or it does not fit an environment.
    """
    n_agents, n_environments = len(study.agents), len(study.environments)
    n_runs = n_agents * n_environments * study.n_seeds
    if n_runs > MOST_RUNS:
        raise UserError(
            f"{study.name}: {n_agents:,} agents on {n_environments:,} environments with "
            f"{study.n_seeds:,} seeds are {n_runs:,} runs; a study has {MOST_RUNS:,} at most"
        )
    _check_folders("agents", [(agent.label, file_name(agent.label)) for agent in study.agents])
    _check_folders(
        "environments",
        [(environment.label, environment.folder) for environment in study.environments],
    )
    specs = {}
    for environment in study.environments:
        check_env_id(environment.env_id)
        for agent in study.agents:
            with _naming_the_place(agent):
                spec = _train_spec(study, agent, environment)
                check_fit(spec)
            specs[agent.label, environment.label] = spec
    batches = {labels for labels, spec in specs.items() if _is_batch(spec)}
    with_memory = {environment for (_, environment), spec in specs.items() if remembers(spec)}
    n_seeds = {labels: (counts or {}).get(labels, study.n_seeds) for labels in specs}
    for labels in batches:
        n_timesteps = specs[labels].hyperparams.n_timesteps or 0
        pulls = f"{n_seeds[labels]:,} seeds with n_timesteps {n_timesteps:,}"
        n_bytes = n_seeds[labels] * n_timesteps * _BYTES_PER_PULL
        check_memory(pulls, n_bytes, " on ".join(labels))
    return [
        replace(
            _planned_run(
                study, root, *labels, seed, spec, n_seeds[labels] if labels in batches else 0
            ),
            on_memory_scale=labels[1] in with_memory,
        )
        for seed in study.seeds
        for labels, spec in specs.items()
        if seed == study.first_seed
        or (labels not in batches and seed - study.first_seed < n_seeds[labels])
    ]


def _planned_run(
    study: StudySpec,
    root: Path,
    agent: str,
    environment: str,
    seed: int,
    spec: TrainSpec,
    n_in_batch: int,
) -> PlannedRun:
    # From 1, because 0 means the newest run in rl_zoo3's tools.
    folder = next(one.folder for one in study.environments if one.label == environment)
    place = Path(file_name(agent), f"{folder}_{seed + 1}")
    spec = replace(
        spec,
        seed=seed,
        tensorboard_log=root / "tensorboard" / place if study.tensorboard else None,
        save_every_n_episodes=study.render_every if seed == study.first_seed else -1,
    )
    path, is_batch = root / "runs" / place, n_in_batch > 0
    return PlannedRun(agent, environment, seed, spec, path, is_batch, max(n_in_batch, 1))


def check_settings(study: StudySpec, planned: Sequence[PlannedRun]) -> None:
    """Check that the agents can be made with their settings, which imports the libraries.

    Raises:
        UserError: if an agent cannot be made.
    """
    from rl_yardstick.pipeline.preparation import algorithm_kwargs
    from rl_yardstick.pipeline.settings import components

    agents = {agent.label: agent for agent in study.agents}
    for run in planned:
        if run.seed == study.first_seed:
            with _naming_the_place(agents[run.agent]):
                algorithm_kwargs(run.spec)
                callbacks = run.spec.hyperparams.callback
                components.callbacks(callbacks, run.spec.gym_packages, run.path)


@contextmanager
def _naming_the_place(agent: AgentSpec) -> Iterator[None]:
    """Add the place in the study file to errors about an agent."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{agent.where}: {error}" if agent.where else str(error)) from error


def _check_folders(what: str, places: Sequence[tuple[str, str]]) -> None:
    """Refuse labels that are equal, or lead to the same folder."""
    taken: dict[str, str] = {}
    for label, folder in places:
        # Some file systems ignore case, and the difference of "ä" and "a" with a combining mark.
        key = normalize("NFC", folder.casefold())
        first = taken.get(key)
        if first is not None:
            raise UserError(
                f"{what}: {first!r} and {label!r} would share the folder {folder}: "
                "give them labels that differ in letters or digits"
            )
        taken[key] = label


def _is_batch(spec: TrainSpec) -> bool:
    """Whether the runs of a spec form one batch: unchanged bandit agents for one episode."""
    entry, special = ALGORITHMS[spec.algo], spec.hyperparams
    untouched = Hyperparams()
    if not (entry.for_bandits and entry.package is None) or special.n_timesteps is None:
        return False
    if entry.family != "bandits" and not _is_compiled_bandit(spec.algo):
        return False
    env = make_single_env(spec)
    episode = time_limit(env) or 0
    env.close()
    if special.n_timesteps > episode:
        return False
    return all(
        getattr(special, name) == getattr(untouched, name)
        for name in vars(untouched)
        if name not in _BATCH_SETTINGS
    )


def _is_compiled_bandit(algo: str) -> bool:
    """Whether a user's agent is a subclass of this project's compiled bandit agents."""
    from rl_yardstick.agents.bandits.linear import LinearBanditAgent
    from rl_yardstick.agents.bandits.tables import TableBandit

    return issubclass(agent_class(algo), TableBandit | LinearBanditAgent)


def _train_spec(study: StudySpec, agent: AgentSpec, environment: EnvironmentSpec) -> TrainSpec:
    check_algorithm(agent.algo)
    raw, gave_way = _raw_hyperparams(agent, environment)
    place = f"{agent.label} on {environment.label}"
    # Fields that study and run spec share are copied.
    named = {key.name for key in fields(TrainSpec)} & {key.name for key in fields(StudySpec)}
    spec = resolved_spec(
        with_maps_read(environment.env_id, raw),
        place,
        origins=gave_way,
        algo=agent.algo,
        env_id=environment.env_id,
        map_name=map_name(environment.env_id, raw),
        seed=0,
        verbose=0,
        pictures=False,
        **{name: getattr(study, name) for name in named},
    )
    if spec.hyperparams.n_timesteps is None and spec.hyperparams.n_episodes is None:
        raise UserError(f"{place}: how long to train? give n_timesteps or n_episodes")
    if study.is_quick:
        raw = _quickened(spec, study.quick)
        spec = replace(spec, hyperparams=split(raw, place), saved_hyperparams=raw)
    return spec


# The longest runs of a quick look, in steps: of tables in compiled code, and of all other agents.
# In half of the steps, some networks would train in the library's loop, and take longer.
QUICK_TABLE_STEPS, QUICK_STEPS = 200_000, 20_000
STEPS_OF_EPISODE = 100


def _quickened(spec: TrainSpec, quick: QuickSpec) -> dict[str, Any]:
    """The hyperparameters with a small budget."""
    raw = dict(spec.saved_hyperparams)
    is_table = spec.algo not in NETWORKS and "compiled" in ALGORITHMS[spec.algo].engines
    steps = QUICK_TABLE_STEPS if is_table else QUICK_STEPS
    for key, most in (("n_timesteps", steps), ("n_episodes", steps // STEPS_OF_EPISODE)):
        if key in raw:
            less = min(raw[key], most) if quick.budget is None else round(raw[key] * quick.budget)
            raw[key] = max(less, 1)
    return raw


def _raw_hyperparams(
    agent: AgentSpec, environment: EnvironmentSpec
) -> tuple[dict[str, Any], dict[str, str] | None]:
    """The entry of the agent's file, changed by the environment's settings, then by the agent's."""
    raw: dict[str, Any] = {}
    own = layered(environment.settings, agent.settings)
    if agent.tuned or agent.conf_file is not None:
        try:
            kwargs = own.get("env_kwargs")
            raw = read_hyperparams(agent.algo, environment.env_id, agent.conf_file, kwargs)
        except NoEntryError:
            if not (agent.settings or environment.settings):
                raise
    # The environment's settings remove keys with None before the agent's settings apply.
    kept = {
        key: value for key, value in raw.items() if environment.settings.get(key, key) is not None
    }
    return training_follows(layered(kept, own), own)


# --- The seeds of a study on which its settings were tuned, as far as known.

# Settings of length and environment of a run, which are not tuned.
_NO_TUNING = {"n_timesteps", "n_episodes", "env_kwargs", "eval_env_kwargs", "policy", "engine"}

Seeds = frozenset[int]


@dataclass(frozen=True)
class TuningSeeds:
    """The origin of a study's settings, and the seeds of the study on which they were tuned."""

    #: By agent, the seeds of the study on which its settings in ``hyperparams/`` were tuned; empty
    #: for agents with their constructor's defaults.
    shipped: Mapping[str, Seeds]
    files: Mapping[str, Seeds]  #: likewise, by the name of a user's file that lists seeds
    unknown: tuple[str, ...]  #: agents whose settings have unknown tuning seeds
    #: Agents whose settings were tuned with other environment arguments.
    elsewhere: tuple[str, ...] = ()


def tuning_seeds(study: StudySpec) -> TuningSeeds:
    """Find the tuning seeds for all agents of a study on all its environments."""
    shipped: dict[str, Seeds] = {}
    files: dict[str, Seeds] = {}
    unknown: dict[str, None] = {}
    elsewhere: dict[str, None] = {}
    known = lru_cache(maxsize=None)(_said)
    for agent, environment in product(study.agents, study.environments):
        label = agent.group or agent.label
        tuned_on = known(agent.algo, environment.env_id, agent.conf_file)
        own = layered(environment.settings, agent.settings)
        as_it_comes = {key for key in AS_IT_COMES if own.get(key) is None}
        if {*own} - _NO_TUNING - as_it_comes or tuned_on is None:
            unknown[label] = None
        if tuned_on is None:
            continue
        seen = tuned_on if agent.tuned or agent.conf_file else ()
        if seen and _is_changed(agent, environment):
            elsewhere[label] = None
            continue
        place, name = shipped, agent.algo
        if agent.conf_file is not None:
            place, name = files, Path(agent.conf_file).name
        shared = frozenset(seed for seeds in seen for seed in study.seeds if seed in seeds)
        place[name] = place.get(name, frozenset()) | shared
    return TuningSeeds(shipped, files, tuple(unknown), tuple(elsewhere))


def _is_changed(agent: AgentSpec, environment: EnvironmentSpec) -> bool:
    """Whether the study has environment arguments that the entry does not have."""
    own = layered(environment.settings, agent.settings)
    places = agent.algo, environment.env_id, agent.conf_file
    entry = read_hyperparams(*places, own.get("env_kwargs"))
    if entry != read_hyperparams(*places):  # the entry of another id of the same environment
        del own["env_kwargs"]
    merged = layered(entry, own)
    usual = usual_kwargs(environment.env_id)

    def meant(settings: Mapping[str, Any], key: str) -> Any:
        value = settings.get(key) or {}
        return {**usual, **value} if key in MERGED else value

    keys = [key for key in (*MERGED, "train_env_wrapper") if key in own]
    return any(meant(merged, key) != meant(entry, key) for key in keys)


def _said(algo: str, env_id: str, conf_file: Path | None) -> tuple[range, ...] | None:
    try:
        return seeds_tuned_on(algo, env_id, conf_file)
    except UserError:  # the file existed when the runs were planned
        return None
