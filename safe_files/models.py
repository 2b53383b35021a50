"""Models of Stable-Baselines3 and sb3-contrib, loaded from files of unknown origin."""

from __future__ import annotations

import base64
import binascii
import inspect
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from safe_files.archives import MEMBERS, SETTINGS, TENSORS, parse_settings, read_members
from safe_files.limits import MAX_ARCHIVE_BYTES, Budget
from safe_files.objects import policy_classes, read_pickle
from safe_files.rebuilding import Maker
from safe_files.refusals import UnsafeFileError, shown
from safe_files.regular_files import Source, content_of
from safe_files.tensors import check_values, first_line, load_tensors
from safe_files.weights import charged_tensors, check_fit, check_sizes, check_variable

# What is trained and part of no network: the entropy coefficient of SAC and its kin.
VARIABLES = frozenset({"log_ent_coef", "ent_coef_tensor"})

# The files of those; the second is the name that the first once had.
_VARIABLES = frozenset({"pytorch_variables.pth", "tensors.pth"})

# What the reader's own side decides.
NOT_READ = frozenset(
    {"env", "device", "policy", "rollout_buffer", "replay_buffer", "tensorboard_log"}
    | {"_logger", "_custom_logger", "_vec_normalize_env", "_episode_storage"}
)
# Made anew from the learning rate and the shares of exploration.
DERIVED = frozenset({"lr_schedule", "exploration_schedule"})
SERIALIZED = ":serialized:"

# What a class may have as the default of an attribute.
_PLAIN = (bool, int, float, str, type(None))

Algorithm = TypeVar("Algorithm", bound=BaseAlgorithm)


@dataclass(frozen=True)
class Settings:
    """A model's attributes."""

    plain: Mapping[str, Any]  # those that are plain data
    pickled: Mapping[str, bytes]  # those that the library pickles, as pickles

    def __contains__(self, name: str) -> bool:
        return name in self.plain or name in self.pickled


def load_model(
    algorithm: type[Algorithm],
    path: Source,
    env: Any = None,
    *,
    device: th.device | str = "auto",
    classes: Mapping[str, type] | None = None,
    makers: Mapping[str, Maker] | None = None,
    custom_objects: Mapping[str, Any] | None = None,
    **replaced: Any,
) -> Algorithm:
    """Load a model as ``algorithm.load`` does, without running anything that the file names.

    Args:
        algorithm: the class of the model, of Stable-Baselines3 or sb3-contrib, or one of your own
            that is made and saved as theirs are.
        path: the zip, or a stream of its bytes.
        env: the environment to go on with, or None.
        device: where the tensors go.
        classes: classes of your own that the file may name, by their full names.
        makers: what makes further objects that it may hold, by the full names of their classes.
        custom_objects: values for attributes of the file, which are not read then; names that it
            does not have are passed over.
        replaced: attributes to set instead of those in the file, which are not read then.

    Raises:
        UnsafeFileError: if the file holds what may not stand in it, is damaged, or too large.
        OSError: if it cannot be read.
        ValueError: if the model does not fit ``env``, as the library says it.
    """
    files, variables = _tensors_of(algorithm)
    content = content_of(path, MAX_ARCHIVE_BYTES)
    budget = Budget(len(content))
    members = read_members(content, MEMBERS | files, budget)
    settings = read_settings(members, algorithm, budget)
    known = {**policy_classes(algorithm), **(classes or {})}
    given = {name: value for name, value in (custom_objects or {}).items() if name in settings}
    objects = {**_objects(settings, known, makers, {**replaced, **given}, budget), **given}
    if not isinstance(objects.get("policy_class"), type):
        raise UnsafeFileError("does not say its policy's class", "policy_class")
    names = sorted(files & set(members))
    tensors = {name: load_tensors(members.pop(name), budget) for name in names}
    check_values(tensors)
    _check_variables(tensors, variables)
    check_sizes({**settings.plain, **objects, **replaced}, budget)
    try:
        with charged_tensors(budget):
            model = _with_tensors(algorithm, tensors).load(
                _zipped(_data(settings, objects), tensors),
                env=env,
                device=device,
                custom_objects=objects,
                **replaced,
            )
        model.__class__ = algorithm
        check_fit(model, tensors)
    except ValueError:
        raise  # it does not fit the environment
    except Exception as error:  # settings and weights that do not go together can fail anywhere
        raise UnsafeFileError(f"holds no such model: {first_line(error)}") from error
    return model


def _with_tensors(algorithm: type[Algorithm], tensors: Mapping[str, Any]) -> type[Algorithm]:
    """The algorithm, which fills in the parameters of which it finds the names in a zip."""

    def set_parameters(
        self: BaseAlgorithm, found: Any, exact_match: bool = True, device: Any = "auto"
    ) -> None:
        for name, held in found.items():
            held.update(held or tensors[f"{name}.pth"])
        algorithm.set_parameters(self, found, exact_match, device)

    return type(algorithm.__name__, (algorithm,), {"set_parameters": set_parameters})


def read_settings(
    members: Mapping[str, bytes], algorithm: type[BaseAlgorithm], budget: Budget
) -> Settings:
    """The attributes in a zip, those left out that a reader decides; the budget pays for them."""
    data = parse_settings(members, budget)
    plain: dict[str, Any] = {}
    pickled: dict[str, bytes] = {}
    for key, value in data.items():
        if key in NOT_READ or key in DERIVED:
            continue
        if not key.isidentifier() or key.startswith("__") or hides(algorithm, key):
            raise UnsafeFileError(f"sets {shown(key)}, which is no attribute of a model", key)
        if isinstance(value, dict) and SERIALIZED in value:
            pickled[key] = decoded(key, value[SERIALIZED])
        else:
            plain[key] = value
    return Settings(plain, pickled)


def hides(algorithm: type, name: str) -> bool:
    """Whether an attribute of that name would hide something of the class but a plain default."""
    missing = object()
    value = inspect.getattr_static(algorithm, name, missing)
    return value is not missing and not isinstance(value, _PLAIN)


def _tensors_of(algorithm: type[BaseAlgorithm]) -> tuple[frozenset[str], frozenset[str]]:
    """The files of tensors that such a model has, and its variables that are part of no network."""
    try:
        # Those of the libraries need no more than the class to say it, or are known.
        own: Any = algorithm._get_torch_save_params(algorithm.__new__(algorithm))
        files, variables = frozenset(f"{name}.pth" for name in own[0]), frozenset(own[1])
    except AttributeError:
        return TENSORS, VARIABLES
    return TENSORS | files, VARIABLES | variables


def decoded(key: str, text: Any) -> bytes:
    """The pickle that stands in JSON as base64."""
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise UnsafeFileError(f"{key} is damaged: {error}", key) from error


def _objects(
    settings: Settings,
    classes: Mapping[str, type],
    makers: Mapping[str, Maker] | None,
    replaced: Mapping[str, Any],
    budget: Budget,
) -> dict[str, Any]:
    """What the pickled attributes stand for."""
    objects: dict[str, Any] = {}
    for key, pickled in settings.pickled.items():
        if key in replaced:
            continue
        try:
            objects[key] = read_pickle(pickled, classes, makers, budget)
        except UnsafeFileError as error:
            raise UnsafeFileError(f"{key} {error}", key) from error
    return objects


def _check_variables(tensors: Mapping[str, Any], known: frozenset[str]) -> None:
    """The library sets each of these by the way to it: let there be no other than it writes."""
    for name in sorted(_VARIABLES):
        variables = tensors.get(name, {})
        if not isinstance(variables, dict):
            raise UnsafeFileError(f"holds {name} that is not as the library writes it")
        strange = sorted(map(str, set(variables) - known))
        if strange:
            raise UnsafeFileError(f"sets {shown(strange[0])}, which is no variable of a model")
        for key in VARIABLES & set(variables):
            check_variable(f"{name}: {key}", variables[key])


def _data(settings: Settings, objects: Mapping[str, Any]) -> bytes:
    # The library looks for the keys of its custom objects among those of the file.
    return json.dumps({**settings.plain, **dict.fromkeys(objects)}).encode()


def _zipped(data: bytes, tensors: Mapping[str, Any]) -> io.BytesIO:
    """A zip of what was checked, written anew; of the parameters, it has the names alone."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(SETTINGS, data)
        for name, held in tensors.items():
            with archive.open(name, "w") as member:
                th.save(held if name in _VARIABLES else {}, member)
    content.seek(0)
    return content
