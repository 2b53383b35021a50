"""On which engine networks will train, and what that takes: found out before a training begins."""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import dataclass
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from agents.common.callbacks import EpisodeBudget
from agents.compiled.worlds import NotCompilable
from agents.networks.engine_setting import CompiledNetworks, EnginePlan, Work
from agents.networks.network_worlds import network_world
from pipeline.environments import make_training_env
from pipeline.preparation import algorithm_kwargs, make_model
from pipeline.settings import components
from pipeline.train_spec import NETWORKS, TrainSpec
from pipeline.training import UNBOUNDED_TIMESTEPS


@dataclass(frozen=True)
class EngineOutlook:
    """On which engine a training will run, and on which it could.

    Attributes:
        plan: the engine that it will run on.
        auto: the one that ``engine: auto`` would choose.
        work: what it does; None where nobody knows what a step of the environment takes.
    """

    plan: EnginePlan
    auto: EnginePlan
    work: Work | None


def engine_outlook(
    model: BaseAlgorithm, spec: TrainSpec, callbacks: list[BaseCallback]
) -> EngineOutlook | None:
    """The outlook of an agent that is there; None for one that has no networks, or one engine."""
    if not isinstance(model, CompiledNetworks):
        return None
    n_timesteps = spec.hyperparams.n_timesteps or UNBOUNDED_TIMESTEPS
    plan = model.engine_plan(n_timesteps, callbacks)
    auto = model.engine_plan(n_timesteps, callbacks, "auto")
    return EngineOutlook(
        plan, auto, model.work(n_timesteps, callbacks) if _is_timed(model) else None
    )


def _is_timed(model: Any) -> bool:
    try:
        network_world(model.env)
    except NotCompilable:
        return False
    return True


def planned_outlook(spec: TrainSpec) -> EngineOutlook | None:
    """The same of a run that another process will do: its agent is made here, and thrown away.

    Whatever goes wrong, the run itself will say so.
    """
    if spec.algo not in NETWORKS:
        return None
    with (
        contextlib.suppress(Exception),
        warnings.catch_warnings(action="ignore"),
        contextlib.closing(make_training_env(spec, None)) as env,
    ):
        model = make_model(spec, None, env, algorithm_kwargs(spec))
        special, modules = spec.hyperparams, spec.gym_packages
        callbacks = components.callbacks(special.callback, modules, spec.log_folder)
        if special.n_episodes is not None:
            callbacks.append(EpisodeBudget(special.n_episodes))
        return engine_outlook(model, spec, callbacks)
    return None
