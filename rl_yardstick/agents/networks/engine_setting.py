"""The argument ``engine`` of the library's agents: its conditions, its costs, its effect."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from contextlib import closing
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.dqn.policies import DQNPolicy
from torch import nn
from torch.optim import Optimizer

from rl_yardstick.agents.common.callbacks import (
    EpisodeBudget,
    heeds_rollouts,
    members,
    unknown_callbacks,
)
from rl_yardstick.agents.common.settings import full_signature
from rl_yardstick.agents.compiled.env_states import Numbers, OwnVectors, observed_world
from rl_yardstick.agents.compiled.learning_algorithm import compiled_schedule
from rl_yardstick.agents.compiled.worlds import NotCompilable
from rl_yardstick.agents.networks.engine import (
    Network,
    NetworkEngine,
    NetworkPlayer,
    check_optimizer,
    in_rows,
    network_player,
)
from rl_yardstick.agents.networks.perceptron import Inputs, one_thread


def check_agent(agent: Any) -> None:
    """Raise `NotCompilable` if compiled functions cannot do all that an agent does."""
    if not type(agent).__module__.startswith("rl_yardstick.agents."):
        raise NotCompilable(f"{type(agent).__name__} may do things in Python of its own")
    _check_spaces(agent)
    if agent.device.type != "cpu":
        raise NotCompilable(f"its networks live on {agent.device}")
    kind = type(agent.policy)
    if kind not in {ActorCriticPolicy, DQNPolicy}:
        raise NotCompilable(f"its policy is {kind.__name__}, not a multilayer perceptron")
    extractor = agent.policy.features_extractor_class
    if extractor is not FlattenExtractor:
        raise NotCompilable(f"observations go through {extractor.__name__}")


def _check_spaces(agent: Any) -> None:
    actions, observations = agent.action_space, agent.observation_space
    if not isinstance(actions, spaces.Discrete):
        raise NotCompilable(f"actions are {type(actions).__name__}, not Discrete")
    for space in (actions, observations):
        if isinstance(space, spaces.Discrete) and space.start != 0:
            raise NotCompilable(f"{space} does not begin with 0")
    if isinstance(observations, spaces.Discrete):
        return
    if not isinstance(observations, spaces.Box):
        raise NotCompilable(f"observations are {type(observations).__name__}, not Box or Discrete")
    if is_image_space(observations) or observations.dtype not in (np.float32, np.float64):
        raise NotCompilable(f"observations are of {observations.dtype}")


# The expected time of a training of networks, in the library's loop and in compiled code.
#
# It decides for ``engine: auto`` which of them runs. It depends on the settings only, not on the
# machine or the cache of compiled code: the two draw different random numbers, so the same settings
# and the same seed must always choose the same one.

# Processor seconds, measured on one core with one thread.
# Of the library's loop:
CALL = 0.3e-3  # choosing actions for all environments, and storing the transitions
ENV_STEP = 0.05e-3  # a step of one environment in Python, Monitor on
UPDATE = {"q": 0.8e-3, "policy": 1.0e-3}  # learning from a minibatch: a constant part,
UPDATE_LAYER = {"q": 0.3e-3, "policy": 0.7e-3}  # plus this for each layer,
UPDATE_WEIGHT = 2.2e-10  # plus this for each weight and row of the minibatch
# Of compiled code with a compiled environment:
COMPILED_STEP = 1.5e-6
COMPILED_ROW = 0.15e-6  # a row of a minibatch: a constant part,
COMPILED_WEIGHT = 1.2e-10  # plus this for each weight, without those of one-hot observations

# The time that compiled code must save against the library's loop: about half of the time of
# compiling, which is then recovered with the second training.
WORTH_COMPILING = 5.0
# The assumed length of an episode, for budgets in episodes.
STEPS_OF_EPISODE = 100


@dataclass(frozen=True)
class Work:
    """The work of a training."""

    kind: Literal["q", "policy"]  # ``"q"``, or ``"policy"`` (with a value network, too)
    n_steps: float  # environment steps, over all environments
    n_envs: int  # environments at once
    n_updates: float  # minibatches to learn from
    batch_size: float  # rows of a minibatch
    n_layers: int  # of one network
    n_weights: int  # of all networks that learn
    n_dense_weights: int  # the same without weights of one-hot observations

    @property
    def library_seconds(self) -> float:
        """Processor seconds in the library's loop."""
        update = UPDATE[self.kind] + UPDATE_LAYER[self.kind] * self.n_layers
        update += UPDATE_WEIGHT * self.batch_size * self.n_weights
        return self.n_steps / self.n_envs * CALL + self.n_steps * ENV_STEP + self.n_updates * update

    @property
    def compiled_seconds(self) -> float:
        """Processor seconds in compiled code, without compiling."""
        row = COMPILED_ROW + COMPILED_WEIGHT * self.n_dense_weights
        step = COMPILED_STEP + COMPILED_WEIGHT * self.n_dense_weights
        return self.n_steps * step + self.n_updates * self.batch_size * row


NetworkEngineChoice = Literal["library", "compiled", "auto"]
TOO_SHORT = "so short a training is not worth compiling"


@dataclass(frozen=True)
class EnginePlan:
    """Which engine a training runs on, and why."""

    is_compiled: bool  # whether networks act and learn in compiled code
    reason: str = ""  # why they do not, if that was asked for
    # The compiled environments, and how to read their observations; None if they run in Python.
    world: tuple[Any, Any] | None = None
    in_python: str = ""  # why only the environments run in Python; else empty

    def __str__(self) -> str:
        if not self.is_compiled:
            return f"library: {self.reason}" if self.reason else "library"
        return (
            f"compiled but for the environment: {self.in_python}" if self.in_python else "compiled"
        )


class CompiledNetworks(BaseAlgorithm):
    """An agent of the library that can train on compiled code.

    Args:
        engine: ``"library"`` trains in the library's own loop. ``"compiled"`` trains in compiled
            code (also the environment if its model is known), with the same results except for
            rounding and random numbers; ValueError if that is impossible. ``"auto"`` compiles if it
            can and the training is long enough, by `agents.networks.engine_setting.Work`, which
            depends on settings and budget only.
        args: the library's arguments.
        kwargs: likewise.

    Attributes:
        engine_in_use: the engine of the last training, and the reason.
    """

    __signature__: ClassVar[inspect.Signature]

    rng: np.random.Generator
    # A `QTraining` or a `PolicyTraining`.
    training_kind: ClassVar[Any]

    # Of the current training.
    excluded_from_states = ("_training", "_sharing")
    _own: ClassVar[tuple[str, ...]] = ("engine", "engine_in_use", "rng", "_training", "_sharing")

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.__signature__ = full_signature(cls)

    def __init__(self, *args: Any, engine: NetworkEngineChoice = "library", **kwargs: Any) -> None:
        if engine not in get_args(NetworkEngineChoice):
            engines = ", ".join(get_args(NetworkEngineChoice))
            raise ValueError(f"engine must be one of {engines}, not {engine!r}")
        self.engine: NetworkEngineChoice = engine
        self.engine_in_use = ""
        self._training: Any = None
        self._sharing = False  # whether the library's loop acts and learns by compiled code
        # At the first call these methods import PyTorch's compiler, which takes a second, only to
        # exclude themselves from it; unless they find themselves in this attribute.
        for name in ("add_param_group", "load_state_dict", "state_dict", "zero_grad"):
            method = getattr(getattr(Optimizer, name), "__wrapped__", None)
            if method is not None and not hasattr(method, "__dynamo_disable"):
                setattr(method, "__dynamo_disable", method)  # no name to mangle
        super().__init__(*args, **kwargs)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed the library's generators, and the generator of compiled code."""
        super().set_random_seed(seed)
        (self.rng,) = np.random.default_rng(seed).spawn(1)

    @abstractmethod
    def _check_own(self) -> None:
        """Raise `NotCompilable` for settings of this kind of agent that are not supported."""

    @abstractmethod
    def shared_networks(self, seen: Any) -> tuple[list[Network], list[Network]]:
        """The networks that learn, the acting one first, and their target networks."""

    def greedy_player(self, seen: Any) -> NetworkPlayer:
        """A player with the actions of `predict` on compiled environments, read by ``seen``."""
        space, policy = self.observation_space, self.policy
        policy.set_training_mode(False)  # as `predict` does at each call

        def predicted(inputs: Inputs) -> int:
            shown = inputs.indices if isinstance(seen, Numbers) else inputs.vectors
            observation = np.reshape(shown[0], space.shape or ()).astype(space.dtype)
            tensor, _ = policy.obs_to_tensor(observation[None])
            with th.no_grad():
                return int(policy._predict(tensor, deterministic=True))

        return network_player(self.shared_networks(seen)[0][0], seen, predicted)

    def schedules(self) -> dict[str, Schedule]:
        """The schedules that compiled code evaluates after each step, by name in its record."""
        return {"learning_rate": self.lr_schedule}

    def learn(self, total_timesteps: int, *args: Any, **kwargs: Any) -> Self:
        """Train as the library's ``learn`` does, on the engine of the settings."""
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
            with one_thread():
                self._sharing = True
                try:
                    library.learn(**given.arguments)
                finally:
                    if self._training is not None:
                        self._training.close()
                    self._training, self._sharing = None, False
        else:
            self._learn_compiled(plan.world, **given.arguments)
        return self

    def engine_plan(
        self, total_timesteps: int, callback: Any, engine: NetworkEngineChoice | None = None
    ) -> EnginePlan:
        """The engine that `learn` would use, and the reason."""
        engine = self.engine if engine is None else engine
        if engine == "library":
            return EnginePlan(is_compiled=False)
        try:
            check_agent(self)
            self._check_own()
            check_optimizer(self.policy.optimizer)
            self.shared_networks(self._seen_in_python())
        except NotCompilable as reason:
            return EnginePlan(is_compiled=False, reason=str(reason))
        if engine == "auto":
            work = self.work(total_timesteps, callback)
            if not work.library_seconds - work.compiled_seconds >= WORTH_COMPILING:
                return EnginePlan(is_compiled=False, reason=TOO_SHORT)
        try:
            return EnginePlan(is_compiled=True, world=self._world_for(callback))
        except NotCompilable as reason:
            return EnginePlan(is_compiled=True, in_python=str(reason))

    def work(self, total_timesteps: int, callback: Any = None) -> Work:
        """The work of a training with these arguments of `learn`."""
        steps = float(total_timesteps)
        for each in _each(callback):
            if isinstance(each, EpisodeBudget):
                steps = min(steps, float(each.n_episodes * STEPS_OF_EPISODE))
        networks, steps, n_updates, batch_size = self._planned(steps)
        linears = [[m for m in net.modules() if isinstance(m, nn.Linear)] for net in networks]
        n_weights = sum(layer.weight.numel() for layers in linears for layer in layers)
        is_one_hot = isinstance(self.observation_space, spaces.Discrete)
        by_number = sum(layers[0].weight.numel() for layers in linears if is_one_hot and layers)
        return Work(
            "policy" if len(networks) > 1 else "q",
            steps,
            self.n_envs,
            n_updates,
            batch_size,
            max(len(layers) for layers in linears),
            n_weights,
            n_weights - by_number,
        )

    @abstractmethod
    def _planned(self, n_steps: float) -> tuple[list[nn.Module], float, float, int]:
        """The networks, the steps of whole rollouts, their minibatches, and the rows of one."""

    def _shared_training(self) -> Any:
        """The current training, made at the first rollout.

        Not before, because an interrupted run restores its last state there.
        """
        if self._training is None:
            self._training = self.training_kind(self, self._seen_in_python())
        return self._training

    def _world_for(self, callback: Any) -> tuple[Any, Any]:
        """The environments as compiled code, and how to read their observations."""
        known = isinstance(callback, BaseCallback | list | None)
        unknown = unknown_callbacks(CallbackList(_each(callback))) if known else ["a function"]
        if unknown:
            raise NotCompilable(f"{', '.join(unknown)} must be asked after each step")
        waited_for = [type(each).__name__ for each in _each(callback) if heeds_rollouts(each)]
        if waited_for:
            raise NotCompilable(f"{', '.join(waited_for)} must be asked at each rollout")
        bounds = (getattr(self, name, None) for name in ("clip_range", "clip_range_vf"))
        for schedule in (*self.schedules().values(), *filter(None, bounds)):
            compiled_schedule(schedule)
        assert self.env is not None
        return observed_world(self.env)

    def _seen_in_python(self) -> Any:
        space = self.observation_space
        if isinstance(space, spaces.Discrete):
            return Numbers(int(space.n))
        return OwnVectors(get_flattened_obs_dim(space))

    def _learn_compiled(
        self,
        world: tuple[Any, Any],  # the environments as compiled code, and how to read them
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
            # An interrupted run restores its last state here.
            callback.on_rollout_start()
            with one_thread(), closing(self.training_kind(self, world[1])) as training:
                NetworkEngine(training, world[0], callback, log_interval).run(total_timesteps)
        callback.on_training_end()

    def get_parameters(self) -> dict[str, dict[str, Any]]:
        """As in the library, also during a training."""
        return {name: in_rows(state) for name, state in super().get_parameters().items()}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self._own]


def _each(callback: Any) -> list[BaseCallback]:
    """The callbacks in the argument ``callback`` of `learn`, without functions."""
    if isinstance(callback, BaseCallback):
        return members(callback)
    return [each for one in callback for each in members(one)] if isinstance(callback, list) else []
