"""Objects of Stable-Baselines3, PyTorch and Python's collections in pickles."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.noise import (
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy

from safe_files import tensors
from safe_files.limits import Budget
from safe_files.pickle_trees import Made
from safe_files.rebuilding import Build, Maker, arguments, fields, wrong
from safe_files.tensors import lone_storage

_COMMON = "stable_baselines3.common"
_NUMBERS = (int, float, np.number, np.ndarray)


def _ordered_dict(made: Made, build: Build) -> OrderedDict[Any, Any]:
    if made.args or made.state is not None or made.items:
        raise wrong(made)
    return OrderedDict((build(key), build(value)) for key, value in _string_keys(made))


def _string_keys(made: Made) -> list[tuple[Any, Any]]:
    if not all(isinstance(key, str) for key, _ in made.pairs):
        raise wrong(made)
    return made.pairs


def _deque(made: Made, build: Build) -> deque[Any]:
    # The arguments are what it holds, always nothing, and its greatest length.
    args = tuple(build(arg) for arg in made.args)
    if made.state is not None or made.pairs or (args and args[0] not in ((), [])) or len(args) > 2:
        raise wrong(made)
    return deque((build(item) for item in made.items), *args[1:])


def _train_freq(made: Made, build: Build) -> TrainFreq:
    return TrainFreq(*arguments(made, build, int, TrainFrequencyUnit))


def _train_frequency_unit(made: Made, build: Build) -> TrainFrequencyUnit:
    return TrainFrequencyUnit(*arguments(made, build, str))


def _goal_selection(made: Made, build: Build) -> GoalSelectionStrategy:
    return GoalSelectionStrategy(*arguments(made, build, int))


def _running_mean_std(made: Made, build: Build) -> RunningMeanStd:
    state = fields(made, build)
    if set(state) != {"mean", "var", "count"}:
        raise wrong(made)
    statistics = RunningMeanStd()
    for name, value in state.items():
        if not isinstance(value, _NUMBERS) or not np.isfinite(value).all():
            raise wrong(made)
        setattr(statistics, name, value)
    return statistics


def _normal_noise(made: Made, build: Build) -> NormalActionNoise:
    state = _noise_state(made, build)
    return NormalActionNoise(state["_mu"], state["_sigma"], state["_dtype"])


def _ornstein_uhlenbeck_noise(made: Made, build: Build) -> OrnsteinUhlenbeckActionNoise:
    state = _noise_state(made, build)
    names = ("_mu", "_sigma", "_theta", "_dt", "initial_noise", "_dtype")
    noise = OrnsteinUhlenbeckActionNoise(*(state[name] for name in names))
    noise.noise_prev = state["noise_prev"]
    return noise


def _noise_state(made: Made, build: Build) -> Mapping[str, Any]:
    state = fields(made, build)
    kinds = {name: (type,) if name == "_dtype" else (*_NUMBERS, type(None)) for name in state}
    if not all(isinstance(value, kinds[name]) for name, value in state.items()):
        raise wrong(made)
    return state


def _vectorized_noise(made: Made, build: Build) -> VectorizedActionNoise:
    state = fields(made, build)
    noises = state.get("_noises")
    kinds = NormalActionNoise | OrnsteinUhlenbeckActionNoise
    fits = isinstance(noises, list) and all(isinstance(noise, kinds) for noise in noises)
    if not fits or not isinstance(state.get("_base_noise"), kinds):
        raise wrong(made)
    assert noises is not None
    vectorized = VectorizedActionNoise(state["_base_noise"], len(noises))
    vectorized.noises = noises
    return vectorized


def _device(made: Made, build: Build) -> th.device:
    # Whatever the file says: what is read lands where its reader wants it.
    arguments(made, build, *((str,) if len(made.args) == 1 else (str, int)))
    return th.device("cpu")


def _storage(made: Made, build: Build) -> th.Tensor:
    (data,) = arguments(made, build, bytes)
    return lone_storage(data, Budget(len(data)))


MAKERS: Mapping[str, Maker] = {
    "collections.OrderedDict": _ordered_dict,
    "collections.deque": _deque,
    f"{_COMMON}.type_aliases.TrainFreq": _train_freq,
    f"{_COMMON}.type_aliases.TrainFrequencyUnit": _train_frequency_unit,
    f"{_COMMON}.running_mean_std.RunningMeanStd": _running_mean_std,
    f"{_COMMON}.noise.NormalActionNoise": _normal_noise,
    f"{_COMMON}.noise.OrnsteinUhlenbeckActionNoise": _ornstein_uhlenbeck_noise,
    f"{_COMMON}.noise.VectorizedActionNoise": _vectorized_noise,
    "stable_baselines3.her.goal_selection_strategy.GoalSelectionStrategy": _goal_selection,
    "torch.device": _device,
    "torch.storage._load_from_bytes": _storage,
    "torch._utils._rebuild_tensor_v2": tensors.MAKERS["torch._utils._rebuild_tensor_v2"],
}
