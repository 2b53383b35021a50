"""The specification of a training run as one immutable value, and the test for plain runs.

A plain run uses only code of this project, the libraries and Gymnasium. Its results depend on the
spec alone, and it leaves nothing behind in its process: any number of plain runs can follow each
other in one process.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import MISSING, asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Self

from rl_yardstick.agents.registry import ALGORITHMS
from rl_yardstick.pipeline.settings.hyperparams import Hyperparams, split
from rl_yardstick.pipeline.user_modules import UserModule

_PATHS = ("log_folder", "tensorboard_log", "trained_agent", "watch_learning")


@dataclass(frozen=True)
class TrainSpec:
    """One training run."""

    algo: str  #: name of the agent
    env_id: str  #: id of the environment
    hyperparams: Hyperparams  #: merged and checked; objects are not built yet
    saved_hyperparams: dict[str, Any]  #: the same as plain data, for the run folder
    seed: int  #: the seed of all randomness in the run
    #: environment steps between two evaluations; below 0: none, None: twenty over the run
    eval_freq: int | None = None
    eval_episodes: int | None = 20  #: per evaluation in training; None: as few as needed
    final_episodes: int | None = 100  #: in the evaluation at the end; None: as few as needed
    n_eval_envs: int = 10  #: parallel environments of an evaluation
    save_freq: int = -1  #: environment steps between two checkpoints; below 1 for none
    save_every_n_episodes: int = -1  #: episodes between two checkpoints; below 1 for none
    save_replay_buffer: bool = False  #: at the end and at checkpoints, if the agent has one
    log_folder: Path = Path("logs")  #: the folder above all runs
    tensorboard_log: Path | None = None  #: folder for TensorBoard
    #: a zip to continue from, together with its statistics and replay buffer
    trained_agent: Path | None = None
    vec_env: str = "dummy"  #: or ``"subproc"``
    device: str = "auto"  #: torch device of the networks
    num_threads: int = 1  #: of PyTorch, which may affect results; below 1: PyTorch's choice
    log_interval: int = -1  #: episodes or rollouts a log record; -1: library's default, -2: none
    verbose: int = 1  #: 0 silent, 1 progress and summary, 2 the library's own log as well
    progress: bool = False  #: draw a live bar wherever the output goes
    gym_packages: tuple[str, ...] = ()  #: modules of the user, whose classes settings may name
    user_modules: tuple[UserModule, ...] = ()  #: the same, importable in another process
    unique_id: bool = False  #: give the folder a globally unique name
    pictures: bool = True  #: draw the learning curve and other pictures into the run folder
    diagnose: bool = False  #: compare values and gradients with exact ones at evaluations
    watch_learning: Path | None = None  #: file of a page that replays the training step by step
    watch_episodes: int = 0  #: episodes on that page, for agents with tables; 0: automatic
    map_name: str = ""  #: the file of the environment's map, for titles
    #: the origin of values that are not in the entry: ``"auto: 1 - 1/(2 x time limit ..."``
    origins: dict[str, str] | None = None

    def as_data(self) -> dict[str, Any]:
        """The spec as JSON."""
        data = {**vars(self), "user_modules": tuple(map(asdict, self.user_modules))}
        del data["hyperparams"]
        data["hyperparams"] = deepcopy(data.pop("saved_hyperparams"))
        for name in _PATHS:
            data[name] = None if data[name] is None else str(data[name])
        return data

    @classmethod
    def of_data(cls, recorded: Mapping[str, Any]) -> Self:
        """The spec from `as_data`, also of old versions; UserError for invalid hyperparameters."""
        data = completed(recorded)
        raw = data.pop("hyperparams")
        paths = {name: None if data[name] is None else Path(data[name]) for name in _PATHS}
        modules = tuple(UserModule(**module) for module in data["user_modules"])
        names = {"gym_packages": tuple(data["gym_packages"]), "user_modules": modules}
        return cls(**{**data, **paths, **names}, hyperparams=split(raw), saved_hyperparams=raw)


def completed(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """A recorded spec with today's fields: the default of a new field keeps the old behaviour."""
    known = _defaults()
    defaults = {key: value for key, value in known.items() if value is not MISSING}
    return {**defaults, **{key: recorded[key] for key in known if key in recorded}}


@cache
def _defaults() -> Mapping[str, Any]:
    """The defaults of the fields in `TrainSpec.as_data`; `MISSING` for fields without one."""
    required = {key.name for key in fields(TrainSpec) if key.default is MISSING}
    data = TrainSpec("", "", Hyperparams(), {}, 0).as_data()
    return {key: MISSING if key in required else value for key, value in data.items()}


# Agents that use only their own random numbers, or draw them after seeding.
FAMILIES = frozenset({"tabular", "linear"})
# The library's agents in compiled code, which draw weights after seeding too. Runs with ``engine:
# library`` are excluded, because they are too long to gain from sharing a process.
NETWORKS = frozenset({"dqn", "double_dqn", "deep_qlearning", "ppo", "a2c"})

HOMES = ("envs.", "gymnasium.envs.")
# Training wrappers whose state is only numbers.
_OWN_WRAPPERS = {
    "rl_yardstick.envs.wrappers.ScaleReward",
    "rl_yardstick.envs.wrappers.TerminationReward",
}
WRAPPERS = frozenset(_OWN_WRAPPERS | {"gymnasium.wrappers.ClipReward"})

# Settings that a plain run may have: none of them names code.
_ENV_SETTINGS = ("n_envs", "env_kwargs", "train_env_kwargs", "eval_env_kwargs", "train_env_wrapper")
_SETTINGS = ("algorithm", "n_timesteps", "n_episodes", *_ENV_SETTINGS)


def is_plain(spec: TrainSpec) -> bool:
    """Whether a run is a plain run."""
    wrappers = {wrapper.name for wrapper in spec.hyperparams.train_env_wrapper}
    if not wrappers <= WRAPPERS or spec.tensorboard_log or spec.trained_agent:
        return False
    if spec.gym_packages or spec.user_modules or spec.vec_env != "dummy":
        return False
    from rl_yardstick.agents import ALGORITHMS

    entry = ALGORITHMS.get(spec.algo)
    if entry is None or (spec.algo not in NETWORKS and entry.family not in FAMILIES):
        return False
    special, untouched = spec.hyperparams, Hyperparams()
    if spec.algo in NETWORKS and special.algorithm.get("engine", entry.engines[0]) == "library":
        return False
    rest = replace(special, **{name: getattr(untouched, name) for name in _SETTINGS})
    return rest == untouched and is_known_environment(spec.env_id)


def is_known_environment(env_id: str) -> bool:
    """Whether an environment is an unchanged one of Gymnasium or this project."""
    import gymnasium as gym

    registered = gym.registry.get(env_id)
    entry = None if registered is None else registered.entry_point
    wrapped = registered is not None and registered.additional_wrappers
    return isinstance(entry, str) and entry.startswith(HOMES) and not wrapped


def remembers(spec: TrainSpec) -> bool:
    """Whether the agent is recurrent or observations are stacked, according to the settings."""
    entry = ALGORITHMS.get(spec.algo)
    return (entry is not None and entry.has_memory) or (spec.hyperparams.frame_stack or 1) > 1
