"""Trains and plays agents of the library on the compiled loop, in the memory of their networks."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn

from rl_yardstick.agents.common.callbacks import Horizon
from rl_yardstick.agents.common.exploration import greedy_action
from rl_yardstick.agents.compiled.engine import CompiledEngine
from rl_yardstick.agents.compiled.env_states import BEFORE, Numbers, look
from rl_yardstick.agents.compiled.learning_algorithm import compiled_schedule
from rl_yardstick.agents.compiled.references import Reference, address_of, call, handles_of
from rl_yardstick.agents.compiled.worlds import NotCompilable
from rl_yardstick.agents.networks.perceptron import (
    ADAM,
    ADAMW,
    IDENTITY,
    RELU,
    RMSPROP,
    RMSPROP_TENSORFLOW,
    TANH,
    Inputs,
    Layers,
    Optimizer,
    Singles,
    forward,
    last_outputs,
    make_inputs,
    make_layers,
    make_outputs,
    n_parameters,
    outputs_of,
    weights_of,
)
from rl_yardstick.machine_code.compiling import inlined, kernel

_ACTIVATIONS: dict[type[nn.Module], int] = {nn.Identity: IDENTITY, nn.ReLU: RELU, nn.Tanh: TANH}

# The values that settings of optimizers must have if compiled steps do not support them.
_PLAIN = {"amsgrad": False, "maximize": False, "momentum": 0, "centered": False}
_OPTIMIZERS = {th.optim.Adam, th.optim.AdamW, th.optim.RMSprop, RMSpropTFLike}


@dataclass(frozen=True)
class Network:
    """A perceptron of the library: its layers in order, and their shape for compiled code."""

    linears: Sequence[nn.Linear]
    layers: Layers

    @property
    def parameters(self) -> list[th.Tensor]:
        """The weights and biases, in the order of the flat vector."""
        return [p for linear in self.linears for p in (linear.weight, linear.bias)]


def network_of(modules: Iterable[nn.Module], start: int, *, one_hot: bool) -> Network:
    """The perceptron of these modules: linear layers with one activation function in between.

    Its parameters begin at ``start`` of the flat vector. Raises NotCompilable for other modules.
    """
    linears: list[nn.Linear] = []
    functions: list[int] = []
    for module in modules:
        if type(module) is nn.Linear and module.bias is not None:
            if len(linears) != len(functions):
                raise NotCompilable("a network has linear layers without a function in between")
            linears.append(module)
        elif len(functions) == len(linears) - 1 and type(module) in _ACTIVATIONS:
            functions.append(_ACTIVATIONS[type(module)])
        else:
            raise NotCompilable(f"a network has a layer of {type(module).__name__}")
    if len(set(functions)) > 1:
        raise NotCompilable("a network has several activation functions")
    if len(functions) != len(linears) - 1:
        raise NotCompilable("a network ends with an activation function")
    sizes = [linears[0].in_features, *(linear.out_features for linear in linears)]
    activation = functions[0] if functions else IDENTITY
    return Network(linears, make_layers(sizes, start, activation, one_hot=one_hot))


def check_optimizer(optimizer: th.optim.Optimizer) -> None:
    """Raise `NotCompilable` if compiled steps would differ from those of the optimizer."""
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


# While an agent trains, its tensors are views of flat vectors, so callbacks can read and change
# the parameters at any time. Afterwards the tensors have their own memory again, in PyTorch's
# layout.


class FlatTensors:
    """A flat vector of networks' parameters, with a view of it for each parameter."""

    def __init__(self, networks: Sequence[Network]) -> None:
        self.vector: Singles = np.zeros(sum(n_parameters(n.layers) for n in networks), np.float32)
        self.places: list[tuple[th.Tensor, th.Tensor]] = []
        begin = 0
        for parameter in (p for network in networks for p in network.parameters):
            end = begin + parameter.numel()
            # Compiled code stores weights as (inputs, outputs).
            turned = self.vector[begin:end].reshape(tuple(parameter.shape)[::-1])
            self.places.append((parameter, th.from_numpy(turned.T)))
            begin = end

    def take_over(self) -> None:
        """Move parameters into the vector, e.g. after a callback has replaced them."""
        for parameter, place in self.places:
            if parameter.data_ptr() != place.data_ptr():
                place.copy_(parameter.data)
                parameter.data = place

    def give_back(self) -> None:
        """Give the parameters their own memory again."""
        for parameter, _ in self.places:
            parameter.data = parameter.data.clone(memory_format=th.contiguous_format)


class SharedOptimizer:
    """The state of a policy's optimizer for the networks' parameters, in flat vectors."""

    def __init__(self, policy: Any, networks: Sequence[Network]) -> None:
        self.parameters = [p for network in networks for p in network.parameters]
        self.optimizer = policy.optimizer
        known: Any = self.optimizer.state
        kind, names = _kind(self.optimizer)
        means = {name: FlatTensors(networks) for name in names}
        n_steps = np.zeros(1, np.float32)
        if self.parameters[0] in known:
            n_steps[0] = float(known[self.parameters[0]]["step"])
        # As in the library, the mean of squares of RMSpropTFLike begins with ones.
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

    def give_back(self) -> None:
        """Give its state its own memory again; without a step, it has no state."""
        known: Any = self.optimizer.state
        kind, _ = _kind(self.optimizer)
        remembered = [parameter for parameter in self.parameters if parameter in known]
        for parameter in remembered:
            state = dict(known[parameter])
            for name, value in state.items():
                if isinstance(value, th.Tensor):
                    state[name] = value.clone(memory_format=th.contiguous_format)
            if kind == RMSPROP_TENSORFLOW:
                state["step"] = int(state["step"])
            known[parameter] = state
        if not any(known[parameter]["step"] for parameter in remembered):
            known.clear()


def in_rows(state: Any) -> Any:
    """A copy of a ``state_dict`` with contiguous tensors, as in the library."""
    if isinstance(state, dict):
        copied = copy(state)
        copied.update({name: in_rows(value) for name, value in state.items()})
        return copied
    return state.contiguous() if isinstance(state, th.Tensor) else state


def _kind(optimizer: th.optim.Optimizer) -> tuple[int, tuple[str, ...]]:
    """The kind of the optimizer here, and PyTorch's names of its running means."""
    if isinstance(optimizer, th.optim.Adam):
        decoupled = optimizer.param_groups[0]["decoupled_weight_decay"]
        return ADAMW if decoupled else ADAM, ("exp_avg", "exp_avg_sq")
    if isinstance(optimizer, RMSpropTFLike):
        return RMSPROP_TENSORFLOW, ("square_avg",)
    return RMSPROP, ("square_avg",)


# A placeholder of an address, until there is a reference to the learner.
NOWHERE = np.uintp(0)


class NetworkTraining:
    """An agent of the library in training, with its networks in the memory of compiled code.

    The base of `QTraining` and `PolicyTraining`, which make the learner.
    """

    held: Any  # the learner for compiled functions
    learner: Reference  # the same by reference

    def __init__(self, agent: Any, seen: Any) -> None:
        self.agent = agent
        self.seen = seen  # how to read observations of compiled environments
        # Kept here, because its handle does not keep it alive.
        self.generator = agent.rng
        self.networks, lagging = agent.shared_networks(seen)
        self.trained, self.lagging = FlatTensors(self.networks), FlatTensors(lagging)
        self.trained.take_over()
        self.lagging.take_over()
        self.optimizer = SharedOptimizer(agent.policy, self.networks)
        # Observations of environments in Python.
        width = 1 if isinstance(seen, Numbers) else int(self.networks[0].layers.sizes[0])
        self.shown = np.zeros((agent.n_envs, width))

    def close(self) -> None:
        """Give networks and optimizer their own memory again."""
        for part in (self.trained, self.lagging, self.optimizer):
            part.give_back()

    def begin(self, held: Any, improve: Callable[[Any, float, float], int]) -> None:
        """Set the learner, and its compiled function that learns from a minibatch."""
        self.learner = Reference(held)
        self.held = held._replace(improve=address_of(improve, self.learner))
        self.learner.hold(self.held)

    def read_tensors(self) -> None:
        """Use the agent's generator and weights, which a callback may have replaced."""
        if self.agent.rng is not self.generator:
            self.generator = self.agent.rng
            self.held.rng[:] = handles_of([self.generator])
        self.trained.take_over()
        self.lagging.take_over()

    def show(self, observations: Any) -> None:
        """Copy and check observations of environments in Python."""
        self.shown[:] = np.reshape(observations, self.shown.shape)
        self.check_numbers(self.shown)

    def check_numbers(self, shown: Any) -> None:
        """Raise ValueError for numbers of states outside their space."""
        if isinstance(self.seen, Numbers) and not (shown.min() >= 0 and shown.max() < self.seen.n):
            wrong = int(shown[(shown < 0) | (shown >= self.seen.n)][0])
            raise ValueError(f"observation {wrong} is not in {self.agent.observation_space}")


def record_of(kind: np.dtype[np.void], agent: Any = None, **values: Any) -> Any:
    """An array of shape (1,) with one record: of values, else the agent's attributes, else 0."""
    records = np.zeros(1, dtype=kind)
    for name in kind.names or ():
        records[name] = values.get(name, getattr(agent, name, 0))
    return records


# Between two blocks Python handles signals, and displays are updated.
SECONDS_PER_BLOCK = 0.2


class NetworkEngine(CompiledEngine):
    """One call of ``learn`` on the compiled loop."""

    counts_where_stopped = False  # as in the library

    def __init__(
        self,
        training: Any,  # a `QTraining` or a `PolicyTraining`
        world: Any,
        callback: BaseCallback,
        log_interval: int | None,
    ) -> None:
        self.training = training
        self.steps_at_once = 1
        self.has_begun = False
        self.in_loop = training.in_loop()
        # With rollouts of a fixed length, a budget of episodes does not change schedules.
        self.total_timesteps = training.agent._total_timesteps
        super().__init__(training.agent, (world, training.seen), callback, log_interval)

    def _learner(self) -> Any:
        for name, schedule in self.agent.schedules().items():
            self.progress[0][f"{name}_schedule"] = compiled_schedule(schedule)
        self.training.read_settings()
        return self.in_loop

    def _steps_left(self, total_timesteps: int) -> int:
        # As in the library, the current rollout is collected to its end.
        return int(self.training.until_end(super()._steps_left(total_timesteps)))

    def _begin_block(self) -> None:
        if self.has_begun:
            super()._begin_block()
        # Before the first block, callbacks have been called already.
        self.has_begun = True

    def _limit(self, total_timesteps: int) -> Horizon:
        limit = super()._limit(total_timesteps)
        log = self.training.until_log(self.log_interval)
        steps = min(limit.calls, log.calls, self.steps_at_once)
        return Horizon(max(steps, 1), min(limit.episodes, log.episodes))

    def _step(self, limit: Horizon) -> int:
        began = time.perf_counter()
        n_steps = super()._step(limit)
        # Adapt the maximal length of a block; results do not depend on it.
        fitting = n_steps * SECONDS_PER_BLOCK / max(time.perf_counter() - began, 1e-6)
        self.steps_at_once = max(1, min(int(fitting), 4 * self.steps_at_once))
        return n_steps

    def _learn_from_last(self, n_episodes: int, keep_going: bool) -> None:
        if not keep_going:
            # As in the library, the agent does not learn from the last step and its rollout.
            for count in self.training.rollout_counts:
                self.training.place[count] = 0
            return
        super()._learn_from_last(n_episodes, keep_going)
        self.training.record()

    @property
    def _log_count(self) -> int:
        """The number of episodes, or of rollouts."""
        if self.training.goes_by_episodes:
            return super()._log_count
        return int(self.training.place["n_rollouts"][0])

    def _write_log(self) -> None:
        counted = () if self.training.goes_by_episodes else (self._log_count,)
        self.agent.dump_logs(*counted)

    def _take_over_counts(self, n_steps: int, n_episodes: int) -> None:
        # Agents with rollouts of a fixed length have the share after the last rollout.
        by_episodes = self.training.goes_by_episodes
        place = self.progress if by_episodes else self.training.place
        self.agent._current_progress_remaining = float(place["remaining"][0])
        self._take_over_position()
        if by_episodes:
            self.agent._episode_num += n_episodes

    def _take_over_position(self) -> None:
        self.agent._last_obs = self.states.observations(self.envs, "")
        self.training.write()

    def _read_agent(self) -> None:
        if not self.training.goes_by_episodes:
            self.progress["total_timesteps"] = self.total_timesteps
            self.progress["episode_budget"] = 0
        self.training.read()


# The best output must be ahead by this share of the sum of magnitudes (ten times the rounding error
# with 64 to 400 units), and by at least this much, because PyTorch compares probabilities.
CLEARLY, AT_LEAST = 4e-6, 1e-6

_ASKED = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_double, ctypes.c_double)


class GreedyNetwork(NamedTuple):
    """A network whose largest output is the best action, by reference."""

    layers: Layers  # its shape
    flat: Singles  # its parameters
    single: Inputs  # buffer for one observation
    single_outputs: Singles  # buffer for its outputs
    ask: np.uintp  # the address of the function that chooses if two actions are close


@kernel
def choose_surely(network: Any, _: float, __: float) -> int:
    """The best action for the observation in ``network.single``."""
    forward(network.layers, network.flat, network.single, 1, network.single_outputs)
    outputs = last_outputs(network.layers, network.single_outputs, 1)[0]
    best, unsure = greedy_action(outputs, 0.0), _unsure(network, outputs)
    for k in range(len(outputs)):
        # With nan the comparison is False, too.
        if k != best and not outputs[best] - outputs[k] > unsure:
            return call(network.ask, network, 0.0, 0.0)
    return best


@inlined
def _unsure(network: Any, outputs: Singles) -> float:
    """The largest difference of two outputs at which rounding may decide."""
    layers, last, most = network.layers, len(network.layers.sizes) - 2, 0.0
    weights = weights_of(layers, network.flat, last)
    for k in range(len(outputs)):
        added = abs(outputs[k])
        if last > 0:
            below = outputs_of(layers, network.single_outputs, last - 1, 1)[0]
            for j in range(len(below)):
                added += abs(below[j] * weights[j, k])
        most = max(most, added)
    return max(CLEARLY * most, AT_LEAST)


class AskingNetwork(Reference):
    """A reference to a `GreedyNetwork`, which calls ``predict`` if two actions are close."""

    def __init__(self, layers: Layers, flat: Singles, predict: Callable[[Inputs], int]) -> None:
        self.predict = predict
        # Exceptions of `predict`, which cannot pass through compiled code.
        self.errors: list[BaseException] = []
        # Kept here, because compiled code does not keep it alive.
        self._called = _ASKED(self._answer)
        ask = np.uintp(ctypes.cast(self._called, ctypes.c_void_p).value or 0)
        inputs, outputs = make_inputs(layers, 1), make_outputs(layers, 1)
        super().__init__(GreedyNetwork(layers, flat, inputs, outputs, ask))

    def _answer(self, _: int | None, __: float, ___: float) -> int:
        if self.errors:
            return 0
        try:
            return self.predict(self.held.single)
        except BaseException as error:  # noqa: BLE001  # raised once compiled code has returned
            self.errors.append(error)
            return 0


class NetworkPlayer(NamedTuple):
    """The agent for the compiled loop."""

    network: Any  # an `AskingNetwork`
    seen: Any  # how observations are read, of `agents.compiled.env_states`
    choose: np.uintp  # the address of `choose_surely`

    @inlined
    def act(self, env: Any, progress: Any) -> None:
        """Take the best action."""
        look(self.seen, env, BEFORE, self.network.single, self.network.layers.one_hot)
        env.action = call(self.choose, self.network, 0.0, 0.0)

    def check(self) -> None:
        """Raise the exception of the library's `predict`, if there was one."""
        if errors := self.network.errors:
            raise errors.pop()


def network_player(network: Network, seen: Any, predict: Callable[[Inputs], int]) -> NetworkPlayer:
    """A player with a copy of a network's present parameters."""
    tensors = FlatTensors([network])
    with th.no_grad():
        for parameter, place in tensors.places:
            place.copy_(parameter)
    asking = AskingNetwork(network.layers, tensors.vector, predict)
    return NetworkPlayer(asking, seen, address_of(choose_surely, asking))
