"""The argument ``engine`` of the library's agents, and what it does to their training."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any, ClassVar, Literal, Self

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.type_aliases import Schedule

from agents.common.callback_horizons import unknown_callbacks
from agents.common.setting_checks import check_option
from agents.compiled.compile_envs import NotCompilable
from agents.compiled.learning_algorithm import compiled_schedule
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


class CompiledNetworks(BaseAlgorithm):
    """An agent of the library that can train on compiled code.

    Args:
        engine: ``"library"`` trains in the library's own loop; ``"compiled"`` in compiled code, the
            environment too where its model is known, to the same results but for rounding and
            random numbers, and is refused where that cannot be; ``"auto"`` compiles where it can.
        args: the library's arguments.
        kwargs: likewise.

    Attributes:
        engine_in_use: what the last training ran on, and why.
    """

    rng: np.random.Generator

    # Of the training under way.
    not_in_snapshots = ("_training", "_sharing")
    _own: ClassVar[tuple[str, ...]] = ("engine", "engine_in_use", "rng", "_training", "_sharing")

    def __init__(self, *args: Any, engine: NetworkEngineChoice = "library", **kwargs: Any) -> None:
        check_option("engine", engine, NetworkEngineChoice)
        self.engine = engine
        self.engine_in_use = ""
        self._training: Any = None
        self._sharing: ExitStack | None = None
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
        if not self._takes_compiled():
            library.learn(total_timesteps, *args, **kwargs)
            return self
        given = inspect.signature(library.learn).bind(total_timesteps, *args, **kwargs)
        given.apply_defaults()
        try:
            world, seen = self._world_for(given.arguments["callback"])
        except NotCompilable as reason:
            self.engine_in_use = f"compiled but for the environment: {reason}"
            with self._learning_compiled():
                library.learn(**given.arguments)
        else:
            self.engine_in_use = "compiled"
            self._learn_compiled(world, seen, **given.arguments)
        return self

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

    def _takes_compiled(self) -> bool:
        if self.engine == "library":
            self.engine_in_use = "library"
            return False
        try:
            self._check_compilable()
        except NotCompilable as reason:
            if self.engine == "compiled":
                raise ValueError(f"engine: compiled is not possible: {reason}") from None
            self.engine_in_use = f"library: {reason}"
            return False
        return True

    def _world_for(self, callback: Any) -> tuple[Any, Any]:
        """The environments as compiled code, and how networks see them.

        Raises:
            NotCompilable: if they have to be called step by step.
        """
        if isinstance(callback, list):
            callback = CallbackList(callback)
        if callback is not None:
            known = isinstance(callback, BaseCallback)
            unknown = unknown_callbacks(callback) if known else ["a function"]
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
