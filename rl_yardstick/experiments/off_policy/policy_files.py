"""Checks logs and policies' zips before the slow import of the libraries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rl_yardstick.envs.bandits import LoggedData, read_log
from rl_yardstick.pipeline.agent_settings import check_algorithm
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.models.find import run_of
from rl_yardstick.pipeline.models.load import ModelFile, hand_written_algorithm, read_model
from rl_yardstick.pipeline.user_modules import check_recorded

# Settings that change an agent's observations, so that they differ from the log's contexts.
_OBSERVATION_SETTINGS = ("normalize", "frame_stack", "env_wrapper", "vec_env_wrapper")


@dataclass(frozen=True)
class PolicyFile:
    """The zip of a trained agent, read but not loaded."""

    name: str  # its path, as given
    algo: str  # name of the agent
    model: ModelFile  # the zip
    # The log of its training; None if there was none, or it is unknown.
    log: Path | None


def read_logged(path: str | Path) -> LoggedData:
    """Read a log with propensities.

    Raises:
        UserError: if it cannot be read or lacks them.
    """
    try:
        data = read_log(path)
    except ValueError as error:
        raise UserError(one_line(error)) from error
    if data.propensities is None:
        raise UserError(
            f"{path} has no column 'propensity': off-policy evaluation needs the probability with "
            "which each arm was chosen, 1 divided by the number of arms where all were equally "
            "likely"
        )
    return data


def find_policy(path: Path) -> PolicyFile:
    """Find the agent of a run folder or in a zip.

    Raises:
        UserError: if there is none, or it does not observe the log's contexts.
    """
    zip_path = _final_model(path) if path.is_dir() else path
    run = run_of(zip_path)
    model = read_model(zip_path, run)
    spec = {} if run is None else run.recorded_spec()
    if run is not None:
        check_recorded(spec, run.path)
    algo = hand_written_algorithm(model) or spec.get("algo")
    if not isinstance(algo, str):
        raise UserError(f"{path} is in no run folder: its agent is not known")
    recorded = spec.get("hyperparams")
    settings = recorded if isinstance(recorded, dict) else {}
    changed = next((key for key in _OBSERVATION_SETTINGS if settings.get(key)), None)
    if changed is not None:
        raise UserError(f"{path} was trained with {changed}: it observes more than a log holds")
    check_algorithm(algo)
    arguments = settings.get("env_kwargs")
    log = arguments.get("log") if isinstance(arguments, dict) else None
    return PolicyFile(str(path), algo, model, Path(log) if isinstance(log, str) else None)


def _final_model(folder: Path) -> Path:
    run = run_of(folder / "any.zip")
    if run is None:
        raise UserError(f"{folder} is no run folder: it holds no whole run.json")
    if not run.model_path.exists():
        raise UserError(f"{folder} holds no {run.model_path.name}: its training may not have ended")
    return run.model_path
