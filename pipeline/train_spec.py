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
    """One training run.

    Attributes:
        algo: name of the agent.
        env_id: id of the environment.
        hyperparams: the merged hyperparameters, read but not yet made into objects.
        saved_hyperparams: the same as plain data, for the run folder.
        seed: of everything random in the run.
        eval_freq: environment steps between two evaluations; below 0 for none, None for twenty
            evaluations over the run.
        eval_episodes: episodes of each evaluation during training; None for as few as will do.
        final_episodes: of the evaluation at the end, likewise.
        n_eval_envs: environments that an evaluation plays on at once.
        save_freq: environment steps between two checkpoints; below 1 for none.
        save_every_n_episodes: episodes between two checkpoints; below 1 for none.
        save_replay_buffer: write the agent's replay buffer, if it has one, at the end and at
            checkpoints.
        log_folder: the folder above all runs.
        tensorboard_log: folder for TensorBoard, or None.
        trained_agent: a zip to go on training, with the statistics of VecNormalize and the replay
            buffer that belong to it, or None.
        vec_env: ``"dummy"`` or ``"subproc"``.
        device: torch device of the networks.
        num_threads: torch threads; below 1 for PyTorch's own choice. Results may differ between
            numbers of threads.
        log_interval: episodes (or rollouts) between two log records; -1 for the library's default,
            -2 for none.
        verbose: 0 silent, 1 progress and summary, 2 the library's own log as well.
        progress: draw a live bar wherever the output goes.
        gym_packages: names of modules of the user's, whose classes settings may name.
        user_modules: the same, as another process can import them.
        unique_id: give the folder a name that no other machine's run can have.
        pictures: draw the learning curve and the like into the run folder.
        watch_learning: file of a page that plays the training step by step, or None.
        watch_episodes: how many episodes that page shows of an agent with tables; 0 for as many as
            there are in its first steps.
        origins: by setting, where its value comes from if it does not stand so in the entry, such
            as ``"auto: 1 - 1/(2 x time limit of 1,000)"``; None for none.
    """

    algo: str
    env_id: str
    hyperparams: Hyperparams
    saved_hyperparams: dict[str, Any]
    seed: int
    eval_freq: int | None = None
    eval_episodes: int | None = 20
    final_episodes: int | None = 100
    n_eval_envs: int = 10
    save_freq: int = -1
    save_every_n_episodes: int = -1
    save_replay_buffer: bool = False
    log_folder: Path = Path("logs")
    tensorboard_log: Path | None = None
    trained_agent: Path | None = None
    vec_env: str = "dummy"
    device: str = "auto"
    num_threads: int = 1
    log_interval: int = -1
    verbose: int = 1
    progress: bool = False
    gym_packages: tuple[str, ...] = ()
    user_modules: tuple[UserModule, ...] = ()
    unique_id: bool = False
    pictures: bool = True
    watch_learning: Path | None = None
    watch_episodes: int = 0
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
        """The spec that was written down as `as_data` says, maybe long ago; see `completed`.

        Raises:
            UserError: if its hyperparameters are none.
        """
        data = completed(recorded)
        raw = data.pop("hyperparams")
        paths = {name: None if data[name] is None else Path(data[name]) for name in _PATHS}
        modules = tuple(UserModule(**module) for module in data["user_modules"])
        names = {"gym_packages": tuple(data["gym_packages"]), "user_modules": modules}
        return cls(**{**data, **paths, **names}, hyperparams=split(raw), saved_hyperparams=raw)


def completed(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """A spec that a run folder recorded, maybe long ago, with the fields that a spec has today.

    A field that came later gets its default: a new field must have one under which a run does what
    it did before. A field that there is no more is left out.
    """
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
WRAPPERS = frozenset(
    {
        "envs.wrappers.ScaleReward",
        "envs.wrappers.TerminationReward",
        "gymnasium.wrappers.ClipReward",
    }
)

# What such a run may ask for besides: nothing that names code.
_SETTINGS = (
    "algorithm",
    "n_timesteps",
    "n_episodes",
    "n_envs",
    "env_kwargs",
    "train_env_kwargs",
    "eval_env_kwargs",
    "train_env_wrapper",
)


def is_plain(spec: TrainSpec) -> bool:
    """Whether a run is such a one."""
    wrappers = {wrapper.name for wrapper in spec.hyperparams.train_env_wrapper}
    if not _is_known_agent(spec) or not wrappers <= WRAPPERS:
        return False
    if spec.gym_packages or spec.user_modules or spec.tensorboard_log or spec.trained_agent:
        return False
    special, untouched = spec.hyperparams, Hyperparams()
    rest = replace(special, **{name: getattr(untouched, name) for name in _SETTINGS})
    return spec.vec_env == "dummy" and rest == untouched and is_known_environment(spec.env_id)


def _is_known_agent(spec: TrainSpec) -> bool:
    from agents import ALGORITHMS

    if spec.algo in NETWORKS:
        default = ALGORITHMS[spec.algo].engines[0]
        return bool(spec.hyperparams.algorithm.get("engine", default) != "library")
    return spec.algo in ALGORITHMS and ALGORITHMS[spec.algo].family in FAMILIES


def is_known_environment(env_id: str) -> bool:
    """Whether an environment is one of Gymnasium's or of this project's, as it was registered."""
    import gymnasium as gym

    registered = gym.registry.get(env_id)
    entry = None if registered is None else registered.entry_point
    wrapped = registered is not None and registered.additional_wrappers
    return isinstance(entry, str) and entry.startswith(HOMES) and not wrapped
