"""Which of a study's seeds its settings were tuned on, as far as anybody says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from experiments.study_spec import (
    AS_IT_COMES,
    MERGED,
    AgentSpec,
    EnvironmentSpec,
    StudySpec,
    layered,
)
from pipeline.environments import usual_kwargs
from pipeline.errors import UserError
from pipeline.settings.hyperparams import read_hyperparams, seeds_tuned_on

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
        own = layered(environment.settings, agent.settings)
        as_it_comes = {key for key in AS_IT_COMES if own.get(key) is None}
        if {*own} - _NO_TUNING - as_it_comes or tuned_on is None:
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
    places = agent.algo, environment.env_id, agent.conf_file
    entry = read_hyperparams(*places, own.get("env_kwargs"))
    if entry != read_hyperparams(*places):  # that of the same environment by another name
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
