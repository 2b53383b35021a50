"""Which of a study's seeds its settings were tuned on, as far as anybody says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from experiments.study_spec import MERGED, AgentSpec, EnvironmentSpec, StudySpec, layered
from pipeline.errors import UserError
from pipeline.settings.hyperparam_entries import read_hyperparams, seeds_tuned_on

# How long a run is, and on what: nothing that an agent would be tuned in.
_NO_TUNING = {"n_timesteps", "n_episodes", "env_kwargs", "eval_env_kwargs", "policy", "engine"}

Seeds = frozenset[int]


@dataclass(frozen=True)
class TuningSeeds:
    """Where the settings of a study come from, and which of its seeds they were tuned on.

    Attributes:
        shipped: by agent, the seeds of the study that its settings in ``hyperparams/`` were tuned
            on; of agents whose constructor's defaults are taken too, which are none.
        files: likewise by the name of a file of the user's that says so.
        unknown: agents with settings of which nobody says what they were tuned on.
        elsewhere: agents whose settings were tuned with other arguments of the environment.
    """

    shipped: Mapping[str, Seeds]
    files: Mapping[str, Seeds]
    unknown: tuple[str, ...]
    elsewhere: tuple[str, ...] = ()


def tuning_seeds(study: StudySpec) -> TuningSeeds:
    """Find out for all agents of a study on all of its environments."""
    shipped: dict[str, Seeds] = {}
    files: dict[str, Seeds] = {}
    unknown: dict[str, None] = {}
    elsewhere: dict[str, None] = {}
    known = lru_cache(maxsize=None)(_said)
    for agent, environment in _pairs(study):
        tuned_on = known(agent.algo, environment.env_id, agent.conf_file)
        begins_with_defaults = not (agent.tuned or agent.conf_file)
        if {*agent.settings, *environment.settings} - _NO_TUNING or tuned_on is None:
            unknown[agent.group or agent.label] = None
        if tuned_on is None:
            continue
        seen = () if begins_with_defaults else tuned_on
        if seen and _is_changed(agent, environment):
            elsewhere[agent.group or agent.label] = None
            continue
        place, name = _source(agent, shipped, files)
        shared = frozenset(seed for seeds in seen for seed in study.seeds if seed in seeds)
        place[name] = place.get(name, frozenset()) | shared
    return TuningSeeds(shipped, files, tuple(unknown), tuple(elsewhere))


def _is_changed(agent: AgentSpec, environment: EnvironmentSpec) -> bool:
    """Whether the study has arguments of the environment that the entry does not have."""
    own = layered(environment.settings, agent.settings)
    entry = read_hyperparams(agent.algo, environment.env_id, agent.conf_file)
    merged = layered(entry, own)
    return any((merged.get(key) or {}) != (entry.get(key) or {}) for key in MERGED if own.get(key))


def _said(algo: str, env_id: str, conf_file: Path | None) -> tuple[range, ...] | None:
    try:
        return seeds_tuned_on(algo, env_id, conf_file)
    except UserError:  # a file that was there when the runs were planned
        return None


def _pairs(study: StudySpec) -> Iterator[tuple[AgentSpec, EnvironmentSpec]]:
    return ((agent, place) for agent in study.agents for place in study.environments)


def _source(
    agent: AgentSpec, shipped: dict[str, Seeds], files: dict[str, Seeds]
) -> tuple[dict[str, Seeds], str]:
    if agent.conf_file is None:
        return shipped, agent.algo
    return files, Path(agent.conf_file).name
