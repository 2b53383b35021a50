"""`TrainSpec`: everything that decides a training. The same spec gives the same bits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveInt, ValidationError

from rl_yardstick.pipeline.errors import UserError, shown
from rl_yardstick.pipeline.files import portable_name

UNBOUNDED = 10**12  # steps, where episodes are counted


class Component(BaseModel):
    """A wrapper or callback: the dotted name of its class, and its arguments."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    kwargs: dict[str, Any] = {}


class TrainSpec(BaseModel):
    """A training. `settings.read_spec` makes it from flags and YAML; ``run.json`` keeps it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    algo: str  #: name of the agent
    env_id: str  #: id of the environment
    seed: int = Field(0, ge=0)  #: of all randomness in the run
    n_timesteps: PositiveInt | None = None  #: training steps, over all environments
    n_episodes: PositiveInt | None = None  #: training episodes, in place of ``n_timesteps``
    n_envs: PositiveInt = 1  #: parallel training environments
    algorithm: dict[str, Any] = {}  #: arguments of the agent's constructor, as plain values
    normalize: dict[str, Any] | None = None  #: arguments of VecNormalize
    frame_stack: PositiveInt | None = None  #: number of stacked observations
    env_kwargs: dict[str, Any] = {}  #: arguments of every environment
    train_env_kwargs: dict[str, Any] = {}  #: further ones of the training environments alone
    eval_env_kwargs: dict[str, Any] = {}  #: further ones of the evaluation environments alone
    env_wrapper: list[Component] = []  #: of every environment, the innermost first
    train_env_wrapper: list[Component] = []  #: around these, in training alone
    vec_env_wrapper: list[Component] = []  #: of the vectorised environment
    callback: list[Component] = []  #: of the training
    monitor_kwargs: dict[str, Any] = {}  #: arguments of Monitor
    noise_type: Literal["normal", "ornstein-uhlenbeck"] | None = None  #: action noise
    noise_std: float | None = Field(None, ge=0)  #: its standard deviation
    trained_agent: str | None = None  #: path of the zip to begin with
    vec_normalize: str | None = None  #: path of its statistics, or none; None: those beside it
    eval_freq: int | None = None  #: steps between evaluations; None: twenty in all; -1: none
    eval_episodes: PositiveInt | None = None  #: of a sampled evaluation; None: adaptive
    final_episodes: PositiveInt | None = None  #: of the one at the end, likewise
    n_eval_envs: PositiveInt = 10  #: parallel environments of a sampled evaluation
    save_freq: int = -1  #: steps between checkpoints; -1: none
    save_every_n_episodes: int = -1  #: episodes between checkpoints, likewise
    save_replay_buffer: bool = False  #: with the model and with checkpoints
    tensorboard_log: str | None = None  #: folder of TensorBoard's files
    log_interval: int = -1  #: episodes or rollouts a log record; -1: the library's; -2: none
    library_log: bool = False  #: print the library's own log
    vec_env: Literal["dummy", "subproc"] = "dummy"
    device: str = "auto"  #: torch device of networks
    n_threads: int = 1  #: of PyTorch, which may change bits; below 1: PyTorch's choice
    exact_model: str = Field(default="auto", pattern="^(auto|none|[1-9][0-9]*)$")  #: searched
    pictures: bool = True  #: draw into the run folder
    diagnose: bool = False  #: compare values and gradients with exact ones at evaluations
    watch_learning: str | None = None  #: file of a page that plays the training
    watch_episodes: int = 0  #: episodes on it, for tables; 0: automatic
    gym_packages: list[str] = []  #: modules that the user typed
    code: dict[str, str] = {}  #: the digest of the sources of each, by name
    map_name: str = ""  #: file of the environment's map, for titles
    origins: dict[str, str] = {}  #: where values come from that the entry does not have

    @property
    def env_name(self) -> str:
        """The environment's id as a file name."""
        return portable_name(self.env_id.replace("/", "-"))

    @property
    def place(self) -> str:
        """The environment for titles, with the file of its map."""
        return f"{self.env_id} ({self.map_name})" if self.map_name else self.env_id

    @property
    def title(self) -> str:
        """The training in a few words."""
        return f"{self.algo} on {self.place}, seed {self.seed}"

    @property
    def total_timesteps(self) -> int:
        """The steps that the agent's ``learn`` is asked for."""
        return self.n_timesteps or UNBOUNDED

    @property
    def hyperparams(self) -> dict[str, Any]:
        """The entry of a settings file that would give this training."""
        kept = {"n_timesteps", "n_episodes", "n_envs", "normalize", "frame_stack", "env_kwargs"}
        kept |= {"train_env_kwargs", "eval_env_kwargs", "monitor_kwargs", "noise_type", "noise_std"}
        found = self.model_dump(include=kept, exclude_defaults=True)
        for key in ("env_wrapper", "train_env_wrapper", "vec_env_wrapper", "callback"):
            if components := getattr(self, key):
                found[key] = [{one.name: one.kwargs} for one in components]
        return {**self.algorithm, **found}

    def changed(self, **fields: Any) -> TrainSpec:
        """A copy with other values; they are not checked again."""
        return self.model_copy(update=fields)


def validated(found: Mapping[str, Any]) -> TrainSpec:
    """The spec with these fields; mistakes in one line."""
    try:
        return TrainSpec.model_validate(found)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        reason = first["msg"][0].lower() + first["msg"][1:]
        raise UserError(f"{name}: {reason}, not {shown(first['input'])}") from None
