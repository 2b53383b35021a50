"""From a study to its runs: one for each agent, environment and seed, and its record on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from rl_yardstick.agents.registry import ALGORITHMS
from rl_yardstick.envs.known_models import found_model, time_limit
from rl_yardstick.experiments.study import (
    AS_IT_COMES,
    AgentSpec,
    EnvironmentSpec,
    QuickSpec,
    StudySpec,
    file_name,
)
from rl_yardstick.pipeline import environments, settings
from rl_yardstick.pipeline.errors import UserError, as_user_error, shown
from rl_yardstick.pipeline.files import plain, read_json, write_json
from rl_yardstick.pipeline.run import FINISHED, Run
from rl_yardstick.pipeline.spec import TrainSpec

# Fields in which runs with the same results may differ: what is written beside them.
MAY_DIFFER = (
    *("origins", "map_name", "tensorboard_log", "gym_packages", "save_every_n_episodes"),
    *("pictures", "log_interval", "library_log"),
)
FINAL_EPISODES = 100  # of the sampled evaluation at the end of a run

Labels = tuple[str, str]  # of agent and environment
Specs = Mapping[Labels, TrainSpec]


@dataclass(frozen=True)
class PlannedRun:
    """One run of a study."""

    agent: str  #: label of the agent
    environment: str  #: label of the environment
    seed: int  #: its seed
    spec: TrainSpec  #: its specification
    path: Path  #: its folder
    is_batch: bool = False  #: of all seeds of a bandit agent; ``seed`` is the first
    n_runs: int = 1  #: the number of runs in the batch
    on_memory_scale: bool = False  #: whether some agent here has a memory

    @property
    def labels(self) -> Labels:
        """The labels of agent and environment."""
        return self.agent, self.environment

    @property
    def title(self) -> str:
        """The run in a few words."""
        return f"{self.agent} on {self.environment}, seed {self.seed}"

    @property
    def run(self) -> Run:
        """The run folder."""
        return Run(self.path)

    def recorded(self) -> dict[str, Any]:
        """The content of ``run.json``; empty without a readable one."""
        try:
            return self.run.recorded()
        except UserError:
            return {}

    @property
    def is_finished(self) -> bool:
        """Whether the folder holds this run, and it has finished."""
        return self.is_finished_by(self.recorded())

    def is_finished_by(self, recorded: Mapping[str, Any]) -> bool:
        """Whether a ``run.json`` with this content says that the run has finished."""
        if recorded.get("state") != FINISHED or self.differences(recorded):
            return False
        wanted = self.spec.save_every_n_episodes
        has_checkpoints = wanted < 1 or recorded["spec"]["save_every_n_episodes"] == wanted
        return recorded.get("n_runs", 1) == self.n_runs and (has_checkpoints or self.is_batch)

    def differences(self, recorded: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
        """By name, the recorded and the wanted values of settings that differ."""
        there, here = _settings(recorded.get("spec")), _settings(self.spec.model_dump())
        names = [name for name in {**there, **here} if there.get(name) != here.get(name)]
        return {name: (there.get(name), here.get(name)) for name in names}


def _settings(spec: Any) -> dict[str, Any]:
    """The settings of a spec that decide its results, by name."""
    spec = {k: v for k, v in plain(spec or {}).items() if k not in MAY_DIFFER and k != "seed"}
    algorithm = spec.pop("algorithm", {})
    return {**spec, **algorithm}


# --- the runs of a study --------------------------------------------------------------------------


def plan(
    study: StudySpec,
    root: Path,
    counts: Mapping[Labels, int] | None = None,
    specs: Specs | None = None,
) -> list[PlannedRun]:
    """Plan all runs of a study in the folder ``root``, by seed: agents can be compared early.

    ``counts`` has the number of seeds by labels of agent and environment, by default all; ``specs``
    what is trained, by default `specs_of` the study.
    """
    specs = specs or specs_of(study)
    folders = {one.label: one.folder for one in study.environments}
    batches = {labels for labels, spec in specs.items() if _is_batch(spec)}
    with_memory = {labels[1] for labels, spec in specs.items() if environments.remembers(spec)}
    planned = []
    for seed, (labels, spec) in product(study.seeds, specs.items()):
        n_seeds, is_batch = (counts or {}).get(labels, study.n_seeds), labels in batches
        is_first = seed == study.first_seed
        if not is_first and (is_batch or seed - study.first_seed >= n_seeds):
            continue
        # From 1, because 0 means the newest run in rl_zoo3's tools.
        place = Path(file_name(labels[0]), f"{folders[labels[1]]}_{seed + 1}")
        spec = spec.changed(  # noqa: PLW2901
            seed=seed,
            tensorboard_log=str(root / "tensorboard" / place) if study.tensorboard else None,
            save_every_n_episodes=(study.render_every or -1) if is_first else -1,
        )
        n_runs, on_memory_scale = n_seeds if is_batch else 1, labels[1] in with_memory
        path = root / "runs" / place
        planned.append(PlannedRun(*labels, seed, spec, path, is_batch, n_runs, on_memory_scale))
    return planned


def specs_of(study: StudySpec) -> dict[Labels, TrainSpec]:
    """What each agent trains on each environment, but for the seed.

    Raises UserError if an agent's settings are invalid, or it does not fit an environment.
    """
    _check_folders("agents", [(agent.label, file_name(agent.label)) for agent in study.agents])
    _check_folders("environments", [(one.label, one.folder) for one in study.environments])
    specs = {}
    for environment, agent in product(study.environments, study.agents):
        environments.check_env_id(environment.env_id)
        place = f"{agent.where}: " if agent.where else ""
        with as_user_error(f"{place}{agent.label} on {environment.label}", UserError):
            specs[agent.label, environment.label] = spec = _train_spec(study, agent, environment)
            environments.check_fit(spec)
            with closing(environments.make_single_env(spec)) as env:
                found_model(env)  # a search is done once, before the workers begin
    return specs


def _check_folders(what: str, places: Sequence[tuple[str, str]]) -> None:
    """Refuse labels that are equal, or lead to the same folder."""
    taken: dict[str, str] = {}
    for label, folder in places:
        key = folder.casefold()  # some file systems ignore case
        if key in taken:
            both = f"{what}: {taken[key]!r} and {label!r} would share the folder {folder}"
            raise UserError(f"{both}: give them labels that differ in letters or digits")
        taken[key] = label


def _is_batch(spec: TrainSpec) -> bool:
    """Whether the runs of a spec form one batch: unchanged bandit agents for one episode."""
    entry = ALGORITHMS[spec.algo]
    if not (entry.for_bandits and entry.package is None) or spec.n_timesteps is None:
        return False
    if entry.family != "bandits":
        from rl_yardstick.agents import load_algorithm
        from rl_yardstick.agents.bandits.linear import LinearBanditAgent
        from rl_yardstick.agents.bandits.tables import TableBandit

        # A user's agent may be a subclass.
        if not issubclass(load_algorithm(spec.algo), TableBandit | LinearBanditAgent):
            return False
    with closing(environments.make_single_env(spec)) as env:
        if spec.n_timesteps > (time_limit(env) or 0):
            return False
    # What a batch supports besides the agent's own arguments.
    return not spec.hyperparams.keys() - {"n_timesteps", "env_kwargs", *spec.algorithm}


def _train_spec(study: StudySpec, agent: AgentSpec, environment: EnvironmentSpec) -> TrainSpec:
    place, changes = (agent.algo, environment.env_id), (environment.settings, agent.settings)
    settings.check_agent(agent.algo)
    if agent.tuned or agent.conf_file is not None:
        entry, origins = settings.changed_entry(*place, agent.conf_file, *changes)
    else:
        entry, origins = settings.layered(*changes), {}
    spec = settings.read_spec(
        *place,
        entry,
        origins=origins,
        pictures=False,
        eval_freq=study.eval_freq,
        eval_episodes=study.eval_episodes,
        final_episodes=FINAL_EPISODES,
        gym_packages=list(study.gym_packages),
        diagnose=study.diagnose,
        exact_model=study.exact_model,
    )
    return spec.changed(**_quickened(spec, study.quick)) if study.is_quick else spec


# The longest runs of a quick look, in steps: of tables in compiled code, and of all other agents.
# In half of the steps, some networks would train in the library's loop, and take longer.
QUICK_TABLE_STEPS, QUICK_STEPS = 200_000, 20_000
STEPS_OF_EPISODE = 100


def _quickened(spec: TrainSpec, quick: QuickSpec) -> dict[str, int]:
    entry = ALGORITHMS[spec.algo]
    is_table = entry.family != "library" and "compiled" in entry.engines
    steps = QUICK_TABLE_STEPS if is_table else QUICK_STEPS
    found = {}
    for key, most in (("n_timesteps", steps), ("n_episodes", steps // STEPS_OF_EPISODE)):
        if (budget := getattr(spec, key)) is not None:
            less = min(budget, most) if quick.budget is None else round(budget * quick.budget)
            found[key] = max(less, 1)
    return found


# --- the record of a study ------------------------------------------------------------------------

RECORD = "study.json"
MAX_RECORD = 1_000_000_000  # bytes
_STUDY = TypeAdapter(StudySpec)


@dataclass(frozen=True)
class StudyRecord:
    """What a study's folder says of it, so that it can be resumed or done again elsewhere."""

    study: StudySpec
    specs: Specs  #: what each agent trains on each environment
    #: The seeds of an agent at each look, if the study grows until it is decided; else empty.
    looks: tuple[int, ...] = ()

    def write(self, root: Path) -> None:
        """Write ``study.json``, before the first run."""
        items = self.specs.items()
        specs = [{"agent": a, "environment": e, "spec": s.model_dump()} for (a, e), s in items]
        study = asdict(self.study)
        write_json(root / RECORD, {"study": study, "looks": self.looks, "specs": specs})

    @classmethod
    def read(cls, root: Path) -> StudyRecord:
        """Read ``study.json`` as data; UserError if there is none, or not one of this version."""
        if not (root / RECORD).exists():
            raise UserError(f"{root} is no study: it has no {RECORD}")
        data = read_json(root / RECORD, MAX_RECORD)
        try:
            study = _STUDY.validate_python(data["study"])
            # A record of a stranger names no module and no place outside the folder.
            own = {"gym_packages": [*study.gym_packages], "trained_agent": None}
            own |= {"tensorboard_log": None, "watch_learning": None}
            specs = {
                (str(one["agent"]), str(one["environment"])): TrainSpec(**{**one["spec"], **own})
                for one in data["specs"]
            }
            return cls(study, specs, tuple(map(int, data["looks"])))
        except (ValidationError, LookupError, TypeError, ValueError) as error:
            raise UserError(f"{root / RECORD} is no study of this version") from error


# --- studies that get more seeds until all pairs are decided --------------------------------------

MOST_SEEDS = 80


def plan_of_looks(study: StudySpec, root: Path, most: int | None) -> tuple[int, ...]:
    """The seeds at each look of a study, fixed before the first look and kept in ``study.json``.

    ``most`` is the largest number of seeds of an agent; None: as planned before, or ``MOST_SEEDS``.

    Raises UserError if this differs from an earlier plan, or there is nothing to decide.
    """
    if len(study.agents) < 2:
        raise UserError(f"{study.name}: --until-decided takes two agents or more")
    if most is not None and most < study.n_seeds:
        raise UserError(f"--max-seeds is {most}, the study begins with {study.n_seeds} seeds")
    before = StudyRecord.read(root) if (root / RECORD).exists() else None
    if before is None or not before.looks:
        return look_sizes(study.n_seeds, max(most or MOST_SEEDS, study.n_seeds))
    looks = look_sizes(study.n_seeds, most or before.looks[-1])
    there, here = (
        {
            "looks": [*sizes],
            "agents": sorted(agent.label for agent in one.agents),
            "environments": sorted(environment.label for environment in one.environments),
            **{name: getattr(one, name) for name in ("metric", "margin", "first_seed", "against")},
        }
        for one, sizes in ((before.study, before.looks), (study, looks))
    )
    if changed := [f"{k} {there[k]}, now {here[k]}" for k in there if there[k] != here[k]]:
        raise UserError(
            f"{root}: the looks were planned before the first of them and cannot change "
            f"({'; '.join(changed)}): --name NAME makes another study"
        )
    return looks


def look_sizes(first: int, most: int) -> tuple[int, ...]:
    """The number of seeds of an agent at each look: twice as many as before, up to ``most``."""
    sizes = [first]
    while sizes[-1] < most:
        sizes.append(min(2 * sizes[-1], most))
    return tuple(sizes)


def check_settings_kept(root: Path, planned: Sequence[PlannedRun]) -> None:
    """Refuse a study in whose folder runs have finished with other settings."""
    recorded = [(run, run.recorded()) for run in planned]
    finished = [(run, found) for run, found in recorded if found.get("state") == FINISHED]
    others = [there for run, found in finished if (there := run.differences(found))]
    if others:
        pairs = {key: pair for settings in others for key, pair in settings.items()}
        named = [f"{key}: {shown(a)} there, {shown(b)} now" for key, (a, b) in pairs.items()]
        words = "; ".join(named[:3]) + ("; ..." if len(named) > 3 else "")
        runs = "1 finished run has" if len(others) == 1 else f"{len(others)} finished runs have"
        fault = f"{root}: {runs} other settings ({words})"
        raise UserError(f"{fault}: give the study another folder by --name NAME")


# --- the seeds of a study on which its settings were tuned, as far as known -----------------------

# Settings of length and environment of a run, which are not tuned.
_NO_TUNING = {*settings.BUDGETS, "env_kwargs", "eval_env_kwargs", "policy", "engine"}

Seeds = frozenset[int]


@dataclass(frozen=True)
class TuningSeeds:
    """The origin of a study's settings, and the seeds of the study on which they were tuned."""

    #: By agent, those of its settings in ``hyperparams/``; empty for its constructor's defaults.
    shipped: Mapping[str, Seeds]
    files: Mapping[str, Seeds]  #: likewise, by the name of a user's file that lists seeds
    unknown: tuple[str, ...]  #: agents whose settings have unknown tuning seeds
    elsewhere: tuple[str, ...] = ()  #: agents tuned with other environment arguments
    of_logs: bool = False  #: whether the runs were done elsewhere


def tuning_seeds(study: StudySpec) -> TuningSeeds:
    """Find the tuning seeds for all agents of a study on all its environments."""
    shipped, files = dict[str, Seeds](), dict[str, Seeds]()
    unknown, elsewhere = dict[str, None](), dict[str, None]()

    @cache
    def known(algo: str, env_id: str, conf_file: Path | None) -> tuple[range, ...] | None:
        with suppress(UserError):  # the file existed when the runs were planned
            return settings.seeds_tuned_on(algo, env_id, conf_file)
        return None

    for agent, environment in product(study.agents, study.environments):
        label = agent.group or agent.label
        tuned_on = known(agent.algo, environment.env_id, agent.conf_file)
        own = settings.layered(environment.settings, agent.settings)
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
            place, name = files, agent.conf_file.name
        shared = frozenset(seed for seeds in seen for seed in study.seeds if seed in seeds)
        place[name] = place.get(name, frozenset()) | shared
    return TuningSeeds(shipped, files, tuple(unknown), tuple(elsewhere), bool(study.figure))


def _is_changed(agent: AgentSpec, environment: EnvironmentSpec) -> bool:
    """Whether the study has environment arguments that the entry does not have."""
    own = settings.layered(environment.settings, agent.settings)
    places = agent.algo, environment.env_id, agent.conf_file
    entry = settings.read_entry(*places, own.get("env_kwargs"))
    if entry != settings.read_entry(*places):  # the entry of another id of the same environment
        del own["env_kwargs"]
    merged, usual = settings.layered(entry, own), environments.usual_kwargs(environment.env_id)

    def meant(given: Mapping[str, Any], key: str) -> Any:
        value = given.get(key) or {}
        return {**usual, **value} if key in settings.ENV_KWARGS else value

    keys = [key for key in (*settings.ENV_KWARGS, "train_env_wrapper") if key in own]
    return any(meant(merged, key) != meant(entry, key) for key in keys)
