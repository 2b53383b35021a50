"""Chooses the model to play or to continue training, and makes the spec of its environments.

Agent, environment and settings come from the first of these sources that has them:

1. the request;
2. for hand-written agents, the zip, which names its agent;
3. the model's folder, see `pipeline.models.find`;
4. the entry of ``hyperparams/<algo>.yml`` without ``normalize``, if the folder has no settings.

VecNormalize statistics of the model are always used, if they exist. Further training is a new run
in a new folder, with the hyperparameters of the new run's entry. As in rl_zoo3, it keeps the
agent's networks or tables, its statistics and its replay buffer. Unlike rl_zoo3, it continues the
step count, and schedules depend on all steps instead of restarting.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.pipeline.agent_settings import check_algorithm, without_auto
from rl_yardstick.pipeline.environments import check_env_id
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.models.find import (
    RecordedRun,
    Which,
    check_digest,
    model_at,
    model_of,
    recorded_run,
    replay_buffer_of,
    run_around,
    statistics_of,
)
from rl_yardstick.pipeline.models.load import (
    ModelFile,
    Statistics,
    agent_class,
    hand_written_algorithm,
    load_model,
    load_replay_buffer,
    normalising,
    read_model,
    read_statistics,
    telling_masks,
)
from rl_yardstick.pipeline.runs import Run
from rl_yardstick.pipeline.settings.hyperparams import NoEntryError, read_hyperparams, split
from rl_yardstick.pipeline.train_spec import TrainSpec
from rl_yardstick.pipeline.user_modules import UserModule, check_recorded

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv


@dataclass(frozen=True)
class ModelRequest:
    """A request for a model."""

    path: Path | None = None  # a zip or a run folder, instead of a search for a run
    # name of the agent; None: as in the zip or its run folder, or else ``"ppo"``
    algo: str | None = None
    # id of the environment; None: as in the run folder, or else ``"CartPole-v1"``
    env_id: str | None = None
    log_folder: Path = Path("logs")  # the folder above all runs
    run_number: int = 0  # number of the run; 0 for the newest, -1 for one without a number
    # the model at the end of training, the best one, the last checkpoint, or the checkpoint after a
    # number of steps
    which: Which = "final"
    # a file of VecNormalize statistics, instead of those beside the model
    statistics: Path | None = None
    # arguments of the environment that replace those of the run
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    # the user's imported modules; a run cannot import others
    user_modules: tuple[UserModule, ...] = ()
    seed: int = 0  # of the episodes
    device: str = "auto"  # torch device of the networks
    zipped_in: Path | None = None  # the pack from which the folder was unpacked


@dataclass(frozen=True)
class ChosenModel:
    """A model and its run; all files are read once, before this is made."""

    file: ModelFile  # the zip
    spec: TrainSpec  # the settings of its environments
    run: Run | None  # the run folder, or None for a zip outside one
    # VecNormalize statistics for playing, or None
    statistics: Statistics | None = None

    @property
    def path(self) -> Path:
        """The path of the zip."""
        return self.file.path


def find_model(request: ModelRequest) -> ChosenModel:
    """Find the requested model, without importing slow libraries."""
    if request.statistics is not None and not request.statistics.is_file():
        raise UserError(f"no such file of statistics: {request.statistics}")
    if request.path is None:
        algo, env_id = request.algo or "ppo", request.env_id or "CartPole-v1"
        found = _find_run(algo, env_id, request)
        run: Run | None = found
        file = read_model(model_of(found, request.which), run)
        recorded = recorded_run(run)
    else:
        path = model_at(request.path, request.which)
        run = run_around(path)
        file = read_model(path, run)
        _check_modules(run, request.zipped_in)
        recorded = recorded_run(run)
        named = request.algo or hand_written_algorithm(file) or recorded.algo
        algo, env_id = named or "", request.env_id or recorded.env_id or ""
        if not (algo and env_id):
            missing = "--env" if algo else "--algo"
            raise UserError(f"{path} is in no run folder: say what it is with {missing}")
        check_algorithm(algo)
        check_env_id(env_id)
    spec = telling_masks(_spec(algo, env_id, recorded, request), file)
    return ChosenModel(file, spec, run)


def model_of_run(path: Path, spec: TrainSpec, run: Run) -> ChosenModel:
    """A model of a run with a known spec, ready to play."""
    return with_statistics(ChosenModel(read_model(path, run), spec, run))


def _find_run(algo: str, env_id: str, request: ModelRequest) -> Run:
    """Find the requested run, and check that its modules are imported."""
    try:
        run = Run.find(request.log_folder, algo, env_id, request.run_number)
    except UserError:
        # An error about an unknown agent or environment says more than one about a missing run.
        check_algorithm(algo)
        check_env_id(env_id)
        raise
    _check_modules(run)
    check_algorithm(algo)
    check_env_id(env_id)
    return run


def _check_modules(run: Run | None, zipped_in: Path | None = None) -> None:
    """Check that the modules of a run are imported, whichever program recorded it."""
    if run is not None:
        packages = list(recorded_run(run).gym_packages)
        check_recorded({"gym_packages": packages, **run.recorded_spec()}, run.path, zipped_in)


def _spec(algo: str, env_id: str, recorded: RecordedRun, request: ModelRequest) -> TrainSpec:
    """The spec of the environments, by the sources in this module's docstring."""
    raw = recorded.hyperparams
    if raw is None:
        # Whether a model was trained on normalised observations depends on the model alone.
        entry: dict[str, Any] = {}
        with suppress(NoEntryError):
            entry = without_auto(read_hyperparams(algo, env_id))
        raw = {key: value for key, value in entry.items() if key != "normalize"}
    hyperparams = split(raw)
    # In evaluation environments, these override all others.
    env_kwargs = {**hyperparams.eval_env_kwargs, **request.env_kwargs}
    return TrainSpec(
        algo=algo,
        env_id=env_id,
        hyperparams=replace(hyperparams, eval_env_kwargs=env_kwargs),
        saved_hyperparams=raw,
        map_name="" if "desc" in request.env_kwargs else recorded.map_name,
        seed=request.seed,
        device=request.device,
        gym_packages=tuple(module.name for module in request.user_modules),
        user_modules=request.user_modules,
    )


def with_statistics(chosen: ChosenModel, named: Path | None = None) -> ChosenModel:
    """The model with its statistics for playing, once read and checked."""
    path = named or statistics_of(chosen.path, chosen.run)
    normalize = chosen.spec.hyperparams.normalize
    if path is None:
        if normalize is not None and normalize.get("norm_obs", True):
            raise UserError(
                f"{chosen.path} was trained on normalised observations, but their statistics "
                "are missing: name their file with --vec-normalize"
            )
        return chosen
    statistics = read_statistics(path, chosen.run)
    spec = normalising(chosen.spec, statistics.settings)
    return replace(chosen, spec=spec, statistics=statistics)


def agent_to_continue(path: Path) -> Path:
    """The zip at a path, after checks of it, its statistics and its replay buffer."""
    model = model_at(path)
    run = run_around(model)
    read_model(model, run)
    for file in (statistics_of(model, run), replay_buffer_of(model)):
        if file is not None:
            check_digest(run, file)
    return model


def model_to_continue(spec: TrainSpec) -> ModelFile | None:
    """Read the zip of the agent to continue; None for a new agent."""
    if spec.trained_agent is None:
        return None
    return read_model(spec.trained_agent, run_around(spec.trained_agent))


def statistics_to_continue(spec: TrainSpec) -> Statistics | None:
    """Read the statistics of the agent to continue; None if missing or not wanted."""
    if spec.trained_agent is None or spec.saved_hyperparams.get("normalize") is False:
        return None
    run = run_around(spec.trained_agent)
    path = statistics_of(spec.trained_agent, run)
    return None if path is None else read_statistics(path, run)


def continuing(spec: TrainSpec, statistics: Statistics) -> TrainSpec:
    """The spec with the earlier normalisation, changed by the settings in its entry."""
    return normalising(spec, {**statistics.settings, **(spec.hyperparams.normalize or {})})


def load_to_continue(spec: TrainSpec, file: ModelFile, env: VecEnv, **kwargs: Any) -> BaseAlgorithm:
    """Load the agent with its replay buffer, on ``env`` and with these hyperparameters."""
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    # The networks come from the file, so these arguments cannot apply.
    kwargs = {k: v for k, v in kwargs.items() if k not in ("policy", "policy_kwargs")}
    if "n_steps" in kwargs and issubclass(agent_class(spec.algo), OffPolicyAlgorithm):
        # The library chooses the buffer class by ``n_steps``, and would keep the file's class.
        kwargs = {"replay_buffer_class": None, "replay_buffer_kwargs": {}, **kwargs}
    model = load_model(spec.algo, file, env, spec.user_modules, device=spec.device, **kwargs)
    replay_buffer = replay_buffer_of(file.path)
    if replay_buffer is not None:
        load_replay_buffer(model, replay_buffer, run_around(file.path))
    return model
