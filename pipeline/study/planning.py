"""From a study to the runs that it takes: one for each agent, environment and seed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline import hyperparams
from pipeline.environments import check_env_id
from pipeline.errors import UserError
from pipeline.requests import check_algorithm, check_fit
from pipeline.run import FINISHED, Run, environment_name
from pipeline.specs import TrainSpec
from pipeline.study.spec import AgentSpec, EnvironmentSpec, StudySpec, file_name

_MERGED = ("env_kwargs", "train_env_kwargs", "eval_env_kwargs")
# What a run of the same settings may differ in: where it is written, and what is shown meanwhile.
_NO_PART_OF_IDENTITY = (
    "log_folder",
    "tensorboard_log",
    "verbose",
    "progress",
    "log_interval",
    "pictures",
)


@dataclass(frozen=True)
class PlannedRun:
    """One run of a study.

    Attributes:
        agent: label of the agent.
        environment: label of the environment.
        seed: its seed.
        spec: what to train.
        path: its folder, there once it has finished.
    """

    agent: str
    environment: str
    seed: int
    spec: TrainSpec
    path: Path

    @property
    def run(self) -> Run:
        """The run folder."""
        return Run(self.path, environment_name(self.spec.env_id))

    @property
    def is_finished(self) -> bool:
        """Whether the folder holds this very run, to its end."""
        info = self.run.read_info()
        return info.get("state") == FINISHED and _identity(info["spec"]) == _identity(
            self.spec.as_data()
        )


def _identity(spec: Mapping[str, Any]) -> Any:
    kept = {key: value for key, value in spec.items() if key not in _NO_PART_OF_IDENTITY}
    return json.loads(json.dumps(kept))


def plan(study: StudySpec, root: Path) -> list[PlannedRun]:
    """All runs of a study, those of one seed together, so that agents can be compared early.

    Args:
        study: the study.
        root: its folder.

    Raises:
        UserError: if an agent cannot be trained so, or does not fit an environment.
    """
    specs = {}
    for environment in study.environments:
        check_env_id(environment.env_id)
        for agent in study.agents:
            spec = _train_spec(study, agent, environment)
            check_fit(spec)
            specs[agent.label, environment.label] = spec
    return [
        PlannedRun(
            agent,
            environment,
            seed,
            replace(spec, seed=seed),
            # From 1, since 0 asks the tools of rl_zoo3 for the newest run.
            root / "runs" / file_name(agent) / f"{file_name(environment)}_{seed + 1}",
        )
        for seed in range(study.n_seeds)
        for (agent, environment), spec in specs.items()
    ]


def _train_spec(study: StudySpec, agent: AgentSpec, environment: EnvironmentSpec) -> TrainSpec:
    check_algorithm(agent.algo)
    raw = _raw_hyperparams(agent, environment)
    place = f"{agent.label} on {environment.label}"
    if study.is_quick:
        raw = _shortened(raw, study.quick.budget)
    spec = TrainSpec(
        algo=agent.algo,
        env_id=environment.env_id,
        hyperparams=hyperparams.split(raw, place),
        saved_hyperparams=raw,
        seed=0,
        eval_freq=study.eval_freq,
        eval_episodes=study.eval_episodes,
        verbose=0,
        pictures=False,
    )
    if spec.hyperparams.n_timesteps is None and spec.hyperparams.n_episodes is None:
        raise UserError(f"{place}: how long to train? give n_timesteps or n_episodes")
    return spec


def _raw_hyperparams(agent: AgentSpec, environment: EnvironmentSpec) -> dict[str, Any]:
    """The agent's file, the environment's settings over it, and the agent's own over those."""
    raw: dict[str, Any] = {}
    if agent.tuned:
        try:
            raw = hyperparams.read_hyperparams(agent.algo, environment.env_id)
        except hyperparams.NoEntryError:
            if not (agent.settings or environment.settings):
                raise
    for settings in (environment.settings, agent.settings):
        merged = {
            key: {**(raw.get(key) or {}), **settings[key]}
            for key in _MERGED
            if isinstance(settings.get(key), dict)
        }
        raw = hyperparams.override(raw, {**settings, **merged})
    return raw


def _shortened(raw: Mapping[str, Any], share: float) -> dict[str, Any]:
    return {
        key: max(round(value * share), 1) if key in ("n_timesteps", "n_episodes") else value
        for key, value in raw.items()
    }
