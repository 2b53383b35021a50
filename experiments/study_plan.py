"""From a study to the runs that it takes: one for each agent, environment and seed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any
from unicodedata import normalize

from agents import ALGORITHMS
from envs.known_models import time_limit
from experiments.planned_runs import PlannedRun
from experiments.study_spec import AgentSpec, EnvironmentSpec, StudySpec, file_name, layered
from pipeline.agent_checks import check_algorithm, check_fit
from pipeline.auto_settings import resolved_spec, training_follows
from pipeline.environments import check_env_id, make_single_env, with_maps_read
from pipeline.errors import UserError
from pipeline.memory_limits import check_pulls
from pipeline.models.load import agent_class
from pipeline.runs import environment_name
from pipeline.settings.hyperparams import Hyperparams, NoEntryError, read_hyperparams, split
from pipeline.train_spec import TrainSpec

MOST_RUNS = 1_000_000

# What a batch can follow, besides the agent's own arguments.
_BATCH_SETTINGS = ("n_timesteps", "env_kwargs", "algorithm")


def plan(
    study: StudySpec, root: Path, counts: Mapping[tuple[str, str], int] | None = None
) -> list[PlannedRun]:
    """All runs of a study, those of one seed together, so that agents can be compared early.

    Args:
        study: the study.
        root: its folder.
        counts: by labels of agent and environment, with how many of the seeds; with all of them,
            where it is not said.

    Raises:
        UserError: if an agent cannot be trained so, or does not fit an environment.
    """
    _check_number(study)
    _check_folders("agents", [(agent.label, file_name(agent.label)) for agent in study.agents])
    _check_folders(
        "environments",
        [(e.label, _environment_folder(e.label, e.env_id)) for e in study.environments],
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
    n_seeds = {labels: (counts or {}).get(labels, study.n_seeds) for labels in specs}
    for labels in batches:
        check_pulls(
            n_seeds[labels], specs[labels].hyperparams.n_timesteps or 0, " on ".join(labels)
        )
    return [
        _planned_run(study, root, *labels, seed, spec, n_seeds[labels] if labels in batches else 0)
        for seed in study.seeds
        for labels, spec in specs.items()
        if seed == study.first_seed
        or (labels not in batches and seed - study.first_seed < n_seeds[labels])
    ]


def _check_number(study: StudySpec) -> None:
    n_agents, n_environments = len(study.agents), len(study.environments)
    n_runs = n_agents * n_environments * study.n_seeds
    if n_runs > MOST_RUNS:
        raise UserError(
            f"{study.name}: {n_agents:,} agents on {n_environments:,} environments with "
            f"{study.n_seeds:,} seeds are {n_runs:,} runs; a study has {MOST_RUNS:,} at most"
        )


def _planned_run(
    study: StudySpec,
    root: Path,
    agent: str,
    environment: str,
    seed: int,
    spec: TrainSpec,
    n_in_batch: int,
) -> PlannedRun:
    # From 1, since 0 asks the tools of rl_zoo3 for the newest run.
    folder = _environment_folder(environment, spec.env_id)
    place = Path(file_name(agent), f"{folder}_{seed + 1}")
    spec = replace(
        spec,
        seed=seed,
        tensorboard_log=root / "tensorboard" / place if study.tensorboard else None,
        save_every_n_episodes=study.render_every if seed == study.first_seed else -1,
    )
    path, is_batch = root / "runs" / place, n_in_batch > 0
    return PlannedRun(agent, environment, seed, spec, path, is_batch, max(n_in_batch, 1))


def _environment_folder(label: str, env_id: str) -> str:
    """The label as a file name; where it is the id itself, as `train.py` writes that."""
    return file_name(environment_name(label) if label == env_id else label)


def check_settings(study: StudySpec, planned: Sequence[PlannedRun]) -> None:
    """Make sure that the agents can be made with their settings, which takes the libraries.

    Raises:
        UserError: if one cannot.
    """
    from pipeline.preparation import algorithm_kwargs
    from pipeline.settings import components

    agents = {agent.label: agent for agent in study.agents}
    for run in planned:
        if run.seed == study.first_seed:
            with _naming_the_place(agents[run.agent]):
                algorithm_kwargs(run.spec)
                callbacks = run.spec.hyperparams.callback
                components.callbacks(callbacks, run.spec.gym_packages, run.path)


@contextmanager
def _naming_the_place(agent: AgentSpec) -> Iterator[None]:
    """Say in mistakes where the study asks for the agent."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{agent.where}: {error}" if agent.where else str(error)) from error


def _check_folders(what: str, places: Sequence[tuple[str, str]]) -> None:
    """Refuse labels that are the same, or would have the same folder."""
    taken: dict[str, str] = {}
    for label, folder in places:
        # Some file systems do not tell upper from lower case, nor "ä" from "a" with two dots.
        key = normalize("NFC", folder.casefold())
        first = taken.get(key)
        if first is not None:
            raise UserError(
                f"{what}: {first!r} and {label!r} would share the folder {folder}: "
                "give them labels that differ in letters or digits"
            )
        taken[key] = label


def _is_batch(spec: TrainSpec) -> bool:
    """Whether the runs of a spec go as one batch: bandit agents as they are, for one episode."""
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
    """Whether an agent of the user's is of our bandit agents' kind."""
    from agents.bandits.linear_bandits import LinearBanditAgent
    from agents.bandits.table_bandit import TableBandit

    return issubclass(agent_class(algo), TableBandit | LinearBanditAgent)


def _train_spec(study: StudySpec, agent: AgentSpec, environment: EnvironmentSpec) -> TrainSpec:
    check_algorithm(agent.algo)
    raw, gave_way = _raw_hyperparams(agent, environment)
    place = f"{agent.label} on {environment.label}"
    # A field of the study that has the name of one of the run goes there as it is.
    named = {key.name for key in fields(TrainSpec)} & {key.name for key in fields(StudySpec)}
    spec = resolved_spec(
        with_maps_read(environment.env_id, raw),
        place,
        origins=gave_way,
        algo=agent.algo,
        env_id=environment.env_id,
        seed=0,
        verbose=0,
        pictures=False,
        **{name: getattr(study, name) for name in named},
    )
    if spec.hyperparams.n_timesteps is None and spec.hyperparams.n_episodes is None:
        raise UserError(f"{place}: how long to train? give n_timesteps or n_episodes")
    if study.is_quick:
        raw = _shortened(spec.saved_hyperparams, study.quick.budget)
        spec = replace(spec, hyperparams=split(raw, place), saved_hyperparams=raw)
    return spec


def _raw_hyperparams(
    agent: AgentSpec, environment: EnvironmentSpec
) -> tuple[dict[str, Any], dict[str, str] | None]:
    """The agent's file, changed by the environment's settings, and these by the agent's own."""
    raw: dict[str, Any] = {}
    own = layered(environment.settings, agent.settings)
    if agent.tuned or agent.conf_file is not None:
        try:
            kwargs = own.get("env_kwargs")
            raw = read_hyperparams(agent.algo, environment.env_id, agent.conf_file, kwargs)
        except NoEntryError:
            if not (agent.settings or environment.settings):
                raise
    # What the environment's settings take away is gone before the agent's own come.
    kept = {
        key: value for key, value in raw.items() if environment.settings.get(key, key) is not None
    }
    return training_follows(layered(kept, own), own)


def _shortened(raw: Mapping[str, Any], share: float) -> dict[str, Any]:
    return {
        key: max(round(value * share), 1) if key in ("n_timesteps", "n_episodes") else value
        for key, value in raw.items()
    }
