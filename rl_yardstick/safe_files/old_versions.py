"""Brings models of old versions of the library into the form of today's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rl_yardstick.safe_files.files import UnsafeFileError

_WEIGHTS, _OPTIMIZER = "policy.pth", "policy.optimizer.pth"
_SHARED = "mlp_extractor.shared_net."
_PARTS = {"pi": "mlp_extractor.policy_net.", "vf": "mlp_extractor.value_net."}
# Arguments of HerReplayBuffer that version 1.8 dropped.
_DROPPED = ("online_sampling", "max_episode_length")


def update(tensors: dict[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Rewrite files of tensors in place; the settings of a model that change with them.

    Raises:
        UnsafeFileError: if actor and critic share layers and the learning rate is not 0: the
            library gave that up in version 1.8, and would train the copies apart.
    """
    changes = dict[str, Any]()
    if isinstance(arguments := settings.get("replay_buffer_kwargs"), dict):
        kept = {name: value for name, value in arguments.items() if name not in _DROPPED}
        changes |= {} if kept == arguments else {"replay_buffer_kwargs": kept}
    weights = tensors.get(_WEIGHTS, {})
    if weights.keys() <= {"action_net.weight", "action_net.bias"}:  # ARS before version 1.7
        renamed = {key.replace("net.", "net.0."): value for key, value in weights.items()}
        tensors[_WEIGHTS] = renamed
    if any(key.startswith(_SHARED) for key in weights):
        if settings["learning_rate"] != 0.0:
            fault = "has layers that actor and critic share, as before version 1.8"
            raise UnsafeFileError(f"{fault}: it can be played, but not trained further")
        changes["policy_kwargs"] = _unshare(tensors, settings["policy_kwargs"])
    return changes


def _unshare(tensors: dict[str, Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Give actor and critic a copy each of the layers that they share; their arguments."""
    layers = arguments["net_arch"]
    shared = [width for width in layers if isinstance(width, int)]
    own = layers[-1] if isinstance(layers[-1], dict) else {}
    weights = dict[str, Any]()
    for key, value in tensors[_WEIGHTS].items():
        part = next((part for part in _PARTS.values() if key.startswith(part)), None)
        if key.startswith(_SHARED):
            weights |= {part + key.removeprefix(_SHARED): value for part in _PARTS.values()}
        elif part:  # behind the shared layers, each of which an activation follows
            index, _, rest = key.removeprefix(part).partition(".")
            weights[f"{part}{int(index) + 2 * len(shared)}.{rest}"] = value
        else:
            weights[key] = value
    tensors[_WEIGHTS] = weights
    # The optimizer's memory belongs to the parameters as they were.
    (group,) = tensors[_OPTIMIZER]["param_groups"]
    n_parameters = len(group["params"]) + 2 * len(shared)
    again = [{**group, "params": list(range(n_parameters))}]
    tensors[_OPTIMIZER] = {"state": {}, "param_groups": again}
    return {**arguments, "net_arch": {part: [*shared, *own.get(part, ())] for part in _PARTS}}
