"""The state of a training as one signed pickle, from which it goes on bit for bit.

The objects that running functions refer to (agent, environments, buffers, callbacks) are *roots*:
they keep their identity, and only their attributes are saved. Resuming makes the training anew, as
at its beginning, and at the first safe moment puts the saved attributes into the new roots. So
resuming has no code path of its own.

A pickle can run any code, so only states with this user's signature are read.
"""

from __future__ import annotations

import hmac
import io
import pickle
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from rl_yardstick.agents.common.model_files import key_of_user
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.files import read_bytes, replacing

MAX_STATE = 1 << 36  # bytes
_OF_PROCESS = {"locals", "globals", "class_attributes", "results_writer", "_logger"}


def roots_of(agent: Any, callbacks: list[BaseCallback], **process: Any) -> dict[str, Any]:
    """The roots by name; ``process`` are objects of the process, of which nothing is saved."""
    found: dict[str, Any] = {"agent": agent, "policy": agent.policy, "logger": agent.logger}
    for name in ("replay_buffer", "rollout_buffer", "action_noise"):
        found[name] = getattr(agent, name, None)
    found.update((f"callback {i}", callback) for i, callback in enumerate(callbacks))
    found.update((f"environment {i}", env) for i, env in enumerate(_layers(agent.env)))
    return {name: root for name, root in {**found, **process}.items() if root is not None}


def _layers(env: Any) -> Iterator[Any]:
    """A VecEnv, what it wraps, its environments and what these wrap."""
    while hasattr(env, "venv"):
        yield env
        env = env.venv
    yield env
    for single in getattr(env, "envs", ()):  # those of a SubprocVecEnv are elsewhere
        while isinstance(single, gym.Wrapper):
            yield single
            single = single.env  # noqa: PLW2901
        yield single


def save_state(path: Path, roots: dict[str, Any], process: tuple[str, ...]) -> None:
    """Write the attributes of all roots and the global generators, signed."""
    attributes: dict[str, Any] = {}
    positions: dict[str, int] = {}
    for name, root in roots.items():
        if name not in process:
            left_out = _left_out(type(root))
            attributes[name] = {k: value for k, value in vars(root).items() if k not in left_out}
        if (writer := vars(root).get("results_writer")) is not None:  # a Monitor's open file
            writer.file_handler.flush()
            positions[name] = int(writer.file_handler.tell())
    generators = random.getstate(), np.random.get_state(), th.get_rng_state()  # noqa: NPY002
    stream = io.BytesIO()
    _Pickler(stream, roots).dump((attributes, positions, generators))
    content = stream.getvalue()
    with replacing(path) as beside:
        beside.write_bytes(hmac.digest(key_of_user(), content, "sha256") + content)


def load_state(path: Path, roots: dict[str, Any]) -> None:
    """Put a saved state into the roots of a training that was made with the same spec.

    Raises UserError if the state is not signed by this user.
    """
    content = read_bytes(path, MAX_STATE)
    if not hmac.compare_digest(content[:32], hmac.digest(key_of_user(), content[32:], "sha256")):
        raise UserError(f"{path} is not signed with your key: a state of others is not loaded")
    unpickler: Any = pickle.Unpickler(io.BytesIO(content[32:]))  # noqa: S301  # signed
    unpickler.persistent_load = roots.__getitem__
    attributes, positions, (python, numpy, torch) = unpickler.load()
    for name, saved in attributes.items():
        inside = vars(roots[name])
        for key in inside.keys() - saved.keys() - _left_out(type(roots[name])):
            del inside[key]
        inside.update(saved)
    for name, position in positions.items():
        roots[name].results_writer.file_handler.truncate(position)
    random.setstate(python)
    np.random.set_state(numpy)  # noqa: NPY002
    th.set_rng_state(torch)


def _left_out(kind: type) -> set[str]:
    """Attributes that a class rebuilds by itself or that belong to the process."""
    own = (name for c in kind.__mro__ for name in vars(c).get("excluded_from_states", ()))
    return _OF_PROCESS.union(own)


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    """Names the roots, and lets arrays and tensors that share memory share it again."""

    def __init__(self, stream: io.BytesIO, roots: dict[str, Any]) -> None:
        super().__init__(stream, protocol=5)
        self.names = {id(root): name for name, root in roots.items()}

    def persistent_id(self, obj: Any) -> str | None:
        return self.names.get(id(obj))

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) in (th.Tensor, th.nn.Parameter) and obj.device.type == "cpu":
            place = obj.dtype, obj.storage_offset(), tuple(obj.shape), obj.stride()
            is_parameter = isinstance(obj, th.nn.Parameter)
            return _tensor, (obj.untyped_storage(), *place, is_parameter, obj.requires_grad)
        if isinstance(obj, th.UntypedStorage):
            return _storage, (bytes(np.asarray(th.empty(0, dtype=th.uint8).set_(obj))),)
        if type(obj) is np.ndarray and obj.base is not None and not obj.dtype.hasobject:
            memory: Any = obj
            while isinstance(memory, np.ndarray) and memory.base is not None:
                memory = memory.base
            offset = obj.__array_interface__["data"][0]
            if isinstance(memory, th.Tensor):
                memory = memory.untyped_storage()
                offset -= memory.data_ptr()
            elif isinstance(memory, np.ndarray):
                offset -= memory.__array_interface__["data"][0]
            else:
                return super().reducer_override(obj)
            return _view, (memory, offset, obj.dtype, obj.shape, obj.strides)
        return super().reducer_override(obj)


def _storage(content: bytes) -> th.UntypedStorage:
    if not content:
        return th.UntypedStorage(0)  # type: ignore[no-untyped-call]
    return th.frombuffer(bytearray(content), dtype=th.uint8).untyped_storage()


def _tensor(
    storage: Any, dtype: Any, offset: int, shape: Any, stride: Any, is_parameter: bool, grad: bool
) -> th.Tensor:
    tensor = th.empty(0, dtype=dtype).set_(storage, offset, shape, stride)
    return th.nn.Parameter(tensor, grad) if is_parameter else tensor.requires_grad_(grad)


def _view(memory: Any, offset: int, dtype: Any, shape: Any, strides: Any) -> Any:
    if isinstance(memory, th.UntypedStorage):
        memory = th.empty(0, dtype=th.uint8).set_(memory).numpy()
    return np.ndarray(shape, dtype, memory, offset, strides)
