"""The classes that a model file may name: none is called with anything but a model's settings."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from typing import Any

from stable_baselines3.common import buffers, torch_layers
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch import nn, optim
from torch.nn.modules import activation


def full_name(cls: type) -> str:
    """The class's module and qualified name."""
    return f"{cls.__module__}.{cls.__qualname__}"


def _by_name(classes: Iterable[type]) -> dict[str, type]:
    return {full_name(cls): cls for cls in classes}


def _subclasses_in(module: object, base: type) -> Iterable[Any]:
    return (cls for cls in vars(module).values() if isinstance(cls, type) and issubclass(cls, base))


def library_classes() -> Mapping[str, type]:
    """Buffers, feature extractors, activations and optimizers, by their full names."""
    return {
        **_by_name(_subclasses_in(buffers, buffers.BaseBuffer)),
        **_by_name([HerReplayBuffer, RMSpropTFLike, nn.Identity]),
        **_by_name(_subclasses_in(torch_layers, torch_layers.BaseFeaturesExtractor)),
        **_by_name(_subclasses_in(activation, nn.Module)),
        **_by_name(_subclasses_in(optim, optim.Optimizer)),
        **_contrib_classes(),
    }


def _contrib_classes() -> Mapping[str, type]:
    try:
        from sb3_contrib.common.maskable import buffers as maskable
        from sb3_contrib.common.recurrent import buffers as recurrent
    except ImportError:
        return {}
    found = (*_subclasses_in(maskable, buffers.BaseBuffer),)
    return _by_name((*found, *_subclasses_in(recurrent, buffers.BaseBuffer)))


def all_policy_classes() -> Mapping[str, type]:
    """The policies of all algorithms of Stable-Baselines3 and sb3-contrib, by their full names."""
    import stable_baselines3 as sb3

    libraries: list[object] = [sb3]
    with contextlib.suppress(ImportError):
        import sb3_contrib

        libraries.append(sb3_contrib)
    algorithms = (one for library in libraries for one in _subclasses_in(library, BaseAlgorithm))
    return {name: cls for one in algorithms for name, cls in policy_classes(one).items()}


def policy_classes(algorithm: type[BaseAlgorithm]) -> Mapping[str, type]:
    """The policies that the algorithm knows, by their full names."""
    return _by_name(algorithm.policy_aliases.values())
