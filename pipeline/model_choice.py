"""Finding the model to play: the newest of a run, its best, a checkpoint, or a zip by its path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pipeline.agent_checks import check_algorithm
from pipeline.environments import check_env_id
from pipeline.errors import UserError
from pipeline.model_loading import (
    check_model_file,
    check_origin,
    hand_written_algorithm,
    run_of,
)
from pipeline.module_records import check_recorded
from pipeline.run_folder import Run
from pipeline.settings.hyperparam_entries import read_hyperparams
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.user_modules import UserModule


@dataclass(frozen=True)
class ModelRequest:
    """Which model is asked for.

    Attributes:
        path: a zip, instead of looking for a run.
        algo: name of the agent; None for what the zip or its run folder says, or else ``"ppo"``.
        env_id: id of the environment; None for what the run folder says, or else
            ``"CartPole-v1"``.
        log_folder: the folder above all runs.
        run_number: number of the run; 0 for the newest.
        which: the model at the end of training, the best, that of the last checkpoint, or that of
            the checkpoint after so many steps.
        is_trusted: load a library zip from outside the log folder, which can run code.
        env_kwargs: arguments of the environment, to change those of the run.
        user_modules: modules of the user's, imported already; a run has no others imported.
        seed: of the episodes.
        device: torch device of the networks.
    """

    path: Path | None = None
    algo: str | None = None
    env_id: str | None = None
    log_folder: Path = Path("logs")
    run_number: int = 0
    which: Literal["final", "best", "last checkpoint"] | int = "final"
    is_trusted: bool = False
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    user_modules: tuple[UserModule, ...] = ()
    seed: int = 0
    device: str = "auto"


@dataclass(frozen=True)
class ChosenModel:
    """A model file and the run that it comes from.

    Attributes:
        path: the zip.
        spec: how its environments are made.
        run: the run folder, or None for a zip that lies elsewhere.
    """

    path: Path
    spec: TrainSpec
    run: Run | None


def choose_model(request: ModelRequest) -> ChosenModel:
    """Find the model that is asked for.

    Raises:
        UserError: if there is no such model, or it may not be loaded.
    """
    if request.path is not None:
        return _model_at(request.path, request)
    algo, env_id = request.algo or "ppo", request.env_id or "CartPole-v1"
    run = _find_run(algo, env_id, request)
    path = _file_in(run, request.which)
    if not path.exists():
        raise UserError(f"{run.path} holds no {path.name}: its training may not have ended")
    check_model_file(path)
    return ChosenModel(path, _spec(algo, env_id, run, request), run)


def _find_run(algo: str, env_id: str, request: ModelRequest) -> Run:
    """The run that is asked for, whose modules have been imported."""
    try:
        run = Run.find(request.log_folder, algo, env_id, request.run_number)
    except UserError:
        # The better reason, where there is no such agent or environment.
        check_algorithm(algo)
        check_env_id(env_id)
        raise
    check_recorded(run.recorded_spec(), run.path)
    check_algorithm(algo)
    check_env_id(env_id)
    return run


def _file_in(run: Run, which: str | int) -> Path:
    if isinstance(which, int):
        return run.checkpoint_path(which)
    if which == "best":
        return run.best_model_path
    if which == "last checkpoint":
        checkpoints = run.checkpoints()
        if not checkpoints:
            raise UserError(f"{run.path} holds no checkpoint: train with --save-freq")
        return checkpoints[-1]
    return run.model_path


def _model_at(path: Path, request: ModelRequest) -> ChosenModel:
    check_model_file(path)
    run = run_of(path)
    recorded = {} if run is None else run.recorded_spec()
    if run is not None:
        check_recorded(recorded, run.path)
    hand_written = hand_written_algorithm(path)
    algo = request.algo or hand_written or recorded.get("algo")
    env_id = request.env_id or recorded.get("env_id")
    if algo is None or env_id is None:
        missing = "--algo" if algo is None else "--env"
        raise UserError(f"{path} lies in no run folder: say what it is with {missing}")
    check_algorithm(algo)
    check_env_id(env_id)
    # What a zip says of itself counts where it is loaded as that, without a pickle.
    if hand_written != algo and not request.is_trusted:
        check_origin(path, request.log_folder)
    return ChosenModel(path, _spec(algo, env_id, run, request), run)


def _spec(algo: str, env_id: str, run: Run | None, request: ModelRequest) -> TrainSpec:
    """The settings of the run, or the default ones where there is none."""
    recorded = {} if run is None else run.recorded_spec()
    raw = recorded.get("hyperparams") or read_hyperparams(algo, env_id)
    raw = {**raw, "env_kwargs": {**(raw.get("env_kwargs") or {}), **request.env_kwargs}}
    return TrainSpec(
        algo=algo,
        env_id=env_id,
        hyperparams=split(raw),
        saved_hyperparams=raw,
        seed=request.seed,
        device=request.device,
        gym_packages=tuple(module.name for module in request.user_modules),
        user_modules=request.user_modules,
    )
