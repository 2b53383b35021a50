"""From PyTorch's networks and optimizers to compiled code, which works in their memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from numba import typeof as _typeof
from numba.core import cgutils, types
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    models,
    register_model,
    typeof_impl,
    unbox,
)
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn

from agents.compiled.worlds import NotCompilable
from agents.networks import perceptron
from agents.networks.perceptron import (
    ADAM,
    ADAMW,
    RMSPROP,
    RMSPROP_TENSORFLOW,
    Layers,
    Optimizer,
    Singles,
    make_layers,
    n_parameters,
)
from machine_code.compiling import internal

# From networks and optimizers of Stable-Baselines3 to those of compiled code.

# The classes, what they are here, and the attribute that holds their parameter.
_ACTIVATIONS: dict[type[nn.Module], tuple[int, str | None]] = {
    nn.Identity: (perceptron.IDENTITY, None),
    nn.ReLU: (perceptron.RELU, None),
    nn.Tanh: (perceptron.TANH, None),
    nn.ELU: (perceptron.ELU, "alpha"),
    nn.LeakyReLU: (perceptron.LEAKY_RELU, "negative_slope"),
    nn.Sigmoid: (perceptron.SIGMOID, None),
    nn.SELU: (perceptron.SELU, None),
    nn.Softplus: (perceptron.SOFTPLUS, "beta"),
    nn.SiLU: (perceptron.SILU, None),
    nn.GELU: (perceptron.GELU, None),
    nn.Mish: (perceptron.MISH, None),
}

# From here on Softplus takes its input for its output, which rounding does as well.
_SOFTPLUS_THRESHOLD = 20

# Settings of optimizers that compiled steps do not have, as they have to be.
_PLAIN = {"amsgrad": False, "maximize": False, "momentum": 0, "centered": False}
_OPTIMIZERS = {th.optim.Adam, th.optim.AdamW, th.optim.RMSprop, RMSpropTFLike}


@dataclass(frozen=True)
class Network:
    """A perceptron of the library.

    Attributes:
        linears: its layers, the first one first.
        layers: the same as compiled code sees them.
    """

    linears: Sequence[nn.Linear]
    layers: Layers


def network_of(modules: Iterable[nn.Module], start: int, *, one_hot: bool) -> Network:
    """What linear layers with one activation function in between come to.

    Args:
        modules: the layers and functions, in order.
        start: where its parameters begin in the flat vector.
        one_hot: whether inputs are numbers that stand for one-hot vectors.

    Raises:
        NotCompilable: if it is anything else.
    """
    linears: list[nn.Linear] = []
    functions: list[tuple[int, float]] = []
    for module in modules:
        if type(module) is nn.Linear and module.bias is not None:
            if len(linears) != len(functions):
                raise NotCompilable("a network has linear layers without a function in between")
            linears.append(module)
        elif len(functions) == len(linears) - 1:
            functions.append(_activation(module))
        else:
            raise NotCompilable(f"a network has a layer of {type(module).__name__}")
    if len(set(functions)) > 1:
        raise NotCompilable("a network has several activation functions")
    if len(functions) != len(linears) - 1:
        raise NotCompilable("a network ends with an activation function")
    kind, slope = functions[0] if functions else (perceptron.IDENTITY, 0.0)
    sizes = [linears[0].in_features, *(linear.out_features for linear in linears)]
    return Network(linears, make_layers(sizes, start, kind, slope, one_hot=one_hot))


def _activation(module: nn.Module) -> tuple[int, float]:
    if type(module) not in _ACTIVATIONS:
        raise NotCompilable(f"a network has a layer of {type(module).__name__}")
    kind, parameter = _ACTIVATIONS[type(module)]
    if isinstance(module, nn.GELU) and module.approximate == "tanh":
        kind = perceptron.FAST_GELU
    if isinstance(module, nn.Softplus) and module.threshold != _SOFTPLUS_THRESHOLD:
        raise NotCompilable(f"a network has a Softplus with a threshold of {module.threshold:g}")
    slope = 0.0 if parameter is None else float(getattr(module, parameter))
    if slope < 0:
        raise NotCompilable(f"a network has a layer of {type(module).__name__} that falls")
    return kind, slope


def check_optimizer(optimizer: th.optim.Optimizer) -> None:
    """Make sure that compiled steps are those of the optimizer.

    Raises:
        NotCompilable: if they are not; the message says why.
    """
    if type(optimizer) not in _OPTIMIZERS:
        raise NotCompilable(f"its optimizer is {type(optimizer).__name__}, not Adam or RMSprop")
    if len(optimizer.param_groups) != 1:
        raise NotCompilable("its optimizer has several groups of parameters")
    group = optimizer.param_groups[0]
    for name, plain in _PLAIN.items():
        if group.get(name, plain) != plain:
            raise NotCompilable(f"its optimizer has {name} {group[name]}")
    if not all(parameter.requires_grad for parameter in group["params"]):
        raise NotCompilable("some of its parameters are frozen")
    if any(parameter.dtype is not th.float32 for parameter in group["params"]):
        raise NotCompilable("its parameters are not in single precision")


# The tensors of an agent's networks and of its optimizer, in memory that compiled code works on.
#
# While an agent trains, its tensors look into flat vectors, so that callbacks see at any time what
# has been learnt, and what they change counts. Afterwards the tensors have memory of their own
# again,
# laid out as PyTorch does it.

# What an optimizer's group holds that compiled steps go by.
_SETTINGS = ("betas", "alpha", "eps", "weight_decay", "decoupled_weight_decay")


class FlatTensors:
    """Tensors of linear layers that look into a flat vector.

    Args:
        networks: whose layers, one network after the other.

    Attributes:
        vector: all of the numbers.
        places: the layers' parameters, each with its part of the vector in its shape.
    """

    def __init__(self, networks: Sequence[Network]) -> None:
        self.vector: Singles = np.zeros(sum(n_parameters(n.layers) for n in networks), np.float32)
        linears = [linear for network in networks for linear in network.linears]
        self.places = list(self._places(linears))

    def _places(self, linears: Sequence[nn.Linear]) -> Iterator[tuple[th.Tensor, th.Tensor]]:
        begin = 0
        for linear in linears:
            for parameter in (linear.weight, linear.bias):
                end = begin + parameter.numel()
                # Compiled code has weights as (inputs, outputs).
                turned = self.vector[begin:end].reshape(tuple(parameter.shape)[::-1])
                yield parameter, th.from_numpy(turned.T)
                begin = end


class SharedParameters(FlatTensors):
    """The parameters of networks, in one flat vector."""

    def __init__(self, networks: Sequence[Network]) -> None:
        super().__init__(networks)
        self.take_over()

    def take_over(self) -> None:
        """Copy those into the vector that lie elsewhere, as somebody has put them there."""
        for parameter, place in self.places:
            if parameter.data_ptr() != place.data_ptr():
                place.copy_(parameter.data)
                parameter.data = place

    def give_back(self) -> None:
        """Let them have memory of their own."""
        for parameter, _ in self.places:
            parameter.data = parameter.data.clone(memory_format=th.contiguous_format)


class SharedOptimizer:
    """What the optimizer of a policy remembers, in flat vectors.

    Args:
        policy: the policy.
        networks: those that are trained.
    """

    def __init__(self, policy: Any, networks: Sequence[Network]) -> None:
        self.policy = policy
        self.networks = networks
        self.parameters = [parameter for parameter, _ in FlatTensors(networks).places]
        self._share()

    def current(self) -> Optimizer:
        """The optimizer as compiled code sees it; another one where somebody has changed it.

        Raises:
            NotCompilable: if it has become one that compiled code does not know.
        """
        if self._made_from() != self.made_from:
            self.give_back()
            check_optimizer(self.policy.optimizer)
            self._share()
        return self.compiled

    def _share(self) -> None:
        self.optimizer = self.policy.optimizer
        known: Any = self.optimizer.state
        kind, names = _kind(self.optimizer)
        means = {name: FlatTensors(self.networks) for name in names}
        n_steps = np.zeros(1, np.float32)
        if self.parameters[0] in known:
            n_steps[0] = float(known[self.parameters[0]]["step"])
        # As the library has it: the mean of squares begins with ones there.
        begins = th.tensor(1.0 if kind == RMSPROP_TENSORFLOW else 0.0)
        for name, tensors in means.items():
            for parameter, place in tensors.places:
                place.copy_(known[parameter].get(name, begins))
                known[parameter][name] = place
        for parameter in self.parameters:
            known[parameter]["step"] = th.from_numpy(n_steps)[0]
        vectors = [tensors.vector for tensors in means.values()]
        group = self.optimizer.param_groups[0]
        momentum, smoothing = group.get("betas", (0.0, group.get("alpha")))
        self.compiled = Optimizer(
            kind,
            float(momentum),
            float(smoothing),
            float(group["eps"]),
            float(group["weight_decay"]),
            vectors[0],
            vectors[-1],
            n_steps,
        )
        self.made_from = self._made_from()

    def _made_from(self) -> tuple[Any, ...]:
        """What changes where somebody loads another state, or takes another optimizer."""
        optimizer = self.policy.optimizer
        group = optimizer.param_groups[0]
        settings = [group.get(name) for name in _SETTINGS]
        states = [optimizer.state.get(parameter, {}) for parameter in self.parameters]
        memory = [_place_of(value) for state in states for value in state.values()]
        trained = [parameter.requires_grad for parameter in self.parameters]
        return id(optimizer), settings, memory, trained

    def give_back(self) -> None:
        """Let what it remembers have memory of its own; nothing, where it has taken no step."""
        known: Any = self.optimizer.state
        kind, _ = _kind(self.optimizer)
        remembered = [parameter for parameter in self.parameters if parameter in known]
        for parameter in remembered:
            known[parameter] = _own_memory(known[parameter], kind)
        if not any(known[parameter]["step"] for parameter in remembered):
            known.clear()


class SharedTensors:
    """All tensors of an agent that lie in the memory of compiled code.

    Args:
        policy: the agent's policy.
        networks: those that are trained, in the order of the flat vector.
        lagging: copies of them that lag behind.

    Attributes:
        networks: the same.
        trained: the parameters of the networks.
        lagging: those of the copies.
        optimizer: what moves the networks.
    """

    def __init__(
        self, policy: Any, networks: Sequence[Network], lagging: Sequence[Network] = ()
    ) -> None:
        self.networks = networks
        self.trained, self.lagging = SharedParameters(networks), SharedParameters(lagging)
        self.optimizer = SharedOptimizer(policy, networks)

    def take_over(self) -> Optimizer:
        """Let count what somebody has put in the place of tensors.

        Returns:
            The optimizer as compiled code sees it.

        Raises:
            ValueError: if it has become one that compiled code does not know.
        """
        self.trained.take_over()
        self.lagging.take_over()
        try:
            return self.optimizer.current()
        except NotCompilable as reason:
            raise ValueError(f"engine: compiled cannot go on: {reason}") from None

    def give_back(self) -> None:
        """Let all have memory of their own."""
        for part in (self.trained, self.lagging, self.optimizer):
            part.give_back()


@contextmanager
def shared_tensors(
    policy: Any, networks: Sequence[Network], lagging: Sequence[Network] = ()
) -> Iterator[SharedTensors]:
    """`SharedTensors` for a while."""
    shared = SharedTensors(policy, networks, lagging)
    try:
        yield shared
    finally:
        shared.give_back()


def in_rows(state: Any) -> Any:
    """What a ``state_dict`` holds, with tensors that lie in memory as the library lays them out."""
    if isinstance(state, dict):
        copied = copy(state)
        copied.update({name: in_rows(value) for name, value in state.items()})
        return copied
    return state.contiguous() if isinstance(state, th.Tensor) else state


def _place_of(value: Any) -> Any:
    return value.data_ptr() if isinstance(value, th.Tensor) else value


def _own_memory(state: dict[str, Any], kind: int) -> dict[str, Any]:
    """What an optimizer knows of a parameter, as PyTorch would have it in memory."""
    copied = {
        name: value.clone(memory_format=th.contiguous_format)
        if isinstance(value, th.Tensor)
        else value
        for name, value in state.items()
    }
    if kind == RMSPROP_TENSORFLOW:
        copied["step"] = int(copied["step"])
    return copied


def _kind(optimizer: th.optim.Optimizer) -> tuple[int, tuple[str, ...]]:
    """What the optimizer is here, and what PyTorch calls the means that it keeps."""
    if isinstance(optimizer, th.optim.Adam):
        decoupled = optimizer.param_groups[0]["decoupled_weight_decay"]
        return ADAMW if decoupled else ADAM, ("exp_avg", "exp_avg_sq")
    if isinstance(optimizer, RMSpropTFLike):
        return RMSPROP_TENSORFLOW, ("square_avg",)
    return RMSPROP, ("square_avg",)


# Named tuples and functions that compiled functions are handed by address.
#
# LLVM optimises a function anew as a part of each that calls it, and Numba hands a named tuple on
# as
# all the numbers that its arrays are described by. With a learner of thirty arrays, four calls
# below
# the loop, compiling takes the better part of a minute. A reference is one address: compiled
# functions read ``reference.name`` from there, as they would from the tuple. What learning comes to
# lies behind an address as well, so that it is compiled by itself, and once for all environments.

ir: Any = vars(cgutils)["ir"]  # llvmlite's, which comes with Numba

# Numba ships no types.
typeof: Any = _typeof
_typed_unbox: Any = unbox
_typed_getattr: Any = lower_getattr_generic

# All that is in a tuple is made of these.
WORD = 8


class Reference:
    """A named tuple of arrays and numbers, to be handed on by address.

    Args:
        held: the named tuple, whose parts may be such tuples as well; arrays stay where they are.

    Attributes:
        held: the same; its arrays live as long as the reference.
        address: where compiled functions find it.
        kind: Numba's type of the reference.

    Raises:
        TypeError: if a part is anything else.
    """

    def __init__(self, held: Any) -> None:
        self.held = held
        self._words = np.array(list(_words(held)), dtype=np.int64)
        self.address = int(self._words.ctypes.data)
        # To find it takes Numba longer than most functions that a reference is handed to.
        self.kind = ReferenceType(typeof(held))

    def hold(self, held: Any) -> None:
        """Refer to another tuple of the same kind from now on, at the same address."""
        self.held = held
        self._words[:] = list(_words(held))


def _words(value: Any) -> Iterator[int]:
    """What Numba keeps of a value in memory."""
    if isinstance(value, tuple):
        for part in value:
            yield from _words(part)
    elif isinstance(value, np.ndarray):
        # Nobody counts references here.
        yield from (0, 0, value.size, value.itemsize, value.ctypes.data)
        yield from value.shape
        yield from value.strides
    elif isinstance(value, float):
        yield int(np.float64(value).view(np.int64))
    elif isinstance(value, int | np.uintp) and not isinstance(value, bool):
        yield int(value)
    else:
        raise TypeError(f"a reference cannot hold {type(value).__name__}")


def _n_words(kind: Any) -> int:
    """How many words Numba keeps of a value of that type."""
    if hasattr(kind, "instance_class"):
        return sum(_n_words(part) for part in kind.types)
    return 5 + 2 * int(kind.ndim) if hasattr(kind, "ndim") else 1


class ReferenceType(types.Type):
    """The type of a reference.

    Args:
        content: the type of what it holds.

    Attributes:
        content: the same.
        types: the same, for what looks into the parts of types.
    """

    def __init__(self, content: Any) -> None:
        self.content = content
        self.types = (content,)
        super().__init__(name=f"Reference({content})")


@typeof_impl.register(Reference)
def _type_of(value: Reference, context: Any) -> ReferenceType:
    return value.kind


register_model(ReferenceType)(models.OpaqueModel)


@_typed_unbox(ReferenceType)  # type: ignore[untyped-decorator]
def _unbox(kind: Any, value: Any, c: Any) -> Any:
    number = c.pyapi.object_getattr_string(value, "address")
    address = c.pyapi.long_as_ulonglong(number)
    c.pyapi.decref(number)
    native: Any = NativeValue
    return native(c.builder.inttoptr(address, cgutils.voidptr_t))


@infer_getattr
class _Attributes(AttributeTemplate):
    key = ReferenceType

    def generic_resolve(self, kind: Any, name: str) -> Any:  # type: ignore[override]
        fields = kind.content.fields
        return kind.content.types[fields.index(name)] if name in fields else None


@_typed_getattr(ReferenceType)  # type: ignore[untyped-decorator]
def _read(context: Any, builder: Any, kind: Any, address: Any, name: str) -> Any:
    fields, parts = kind.content.fields, kind.content.types
    index = fields.index(name)
    offset = WORD * sum(_n_words(part) for part in parts[:index])
    model = context.data_model_manager[parts[index]]
    pointer_add: Any = cgutils.pointer_add
    place = pointer_add(builder, address, offset, model.get_data_type().as_pointer())
    return model.load_from_data_pointer(builder, place)


def address_of(function: Any, reference: Reference) -> np.uintp:
    """Where the machine code of a compiled function lies, for `call`.

    Args:
        function: of a reference and two floating-point numbers, with a whole number as its result.
        reference: what it is to be called with.
    """
    arguments = reference.kind, types.float64, types.float64
    code = function.get_compile_result(types.int64(*arguments))
    name = code.fndesc.llvm_cfunc_wrapper_name
    return np.uintp(code.library.get_pointer_to_function(name))


@intrinsic
def _call(typing_context: Any, address: Any, reference: Any, first: Any, second: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, reference, *numbers = arguments
        if isinstance(reference.type, ir.IntType):
            reference = builder.inttoptr(reference, cgutils.voidptr_t)
        passed = [reference, *numbers]
        kind = ir.FunctionType(ir.IntType(64), [value.type for value in passed])
        return builder.call(builder.inttoptr(address, kind.as_pointer()), passed)

    return types.int64(types.uintp, reference, types.float64, types.float64), build


# Numba takes the first argument away, which type checkers cannot see.
_call_address: Any = _call


@internal
def call(address: Any, reference: Any, first: float, second: float) -> int:
    """Call what `address_of` has found, with a reference or the address of one."""
    result: int = _call_address(address, reference, first, second)
    return result
