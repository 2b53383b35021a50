"""Models on disk: found, loaded as data, played or trained further.

A folder is a run of this project (``run.json``), a run of rl_zoo3 (``<env>/args.yml`` and
``config.yml``) or a download from a model hub (the same two beside the zip). Reading runs no code
from these files, and imports no module because a file names it.
"""

from __future__ import annotations

import io
import re
import sys
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.pipeline.components import arguments_of, check_typed, module_name
from rl_yardstick.pipeline.environments import check_env_id
from rl_yardstick.pipeline.errors import UserError, as_user_error, one_line
from rl_yardstick.pipeline.files import read_bytes
from rl_yardstick.pipeline.run import RECORD, Run, numbered_runs, statistics_beside
from rl_yardstick.pipeline.settings import check_agent, read_entry, read_saved, special_settings
from rl_yardstick.pipeline.spec import TrainSpec, validated
from rl_yardstick.safe_files.files import read_model

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

Which = Literal["final", "best", "last checkpoint"] | int
MAX_MODEL = 1 << 32  # bytes of a zip
_OTHER_ZIPS = re.compile(r"best_model\.zip|train_eval_metrics\.zip|rl_model_\d+_steps\.zip")
REPLAY_BUFFER = "replay_buffer.pkl"
NONE = "none"  # in place of a path: no statistics
_BESIDE = ("vec_normalize.pkl", "vecnormalize.pkl")  # as model hubs and rl_zoo3 name statistics


@dataclass(frozen=True)
class Wanted:
    """A request for a model."""

    path: Path | None = None  #: a zip or a run folder, instead of a search among runs
    algo: str | None = None  #: None: as in the folder, or ``ppo``
    env_id: str | None = None  #: None: as in the folder, or ``CartPole-v1``
    log_folder: Path = Path("logs")  #: the folder above all runs
    number: int = 0  #: of the run; 0 for the newest
    which: Which = "final"
    statistics: Path | None = None  #: of VecNormalize, or "none"; None: those of the model
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)  #: replace those of the run
    typed: list[str] = field(default_factory=list)  #: modules that the user typed
    seed: int = 0  #: of the episodes
    device: str = "auto"


@dataclass(frozen=True)
class Model:
    """A model on disk and the settings of its environments."""

    path: Path  #: the zip
    spec: TrainSpec
    run: Path | None  #: the run folder, if it is in one
    statistics: Path | None  #: of VecNormalize


# --- finding --------------------------------------------------------------------------------------


def find_model(wanted: Wanted) -> Model:
    """Find the requested model, without importing torch or modules that were not typed."""
    path = wanted.path or _find_run(wanted)
    with_suffix = path.with_name(f"{path.name}.zip")
    if not (path / RECORD).exists() and with_suffix.is_file():
        path = with_suffix  # typed without its suffix, as for SB3
    if path.is_dir():
        path = model_in(path, wanted.which)
    elif wanted.which != "final":
        raise UserError(f"{path} is one model: give its folder for another one of the run")
    data = zip_data(path)
    spec = _spec_of(path, data, wanted)
    spec = spec.changed(
        eval_env_kwargs={**spec.eval_env_kwargs, **wanted.env_kwargs},
        seed=wanted.seed,
        device=wanted.device,
        gym_packages=wanted.typed,
        map_name="" if "desc" in wanted.env_kwargs else spec.map_name,
    )
    check_agent(spec.algo)
    check_env_id(spec.env_id)
    statistics = wanted.statistics
    if statistics == Path(NONE):
        spec, statistics = spec.changed(normalize=None), None
    elif statistics is None and spec.normalize is not None:
        statistics = statistics_of(path)
        if statistics is None and spec.normalize.get("norm_obs", True):
            fault = "trained on normalised observations, but their statistics are missing"
            raise UserError(f"{path} was {fault}: name their file with --vec-normalize, or none")
    run = path.parent if (path.parent / RECORD).is_file() else None
    return Model(path, _as_saved(spec, data, statistics), run, statistics)


def model_of_run(run: Run, which: Which = "final") -> Model:
    """The model of a finished run, ready to play."""
    spec, path = run.spec(), model_in(run.path, which)
    return Model(path, spec, run.path, None if spec.normalize is None else statistics_of(path))


def _find_run(wanted: Wanted) -> Path:
    """The folder of a run by its number; 0: the newest, -1: the one without a number."""
    algo, env_id = wanted.algo or "ppo", wanted.env_id or "CartPole-v1"
    folder, name, number = wanted.log_folder / algo, env_id.replace("/", "-"), wanted.number
    runs = dict(numbered_runs(folder, name))
    if number < 0 or (not runs and (folder / f"{name}.zip").exists()):
        return folder
    if not runs:
        check_agent(algo)
        check_env_id(env_id)
        made = f"train.py --env {env_id} --algo {algo} makes one"
        raise UserError(f"no run of {algo} on {env_id} in {wanted.log_folder}: {made}")
    if number and number not in runs:
        where, known = wanted.log_folder, ", ".join(map(str, runs))
        raise UserError(f"no run {number} of {algo} on {name} in {where}: there is {known}")
    return runs[number or max(runs)]


def model_in(folder: Path, which: Which = "final") -> Path:
    """The zip of a run folder."""
    if not folder.is_dir():
        raise UserError(f"{folder} is no run folder")
    if which == "final":
        models = sorted(p for p in folder.glob("*.zip") if not _OTHER_ZIPS.fullmatch(p.name))
        if len(models) == 1:
            return models[0]
        held = ", ".join(path.name for path in models) or "no model of a whole training"
        raise UserError(f"{folder} holds {held}: name the zip")
    steps = list(Run(folder).checkpoints())
    if which == "last checkpoint":
        which = steps[-1] if steps else 0
    path = folder / ("best_model.zip" if which == "best" else f"rl_model_{which}_steps.zip")
    if not path.exists():
        known = f"there are checkpoints after {', '.join(map(str, steps))} steps"
        hint = known if steps else "for checkpoints, train with --save-freq"
        raise UserError(f"{folder} holds no {path.name}: {hint}")
    return path


def statistics_of(model: Path) -> Path | None:
    """The VecNormalize statistics of a model: its own, or a model hub's, or its run's last."""
    places = [*_closest(model), *sorted(model.parent.glob("*/vecnormalize.pkl"))]
    return next((path for path in places if path.is_file()), None)


def _closest(model: Path) -> list[Path]:
    return [statistics_beside(model), *(model.with_name(name) for name in _BESIDE)]


def replay_buffer_of(model: Path) -> Path | None:
    """The replay buffer of a model: the checkpoint's, or its run's last one."""
    name = model.stem.replace("rl_model_", "rl_model_replay_buffer_")
    places = [model.with_name(f"{name}.pkl"), model.with_name(REPLAY_BUFFER)]
    return next((path for path in places if path.is_file()), None)


def zip_data(path: Path) -> dict[str, Any]:
    """The JSON in an agent's zip; pickles in it stay text."""
    content = read_bytes(path, MAX_MODEL)
    try:
        return read_model(content)[1]
    except ValueError as error:
        raise UserError(f"{path} is no agent's zip: it {one_line(error)}") from error


def _spec_of(path: Path, data: Mapping[str, Any], wanted: Wanted) -> TrainSpec:
    """The settings of a model, from the first source that has them."""
    folder = path.parent
    if (folder / RECORD).is_file():
        spec = Run(folder).spec()
        check_typed(spec.gym_packages, wanted.typed, str(folder))
        algo, env_id = wanted.algo or spec.algo, wanted.env_id or spec.env_id
        return spec.changed(algo=algo, env_id=env_id, trained_agent=None)
    places = [folder / path.stem, folder, *(p.parent for p in folder.glob("*/config.yml"))]
    files = [(place / "args.yml", place / "config.yml") for place in places]  # of rl_zoo3
    present = next((both for both in files if any(file.is_file() for file in both)), ())
    saved = [read_saved(file) if file.is_file() else {} for file in present]
    args, config = saved if saved else (dict[str, Any](), None)
    end = f":{data.get('algorithm')}"  # the class of a hand-written agent
    own = [name for name, one in ALGORITHMS.items() if one.entry_point.endswith(end)]
    algo = wanted.algo or next(iter(own), args.get("algo", ""))
    env_id = wanted.env_id or args.get("env", "")
    if not (algo and env_id):
        missing = "--env" if algo else "--algo"
        raise UserError(f"{path} is in no run folder: say what it is with {missing}")
    check_typed(args.get("gym_packages") or [], wanted.typed, str(folder))
    if config is None:
        check_agent(algo)
        # Whether a model was trained on normalised observations depends on the model alone.
        has_statistics = not own and any(place.is_file() for place in _closest(path))
        config = {"normalize": {} if has_statistics else None}
        with suppress(UserError):
            config = {**read_entry(algo, env_id), **config}
    special = special_settings(config)
    special |= {"env_kwargs": args.get("env_kwargs") or special.get("env_kwargs") or {}}
    special |= {"n_timesteps": None, "n_episodes": None, "callback": [], "n_envs": 1}
    kept = {key: config[key] for key in ("mask_actions",) if key in config}
    return validated({"algo": algo, "env_id": env_id, "algorithm": kept, **special})


# --- loading --------------------------------------------------------------------------------------


def load_agent(model: Model, env: VecEnv | None = None) -> BaseAlgorithm:
    """Load an agent to play, without the memory and schedules that training needs."""
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.utils import ConstantSchedule

    spec, algorithm = model.spec, load_algorithm(model.spec.algo)
    if _has_own_load(algorithm):
        own: Any = load(spec, model.path, env, device=spec.device)
        own.translation = None  # the environments of `pipeline.environments` number their spaces
        return own  # type: ignore[no-any-return]
    unused = ConstantSchedule(0.0)
    replaced: dict[str, Any] = {
        "learning_rate": 0.0,
        **dict.fromkeys(("lr_schedule", "clip_range", "clip_range_vf"), unused),
        "delta_std_schedule": unused,
        "action_noise": None,
        "n_steps": 1,
        "replay_buffer_class": None,  # for hindsight, it needs the environment's reward
        "replay_buffer_kwargs": {},
    }
    if env is not None:
        saved, here = zip_data(model.path).get("observation_space"), vars(env.observation_space)
        found, needed = (
            # Before version 0.20, Gym had it as ``shape``.
            str(one.get("n", tuple(one.get("_shape", one.get("shape")) or ())))
            if isinstance(one, dict)
            else ""
            for one in (saved, here)
        )
        if found not in ("", needed):
            fault = f"of size {found}, not {env.observation_space}: give its --env and --env-kwargs"
            raise UserError(f"{model.path} was trained on observations {fault}")
        replaced["observation_space"] = env.observation_space
    small = {"buffer_size": 1, "optimize_memory_usage": False}
    extra = small if issubclass(algorithm, OffPolicyAlgorithm) else {}
    return load(spec, model.path, env, device=spec.device, custom_objects=replaced, **extra)


def load(spec: TrainSpec, path: Path, env: VecEnv | None, **replaced: Any) -> BaseAlgorithm:
    """The agent in a zip, which is read as data: nothing in it runs.

    A zip may name networks and buffers in ``spec.gym_packages``; ``replaced`` are attributes of
    the agent to change.
    """
    from rl_yardstick.safe_files.models import load_model

    algorithm: Any = load_algorithm(spec.algo)
    content = io.BytesIO(read_bytes(path, MAX_MODEL))
    try:
        if _has_own_load(algorithm):
            return algorithm.load(content, env=env, **replaced)  # type: ignore[no-any-return]
        with warnings.catch_warnings():
            # About a buffer that the library itself has chosen.
            warnings.filterwarnings("ignore", r"`n_steps=\d+` is ignored because a custom")
            warnings.filterwarnings("ignore", "You are probably loading a")  # older model
            classes = _own_classes(algorithm, spec.gym_packages)
            return load_model(algorithm, content, env, classes=classes, **replaced)  # type: ignore[no-any-return]
    except UserError:
        raise
    except Exception as error:  # a file of another agent can fail anywhere in the library
        key, way_out = getattr(error, "key", None), ""
        if key in ("policy_class", "policy_kwargs", "replay_buffer_class", "rollout_buffer_class"):
            way_out = "; to admit a class of yours, name its module: --gym-packages MODULE"
            if "ActorCriticPolicy" in str(error):
                way_out = f"; it is no {spec.algo} zip: try --algo ppo or a2c"
        elif key in arguments_of(spec.algo):
            way_out = f"; train.py -i continues with another value: -params {key}:VALUE"
        what = f"{path} cannot be loaded as a {spec.algo} agent: {one_line(error)}"
        raise UserError(f"{what}{way_out}") from error


def _has_own_load(algorithm: type[BaseAlgorithm]) -> bool:
    """Whether the class has a `load` other than the library's, as hand-written agents have."""
    from stable_baselines3.common.base_class import BaseAlgorithm

    own: Any = algorithm.load
    return own.__func__ is not vars(BaseAlgorithm)["load"].__func__


def _own_classes(algorithm: type[BaseAlgorithm], typed: list[str]) -> Mapping[str, type]:
    """The user's networks, optimizers and buffers, by their full names; no other classes."""
    from stable_baselines3.common.buffers import BaseBuffer
    from torch import nn, optim

    from rl_yardstick.safe_files.known_objects import by_name

    kinds = (nn.Module, optim.Optimizer, BaseBuffer)
    homes = tuple(f"{home}." for home in (*map(module_name, typed), algorithm.__module__))
    modules = [one for name, one in list(sys.modules.items()) if f"{name}.".startswith(homes)]
    values = [value for module in modules for value in list(vars(module).values())]
    classes = [one for one in values if isinstance(one, type) and issubclass(one, kinds)]
    return {name: one for name, one in by_name(classes).items() if name.startswith(homes)}


# --- statistics, and training further -------------------------------------------------------------


def _as_saved(spec: TrainSpec, data: Mapping[str, Any], statistics: Path | None) -> TrainSpec:
    """The spec with the masks and the VecNormalize of a model that was saved."""
    if data.get("mask_actions") is True:
        spec = spec.changed(algorithm={"mask_actions": True, **spec.algorithm})
    if statistics is None:
        return spec
    settings = _read_statistics(statistics).settings
    # NumPy's numbers become Python's.
    plain = {key: getattr(value, "item", lambda v=value: v)() for key, value in settings.items()}
    kept = {key: value for key, value in plain.items() if value is not None and key != "training"}
    return spec.changed(normalize={**kept, **(spec.normalize or {})})


def _read_statistics(path: Path) -> Any:
    from rl_yardstick.safe_files.buffers_and_statistics import read_normalization

    with as_user_error(f"{path} cannot be read", ValueError):
        return read_normalization(read_bytes(path, MAX_MODEL))


def take_statistics(env: Any, path: Path) -> None:
    """Give environments the VecNormalize statistics in a file, which is read as data."""
    from stable_baselines3.common.vec_env import unwrap_vec_normalize

    saved, inside = _read_statistics(path), unwrap_vec_normalize(env)
    if inside is None:
        raise UserError(f"{path}: the environments here are not normalised")
    if inside.norm_obs and saved.settings["norm_obs"]:
        given = [
            rms if isinstance(rms, dict) else {"": rms} for rms in (saved.obs_rms, inside.obs_rms)
        ]
        there, here = ({key: one.mean.shape for key, one in rms.items()} for rms in given)
        if here != there:
            fault = f"holds statistics of observations of shape {there.get('', there)}"
            here_it_is = f"the environment gives {here.get('', here)}"
            raise UserError(f"{path} {fault}; {here_it_is}: --vec-normalize FILE, or none")
        inside.obs_rms = saved.obs_rms
    inside.ret_rms = saved.ret_rms


def begun_with(spec: TrainSpec) -> TrainSpec:
    """The spec of a training that begins with an agent, with its masks and its normalisation."""
    path = Path(spec.trained_agent or "")
    data, given = zip_data(path), spec.vec_normalize
    wanted = Wanted(algo=spec.algo, env_id=spec.env_id, typed=spec.gym_packages)
    if given is None and _spec_of(path, data, wanted).normalize is not None:
        found = statistics_of(path)
        given = None if found is None else str(found.absolute())
    statistics = None if given in (None, NONE) else Path(given)
    return _as_saved(spec, data, statistics).changed(vec_normalize=given)


def load_to_train(spec: TrainSpec, env: VecEnv, **arguments: Any) -> BaseAlgorithm:
    """The agent of ``spec.trained_agent`` on its new environments, with its replay buffer."""
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

    from rl_yardstick.agents.library import MaskedReplayBuffer
    from rl_yardstick.safe_files.buffers_and_statistics import load_replay_buffer

    path = Path(spec.trained_agent or "")
    # The networks come from the file, so these arguments cannot apply.
    given = {k: v for k, v in arguments.items() if k not in ("policy", "policy_kwargs")}
    if "n_steps" in given and issubclass(load_algorithm(spec.algo), OffPolicyAlgorithm):
        # The library chooses the buffer's class by ``n_steps``, and would keep the file's class.
        given = {"replay_buffer_class": None, "replay_buffer_kwargs": {}, **given}
    agent: Any = load(spec, path, env, **given)
    if spec.vec_normalize not in (None, NONE) and agent.get_vec_normalize_env():
        take_statistics(env, Path(spec.vec_normalize))
    buffer = replay_buffer_of(path)
    if buffer is None or not issubclass(load_algorithm(spec.algo), OffPolicyAlgorithm):
        return agent  # type: ignore[no-any-return]
    content, wanted = io.BytesIO(read_bytes(buffer, MAX_MODEL)), agent.replay_buffer
    with as_user_error(f"{buffer} cannot be read", ValueError, AssertionError):
        load_replay_buffer(agent, content, classes={MaskedReplayBuffer, type(wanted)})
    found, needed = (
        f"{type(one).__name__} of n_envs:{one.n_envs} and n_steps:{getattr(one, 'n_steps', 1)}"
        for one in (agent.replay_buffer, wanted)
    )
    if found != needed:
        raise UserError(f"{buffer} holds a {found}; these hyperparameters need a {needed}")
    return agent  # type: ignore[no-any-return]
