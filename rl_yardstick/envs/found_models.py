"""Models that a search finds in the code of environments, kept in memory and on disk.

The folder on disk is ``yardstick/models`` in the user's cache. A file's name is a digest of the
source files, the arguments and the first steps of its environment, and of the limits.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary
from zipfile import BadZipFile

import cloudpickle
import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rl_yardstick.envs.finite_spaces import Bijection
from rl_yardstick.envs.model_of import FoundModel, NotFinite, Unfinished, model_of
from rl_yardstick.envs.model_of.check import seeded_globally
from rl_yardstick.envs.published_models import copy_of, is_changed
from rl_yardstick.mdp.transition_model import TransitionModel

Env = gym.Env[Any, Any]

STEPS_COMPARED = 300  # of the environment, for the name of a file
SAID_AFTER = 2.0  # seconds of a search
MOST_FILES = 200
KINDS_OF_FILES = {".csv", ".json", ".npy", ".npz", ".py", ".toml", ".txt", ".yaml", ".yml"}
MOST_BYTES = 1_000_000  # of a file that an environment may read
SECONDS_OF_REFUSALS = 86_400.0  # on a slow day, a search may run out of time


class Limits(NamedTuple):
    """How long a search may take, how many states it may find, and what it may leave out."""

    seconds: float = 10.0
    states: int = 100_000
    ignored: tuple[str, ...] = ()  # names of attributes that change nothing
    starts: tuple[int, ...] = ()  # seeds of `reset`, equally likely; all starts if there are none


_limits: ContextVar[Limits | None] = ContextVar("limits", default=Limits())  # noqa: B039 (never changes)


def limit(text: str, ignored: Sequence[str] = (), starts: Sequence[int] = ()) -> None:
    """Search from now on within the usual limits (``auto``), up to a number of states, or never.

    Args:
        text: ``auto``, a number such as ``1000000``, or ``none``.
        ignored: names of attributes that change nothing.
        starts: seeds of `reset`, each of which is equally likely; empty for all starts.
    """
    most = Limits() if text in {"auto", "none"} else Limits(math.inf, int(text))
    chosen = most._replace(ignored=tuple(ignored), starts=tuple(starts))
    _limits.set(None if text == "none" else chosen)


def limits() -> Limits | None:
    """The present limits; None where nothing is searched."""
    return _limits.get()


@dataclass(frozen=True)
class NotFound:
    """Why a search found no model."""

    reason: str  #: in one line
    is_at_limit: bool = False  #: whether a longer search might find one


_of_object: WeakKeyDictionary[Env, tuple[Limits, FoundModel | NotFound]] = WeakKeyDictionary()
_of_name: dict[str, FoundModel | NotFound] = {}


def found(core: Env) -> FoundModel | NotFound | None:
    """The model of an environment, or why there is none; None if none is to be searched.

    In the model, an action that is not allowed does what an allowed one does; observations are in
    an array, or None. A search leaves the environment as it is: it works on a copy.
    """
    wanted, is_own = limits(), type(core).__module__.startswith("rl_yardstick.")
    if wanted is None or (is_own and not isinstance(core, gym.Wrapper)):
        return None
    if core not in _of_object or _of_object[core][0] != wanted:
        _of_object[core] = wanted, _by_name(core, wanted)
    return _of_object[core][1]


def _by_name(core: Env, limits: Limits) -> FoundModel | NotFound:
    """The result of an earlier search in the same code, or of a new one."""
    if is_changed(core.unwrapped):  # a method of the copy may act on the original
        return NotFound("a method was replaced by hand")
    what = "cannot be copied"
    try:
        fresh, played, what = copy_of(core), copy_of(core), "fails"
        is_kept = core.spec is not None and isinstance(core.action_space, gym.spaces.Discrete)
        name = _name_of(played, limits) if is_kept else None
    except Exception as error:  # noqa: BLE001  # the environment may raise any
        return NotFound(f"the environment {what}: {' '.join(str(error).split())}")
    if name is None:
        return _search(fresh, limits)
    if name not in _of_name:
        file = _folder() / f"{name}.npz"
        result = _read(file)
        if result is None:
            result = _search(fresh, limits)
            _write(file, result)
        _of_name[name] = result
    return _of_name[name]


def _search(env: Env, limits: Limits) -> FoundModel | NotFound:
    begin, is_said = time.perf_counter(), False

    def progress(n_states: int, _n_done: int) -> None:
        nonlocal is_said
        is_late = time.perf_counter() - begin > SAID_AFTER
        if is_late and not is_said and sys.stderr.isatty():
            is_said = True
            most = f"at most {limits.states:,} states"
            most += "" if math.isinf(limits.seconds) else f", {limits.seconds:g} seconds"
            print(f"looking for the exact model of {env}: {most}", file=sys.stderr, flush=True)  # noqa: T201

    try:
        found = model_of(
            env,
            seconds=limits.seconds,
            max_states=limits.states,
            ignore=limits.ignored,
            starts=limits.starts,
            progress=progress,
        )
    except NotFinite as error:
        is_limit = isinstance(error, Unfinished)
        more = f"; --model {10 * limits.states} to continue" if is_limit else ""
        return NotFound(f"{error}{more}", is_limit)
    except (Exception, SystemExit) as error:  # noqa: BLE001  # its code may do anything
        return NotFound(f"it raised {type(error).__name__}: {' '.join(str(error).split())}")
    observations = _stacked(env.observation_space, found)
    return replace(found, model=_legal(found), observations=observations)


def _legal(found: FoundModel) -> TransitionModel:
    """The model in which an action that is not allowed does what an allowed one does."""
    model, mask = found.model, found.mask
    if mask is None:
        return model
    states = np.arange(model.n_states)[:, None]
    action = np.where(mask, np.arange(model.n_actions), mask.argmax(axis=1)[:, None])
    arrays: dict[str, Any] = {each.name: getattr(model, each.name) for each in fields(model)}
    of_pairs = {name for name, array in arrays.items() if name != "initial" and array is not None}
    return replace(model, **{name: arrays[name][states, action] for name in of_pairs})


def _stacked(space: Any, found: FoundModel) -> NDArray[Any] | None:
    """The observations in an array, states along the first axis; those of parts side by side."""
    with suppress(ValueError, TypeError):
        if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
            digits_of = Bijection(space).digits_of
            return np.array([digits_of(seen) for seen in found.observations])
        return np.array(found.observations, space.dtype)
    return None


def _name_of(env: Env, limits: Limits) -> str:
    """A digest of all that decides what a search finds."""
    versions = [version(name) for name in ("rl-yardstick", "gymnasium", "numpy")]
    layers = [env]
    while isinstance(layers[-1], gym.Wrapper):
        layers.append(layers[-1].env)
    spec: Any = layers[-1].spec
    made = [(repr(type(layer)), repr(getattr(layer, "_saved_kwargs", {}))) for layer in layers]
    digest = hashlib.sha256(repr((limits, versions, made, spec.kwargs)).encode())
    if not isinstance(spec.entry_point, str):
        digest.update(cloudpickle.dumps(spec.entry_point))
    for file in _files_of({kind.__module__ for layer in layers for kind in type(layer).__mro__}):
        digest.update(file.read_bytes())
    for seen in _first_steps(env):
        digest.update(repr(seen).encode())
    return digest.hexdigest()[:24]


def _first_steps(env: Any) -> Iterator[Any]:
    """What the environment does in its first steps: it may depend on files and settings."""
    rng, is_over = np.random.default_rng(0), True
    with seeded_globally(0):
        for step in range(STEPS_COMPARED):
            if is_over:
                yield env.reset(seed=step)[0]
            try:
                result = env.step(env.action_space.start + rng.integers(env.action_space.n))
            except (Exception, SystemExit) as error:  # noqa: BLE001  # it may not be allowed
                yield str(error)
                return
            yield result[:4]
            is_over = result[2] or result[3]


def _files_of(modules: set[str]) -> list[Path]:
    """The source files of modules and of their packages, and small files beside them."""
    found = set[Path]()
    for name in modules:
        top, *below = name.split(".")
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is None or top in {*sys.stdlib_module_names, "gymnasium"}:
            continue
        root = Path(file).parents[len(below) - (Path(file).name != "__init__.py")]
        found |= {*(root.rglob("*.py") if below else ()), *Path(file).parent.iterdir()}
    known = {path for path in found if path.suffix in KINDS_OF_FILES and path.is_file()}
    return sorted(path for path in known if path.stat().st_size < MOST_BYTES)


# --- on disk --------------------------------------------------------------------------------------


def _folder() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "yardstick" / "models"


def _read(file: Path) -> FoundModel | NotFound | None:
    """What a file holds; None where there is none, or it cannot be read."""
    with suppress(OSError, ValueError, KeyError, TypeError, BadZipFile), np.load(file) as held:
        arrays = dict(held)
        told = json.loads(str(arrays.pop("told")))
        if "reason" in told:
            is_old = time.time() - file.stat().st_mtime > SECONDS_OF_REFUSALS
            return None if is_old else NotFound(**told)
        own = {name: arrays.pop(name, None) for name in ("mask", "observations")}
        return FoundModel(TransitionModel(**arrays), **own, **told)
    return None


def _write(file: Path, result: FoundModel | NotFound) -> None:
    """Write a file, and remove all but the newest; nothing where the folder cannot be written."""
    told = dict(vars(result))
    arrays = {name: told.pop(name, None) for name in ("mask", "observations")}
    if isinstance(result, FoundModel):
        model = told.pop("model")
        arrays |= {each.name: getattr(model, each.name) for each in fields(model)}
    kept = {name: array for name, array in arrays.items() if array is not None}
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        beside = file.with_suffix(f".{os.getpid()}.npz")
        np.savez_compressed(beside, told=np.array(json.dumps(told)), **kept)
        beside.replace(file)
        others = sorted(file.parent.glob("*.npz"), key=lambda path: path.stat().st_mtime)
        for path in others[:-MOST_FILES]:
            path.unlink()
