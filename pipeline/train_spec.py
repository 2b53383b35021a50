"""What a training run is asked to do, as one immutable value, and whether it is a plain run.

Plain runs are those of which all that takes part comes from this project or from Gymnasium. What
they leave depends on their spec alone, and they leave nothing behind in their process: any number
of them can be done there one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import MISSING, asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Self

from pipeline.settings.hyperparams import Hyperparams, split
from pipeline.user_modules import UserModule

_PATHS = ("log_folder", "tensorboard_log", "trained_agent", "watch_learning")


@dataclass(frozen=True)
class TrainSpec:
    """One training run."""

    algo: str  #: name of the agent
    env_id: str  #: id of the environment
    hyperparams: Hyperparams  #: merged, read but not yet made into objects
    saved_hyperparams: dict[str, Any]  #: the same as plain data, for the run folder
    seed: int  #: of everything random in the run
    #: environment steps between two evaluations; below 0 for none, None for twenty over the run
    eval_freq: int | None = None
    eval_episodes: int | None = 20  #: of each evaluation in training; None for as few as will do
    final_episodes: int | None = 100  #: of the evaluation at the end, likewise
    n_eval_envs: int = 10  #: environments that an evaluation plays on at once
    save_freq: int = -1  #: environment steps between two checkpoints; below 1 for none
    save_every_n_episodes: int = -1  #: episodes between two checkpoints; below 1 for none
    save_replay_buffer: bool = False  #: at the end and at checkpoints, if the agent has one
    log_folder: Path = Path("logs")  #: the folder above all runs
    tensorboard_log: Path | None = None  #: folder for TensorBoard
    #: a zip to go on training, with the statistics and the replay buffer that belong to it
    trained_agent: Path | None = None
    vec_env: str = "dummy"  #: or ``"subproc"``
    device: str = "auto"  #: torch device of the networks
    num_threads: int = 1  #: of PyTorch, on which results may depend; below 1 for its own choice
    log_interval: int = -1  #: episodes or rollouts a log record; -1: library's default, -2: none
    verbose: int = 1  #: 0 silent, 1 progress and summary, 2 the library's own log as well
    progress: bool = False  #: draw a live bar wherever the output goes
    gym_packages: tuple[str, ...] = ()  #: modules of the user's, whose classes settings may name
    user_modules: tuple[UserModule, ...] = ()  #: the same, as another process can import them
    unique_id: bool = False  #: give the folder a name that no other machine's run can have
    pictures: bool = True  #: draw the learning curve and the like into the run folder
    watch_learning: Path | None = None  #: file of a page that plays the training step by step
    watch_episodes: int = 0  #: that it shows of an agent with tables; 0 for as many as have room
    #: where values come from that do not stand in the entry: ``"auto: 1 - 1/(2 x time limit ..."``
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
        """The spec of `as_data`, maybe of long ago; UserError if its hyperparameters are none."""
        data = completed(recorded)
        raw = data.pop("hyperparams")
        paths = {name: None if data[name] is None else Path(data[name]) for name in _PATHS}
        modules = tuple(UserModule(**module) for module in data["user_modules"])
        names = {"gym_packages": tuple(data["gym_packages"]), "user_modules": modules}
        return cls(**{**data, **paths, **names}, hyperparams=split(raw), saved_hyperparams=raw)


def completed(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """A recorded spec with the fields of today: under a new one's default, runs do as before."""
    known = _defaults()
    defaults = {key: value for key, value in known.items() if value is not MISSING}
    return {**defaults, **{key: recorded[key] for key in known if key in recorded}}


@cache
def _defaults() -> Mapping[str, Any]:
    """The fields as `TrainSpec.as_data` names them; `MISSING` where one has no default."""
    required = {key.name for key in fields(TrainSpec) if key.default is MISSING}
    data = TrainSpec("", "", Hyperparams(), {}, 0).as_data()
    return {key: MISSING if key in required else value for key, value in data.items()}


# Agents whose random numbers are all their own, or drawn after they have been seeded.
FAMILIES = frozenset({"tabular", "linear"})
# Those of the library, once they train on compiled code: weights are drawn after that too. In the
# library's own loop they take too long to gain anything, but for what `auto` leaves there.
NETWORKS = frozenset({"dqn", "double_dqn", "deep_qlearning", "ppo", "a2c"})

HOMES = ("envs.", "gymnasium.envs.")
# Around the environments of a training: they hold nothing but numbers.
_OWN_WRAPPERS = {"envs.wrappers.ScaleReward", "envs.wrappers.TerminationReward"}
WRAPPERS = frozenset(_OWN_WRAPPERS | {"gymnasium.wrappers.ClipReward"})

# What such a run may ask for besides: nothing that names code.
_ENV_SETTINGS = ("n_envs", "env_kwargs", "train_env_kwargs", "eval_env_kwargs", "train_env_wrapper")
_SETTINGS = ("algorithm", "n_timesteps", "n_episodes", *_ENV_SETTINGS)


def is_plain(spec: TrainSpec) -> bool:
    """Whether a run is such a one."""
    wrappers = {wrapper.name for wrapper in spec.hyperparams.train_env_wrapper}
    if not wrappers <= WRAPPERS or spec.tensorboard_log or spec.trained_agent:
        return False
    if spec.gym_packages or spec.user_modules or spec.vec_env != "dummy":
        return False
    from agents import ALGORITHMS

    entry = ALGORITHMS.get(spec.algo)
    if entry is None or (spec.algo not in NETWORKS and entry.family not in FAMILIES):
        return False
    special, untouched = spec.hyperparams, Hyperparams()
    if spec.algo in NETWORKS and special.algorithm.get("engine", entry.engines[0]) == "library":
        return False
    rest = replace(special, **{name: getattr(untouched, name) for name in _SETTINGS})
    return rest == untouched and is_known_environment(spec.env_id)


def is_known_environment(env_id: str) -> bool:
    """Whether an environment is one of Gymnasium's or of this project's, as it was registered."""
    import gymnasium as gym

    registered = gym.registry.get(env_id)
    entry = None if registered is None else registered.entry_point
    wrapped = registered is not None and registered.additional_wrappers
    return isinstance(entry, str) and entry.startswith(HOMES) and not wrapped
