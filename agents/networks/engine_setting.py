"""The argument ``engine`` of the library's agents, and what it does to their training."""

from __future__ import annotations

import inspect
import sys
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal, Self

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.type_aliases import Schedule
from torch.optim import Optimizer

from agents.common.callback_horizons import EpisodeBudget, members, unknown_callbacks
from agents.common.setting_checks import check_option
from agents.compiled.compile_envs import NotCompilable
from agents.compiled.learning_algorithm import compiled_schedule
from agents.networks.engine_costs import STEPS_OF_EPISODE, Work
from agents.networks.library_networks import Network
from agents.networks.matrix_products import one_thread
from agents.networks.network_engine import NetworkEngine
from agents.networks.network_playing import NetworkPlayer, network_player
from agents.networks.network_training import NetworkTraining
from agents.networks.network_worlds import network_world
from agents.networks.observations import Numbers, OwnVectors
from agents.networks.perceptron import Inputs
from agents.networks.rollout_events import RolloutEvents
from agents.networks.shared_tensors import in_rows

NetworkEngineChoice = Literal["library", "compiled", "auto"]
TOO_SHORT = "so short a training is not worth compiling"
# Where PyTorch's ``_disable_dynamo`` keeps a method that the compiler leaves alone.
_KEPT_OUT = "__dynamo_disable"


def do_without_torch_compiler() -> None:
    """Let optimizers be made, saved and loaded without importing PyTorch's compiler.

    Their methods import it at their first call, to keep it out of them; that takes a second. As
    long as nobody else has imported it there is nothing to keep out. ``step`` imports it anyway.
    """
    for name in ("add_param_group", "load_state_dict", "state_dict", "zero_grad"):
        method = getattr(getattr(Optimizer, name), "__wrapped__", None)
        if method is not None and not hasattr(method, _KEPT_OUT):
            setattr(method, _KEPT_OUT, partial(_call_without_compiler, name, method))


def _call_without_compiler(
    name: str, method: Any, optimizer: Optimizer, *args: Any, **kwargs: Any
) -> Any:
    if "torch._dynamo" not in sys.modules:
        return method(optimizer, *args, **kwargs)
    if hasattr(method, _KEPT_OUT):
        delattr(method, _KEPT_OUT)
    return getattr(Optimizer, name)(optimizer, *args, **kwargs)


@dataclass(frozen=True)
class EnginePlan:
    """Which engine a training runs on, and why.

    Attributes:
        is_compiled: whether networks act and learn in compiled code, and not in the library's loop.
        reason: why they do not although that would do; empty where nobody asked for it.
        world: the compiled environments, and how networks see them; None where they run in Python.
        in_python: why they do; empty where they do not, or nothing is compiled.
    """

    is_compiled: bool
    reason: str = ""
    world: tuple[Any, Any] | None = None
    in_python: str = ""

    def __str__(self) -> str:
        if not self.is_compiled:
            return f"library: {self.reason}" if self.reason else "library"
        return (
            f"compiled but for the environment: {self.in_python}" if self.in_python else "compiled"
        )


class CompiledNetworks(BaseAlgorithm):
    """An agent of the library that can train on compiled code.

    Args:
        engine: ``"library"`` trains in the library's own loop; ``"compiled"`` in compiled code, the
            environment too where its model is known, to the same results but for rounding and
            random numbers, and is refused where that cannot be; ``"auto"`` compiles where it can
            and the training is long enough, by `agents.networks.engine_costs.Work`, which goes by
            settings and budget alone.
        args: the library's arguments.
        kwargs: likewise.

    Attributes:
        engine_in_use: what the last training ran on, and why.
    """

    rng: np.random.Generator

    # Of the training under way.
    excluded_from_states = ("_training", "_sharing")
    _own: ClassVar[tuple[str, ...]] = ("engine", "engine_in_use", "rng", "_training", "_sharing")

    def __init__(self, *args: Any, engine: NetworkEngineChoice = "library", **kwargs: Any) -> None:
        check_option("engine", engine, NetworkEngineChoice)
        self.engine: NetworkEngineChoice = engine
        self.engine_in_use = ""
        self._training: Any = None
        self._sharing: ExitStack | None = None
        do_without_torch_compiler()
        super().__init__(*args, **kwargs)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed the library's generators, and that of compiled code."""
        super().set_random_seed(seed)
        (self.rng,) = np.random.default_rng(seed).spawn(1)

    @abstractmethod
    def _check_compilable(self) -> None:
        """Raise `NotCompilable` where compiled code does not do all that the agent does."""

    @property
    @abstractmethod
    def is_within_rollout(self) -> bool:
        """Whether the compiled loop has a rollout under way."""

    @abstractmethod
    def _compiled_training(self, seen: Any) -> AbstractContextManager[NetworkTraining]:
        """Let the agent and compiled code share memory for a while."""

    @abstractmethod
    def _acting_network(self, seen: Any) -> Network:
        """The network whose largest output is the best action."""

    def greedy_player(self, seen: Any) -> NetworkPlayer:
        """What plays as `predict` does on compiled environments.

        Args:
            seen: how observations are read, of `agents.networks.observations`.
        """
        space = self.observation_space

        def predicted(inputs: Inputs) -> int:
            shown = inputs.indices if isinstance(seen, Numbers) else inputs.vectors
            observation = np.reshape(shown[0], space.shape or ()).astype(space.dtype)
            actions, _ = self.predict(observation[None], deterministic=True)
            return int(actions[0])

        return network_player(self._acting_network(seen), seen, predicted)

    def _schedules(self) -> list[Schedule]:
        """What a training in the compiled loop works out by itself."""
        return [self.lr_schedule]

    def learn(self, total_timesteps: int, *args: Any, **kwargs: Any) -> Self:
        """Train as the library's ``learn`` does, on the engine that was asked for."""
        library: Any = super()
        given = inspect.signature(library.learn).bind(total_timesteps, *args, **kwargs)
        given.apply_defaults()
        plan = self.engine_plan(total_timesteps, given.arguments["callback"])
        if self.engine == "compiled" and not plan.is_compiled:
            raise ValueError(f"engine: compiled is not possible: {plan.reason}")
        self.engine_in_use = str(plan)
        if not plan.is_compiled:
            library.learn(**given.arguments)
        elif plan.world is None:
            with self._learning_compiled():
                library.learn(**given.arguments)
        else:
            self._learn_compiled(*plan.world, **given.arguments)
        return self

    def engine_plan(
        self, total_timesteps: int, callback: Any, engine: NetworkEngineChoice | None = None
    ) -> EnginePlan:
        """Which engine `learn` would run on, and why.

        Args:
            total_timesteps: its argument.
            callback: likewise.
            engine: as if the agent had this one.
        """
        engine = self.engine if engine is None else engine
        if engine == "library":
            return EnginePlan(is_compiled=False)
        try:
            self._check_compilable()
        except NotCompilable as reason:
            return EnginePlan(is_compiled=False, reason=str(reason))
        if engine == "auto" and not self.work(total_timesteps, callback).is_worth_compiling:
            return EnginePlan(
                is_compiled=False, reason="so short a training is not worth compiling"
            )
        try:
            return EnginePlan(is_compiled=True, world=self._world_for(callback))
        except NotCompilable as reason:
            return EnginePlan(is_compiled=True, in_python=str(reason))

    def work(self, total_timesteps: int, callback: Any = None) -> Work:
        """What a training with these arguments of `learn` does."""
        steps = float(total_timesteps)
        for each in _each(callback):
            if isinstance(each, EpisodeBudget):
                steps = min(steps, float(each.n_episodes * STEPS_OF_EPISODE))
        return self._work_of(steps)

    @abstractmethod
    def _work_of(self, n_steps: float) -> Work:
        """What a training of so many steps does."""

    @contextmanager
    def _learning_compiled(self) -> Iterator[None]:
        """Let the library's loop act and learn by compiled code."""
        with one_thread(), ExitStack() as sharing:
            self._sharing = sharing
            try:
                yield
            finally:
                self._sharing = self._training = None

    def _shared_training(self) -> NetworkTraining:
        """The training under way, which begins with the first rollout.

        Not before: a run that was cut off goes back to its last state there.
        """
        if self._training is None:
            assert self._sharing is not None
            training = self._compiled_training(self._seen_in_python())
            self._training = self._sharing.enter_context(training)
        training_now: NetworkTraining = self._training
        return training_now

    def _world_for(self, callback: Any) -> tuple[Any, Any]:
        """The environments as compiled code, and how networks see them.

        Raises:
            NotCompilable: if they have to be called step by step.
        """
        known = isinstance(callback, BaseCallback | list | None)
        unknown = unknown_callbacks(CallbackList(_each(callback))) if known else ["a function"]
        if unknown:
            raise NotCompilable(f"{', '.join(unknown)} must be asked after each step")
        for schedule in self._schedules():
            compiled_schedule(schedule)
        assert self.env is not None
        return network_world(self.env)

    def _seen_in_python(self) -> Any:
        space = self.observation_space
        if isinstance(space, spaces.Discrete):
            return Numbers(int(space.n))
        return OwnVectors(get_flattened_obs_dim(space))

    def _learn_compiled(
        self,
        world: Any,
        seen: Any,
        total_timesteps: int,
        callback: Any,
        log_interval: int | None,
        tb_log_name: str,
        reset_num_timesteps: bool,
        progress_bar: bool,
    ) -> None:
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        if self.num_timesteps < total_timesteps:
            # A run that was cut off goes back to its last state here.
            RolloutEvents(self, callback).begin()
            with one_thread(), self._compiled_training(seen) as training:
                NetworkEngine(training, world, callback, log_interval).run(total_timesteps)
        callback.on_training_end()

    def get_parameters(self) -> dict[str, dict[str, Any]]:
        """As the library's, also in the middle of a training."""
        return {name: in_rows(state) for name, state in super().get_parameters().items()}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self._own]


def _each(callback: Any) -> list[BaseCallback]:
    """The callbacks in what `learn` takes as ``callback``; a function is none of them."""
    if isinstance(callback, BaseCallback):
        return members(callback)
    return [each for one in callback for each in members(one)] if isinstance(callback, list) else []
