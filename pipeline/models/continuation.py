"""Going on with a trained agent: what it brings along from its training.

A new run begins, in a folder of its own, with so many further steps. As in rl_zoo3, the agent's
networks or tables, its statistics of VecNormalize and its replay buffer go on, and hyperparameters
are those of the new run's entry. Other than there, the agent's steps are counted on, and schedules
are where so many of all steps put them, rather than at their beginning.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.models.companions import replay_buffer_of, statistics_of
from pipeline.models.model_finding import model_at
from pipeline.models.model_loading import agent_class, load_model, load_replay_buffer
from pipeline.models.model_zips import ModelFile, read_model
from pipeline.models.normalization import Statistics, normalising, read_statistics
from pipeline.models.recorded_runs import check_digest, run_around
from pipeline.train_spec import TrainSpec

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv


def agent_to_continue(path: Path) -> Path:
    """The zip that a path means, with or without its suffix, or of a run folder.

    What goes with it is looked at too, before a run begins that could not.

    Raises:
        UserError: if there is none, or it or what goes with it is not as its run left it.
    """
    model = model_at(path)
    run = run_around(model)
    read_model(model, run)
    for file in (_statistics_path(model), replay_buffer_of(model)):
        if file is not None:
            check_digest(run, file)
    return model


def model_to_continue(spec: TrainSpec) -> ModelFile | None:
    """The zip of the agent to go on with, read once and for all; None for a new agent.

    Raises:
        UserError: if it is no such zip, or not as its run left it.
    """
    if spec.trained_agent is None:
        return None
    return read_model(spec.trained_agent, run_around(spec.trained_agent))


def statistics_to_continue(spec: TrainSpec) -> Statistics | None:
    """The statistics that go on with the agent; None where there are none, or none are wanted.

    Raises:
        UserError: if they cannot be read, or are not as their run left them.
    """
    if spec.trained_agent is None or spec.saved_hyperparams.get("normalize") is False:
        return None
    path = _statistics_path(spec.trained_agent)
    return None if path is None else read_statistics(path, run_around(spec.trained_agent))


def continuing(spec: TrainSpec, statistics: Statistics) -> TrainSpec:
    """The spec with environments that normalise as before, but for what its entry says of that."""
    return normalising(spec, {**statistics.settings, **(spec.hyperparams.normalize or {})})


def load_to_continue(spec: TrainSpec, file: ModelFile, env: VecEnv, **kwargs: Any) -> BaseAlgorithm:
    """The agent as it was, with its replay buffer, on ``env`` and with these hyperparameters.

    Raises:
        UserError: if it cannot be loaded so.
    """
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    # The networks are those of the file: their shape cannot change.
    kwargs = {k: v for k, v in kwargs.items() if k not in ("policy", "policy_kwargs")}
    if "n_steps" in kwargs and issubclass(agent_class(spec.algo), OffPolicyAlgorithm):
        # The library chooses a kind of buffer by it, and would leave that of the file.
        kwargs = {"replay_buffer_class": None, "replay_buffer_kwargs": {}, **kwargs}
    model = load_model(spec.algo, file, env, spec.user_modules, device=spec.device, **kwargs)
    replay_buffer = replay_buffer_of(file.path)
    if replay_buffer is not None:
        load_replay_buffer(model, replay_buffer, run_around(file.path))
    return model


def _statistics_path(model: Path) -> Path | None:
    run = run_around(model)
    return statistics_of(model, None if run is None else run.params_path)
