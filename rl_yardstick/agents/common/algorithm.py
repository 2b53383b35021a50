"""The base of every hand-written agent: one environment step at a time.

`OnlineAlgorithm` is a Stable-Baselines3 algorithm whose callbacks, logger and Monitor statistics
behave like those of the library's own off-policy algorithms. Each agent adds how it chooses actions
and what it learns from them.
"""

from __future__ import annotations

import inspect
from abc import abstractmethod
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar, Self, cast

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecEnv

from rl_yardstick.agents.common.given_spaces import OriginalSpaces
from rl_yardstick.agents.common.model_files import JsonAlgorithm
from rl_yardstick.agents.common.settings import CheckedConstructor, full_signature
from rl_yardstick.envs.wrappers import numbered
from rl_yardstick.mdp.transition_model import Bools, Floats


@dataclass(slots=True)
class Transitions:
    """One step of every environment."""

    obs: Any  # observations before the step, shape (n_envs, ...)
    actions: Any  # actions taken, shape (n_envs, ...)
    rewards: Floats  # float64 of shape (n_envs,)
    terminated: Bools  # the episode ended for good, bool of shape (n_envs,)
    dones: Bools  # it ended for good or was truncated, bool of shape (n_envs,)
    next_obs: Any  # observations after the step, before any reset, shape (n_envs, ...)


class OnlineAlgorithm(JsonAlgorithm, metaclass=CheckedConstructor):
    """Acts and learns one step at a time, with its own random generators.

    Subclasses define `_choose_actions`; those that learn override `_learn_from`.

    Args:
        policy: name of the policy.
        env: environment, or its id.
        learning_rate: step size, constant or scheduled.
        policy_kwargs: further arguments of the policy.
        stats_window_size: episodes over which logged statistics are averaged.
        tensorboard_log: folder for TensorBoard, or None.
        verbose: 0 silent, 1 information.
        seed: seeds the agent's generators, its action space and its environments.
        device: not used, as tables live on the CPU.
        supported_action_spaces: classes of the spaces that the agent can act in; None for all.
    """

    # Of agents on tables, which number other finite spaces: what they observe as it is.
    observed: ClassVar[tuple[str, ...]] = ()

    __signature__: ClassVar[inspect.Signature]
    hidden_arguments: ClassVar[tuple[str, ...]] = ()  # see `full_signature`

    rng: np.random.Generator
    predict_rng: np.random.Generator

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.__signature__ = full_signature(cls)

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = 0.0,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "cpu",
        supported_action_spaces: tuple[type[spaces.Space[Any]], ...] | None = None,
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device="cpu",
            support_multi_env=True,
            seed=seed,
            supported_action_spaces=supported_action_spaces,
        )
        self.use_spaces_of(env)
        if _init_setup_model:
            self._setup_model()

    @classmethod
    def _wrap_env(cls, env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """As the library; members of finite spaces are numbered, for an agent on tables."""
        if cls.observed and isinstance(env, gym.Env):
            env = numbered(env, cls.observed, ("Discrete",))
        return JsonAlgorithm._wrap_env(env, verbose, monitor_wrapper)

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.policy_class(self.observation_space, self.action_space)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As the library; `predict` then uses the spaces of this environment."""
        super().set_env(env, force_reset)
        self.use_spaces_of(env)

    def get_env(self) -> VecEnv | None:
        """The training environments, with the observations and actions that `predict` uses."""
        if self.env is None or self.translation is None:
            return self.env
        return OriginalSpaces(self.env, self.original_spaces, self.translation)

    @abstractmethod
    def _choose_actions(self) -> NDArray[Any]:
        """Choose actions for `_last_obs`, shape (n_envs, ...)."""

    def _begin_episodes(self) -> None:
        """Drop the state of running episodes: all environments are about to be reset."""

    def _learn_from(self, transitions: Transitions) -> None:
        """Learn from one step of every environment; by default, learn nothing."""

    def _record_training(self) -> None:
        """Pass the agent's own figures to the logger, just before the logger writes."""

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 100,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for at least ``total_timesteps`` environment steps.

        Arguments are the library's. Steps are counted over all environments; ``log_interval`` is in
        episodes, None for no log; ``tb_log_name`` is the class's name by default.
        """
        tb_log_name = tb_log_name or type(self).__name__
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        self._run(total_timesteps, callback, log_interval)
        callback.on_training_end()
        return self

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps or self._last_obs is None:
            self._begin_episodes()
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        # As in the library, a training of 0 steps does nothing and is no error.
        self._update_current_progress_remaining(self.num_timesteps, max(self._total_timesteps, 1))
        return total_timesteps, callback

    def _run(self, total_timesteps: int, callback: BaseCallback, log_interval: int | None) -> None:
        """Step until ``total_timesteps`` is reached or a callback asks to stop."""
        while self.num_timesteps < total_timesteps and self._step(callback, log_interval):
            pass

    def _step(self, callback: BaseCallback, log_interval: int | None) -> bool:
        """Act, tell the callbacks, learn; False once a callback asks to stop.

        The order is that of the library's off-policy algorithms. Unlike them, the agent learns from
        the last transition even if a callback stops the training there.
        """
        assert self.env is not None
        callback.on_rollout_start()
        obs, actions = self._last_obs, self._choose_actions()
        new_obs, rewards, dones, infos = self.env.step(actions)
        self.num_timesteps += self.env.num_envs

        # Written out, because `locals()` would take longer than all callbacks together.
        callback.update_locals(
            {
                "obs": obs,
                "actions": actions,
                "new_obs": new_obs,
                "rewards": rewards,
                "dones": dones,
                "infos": infos,
            }
        )
        keep_going = callback.on_step()

        self._update_info_buffer(infos, dones)
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        finished = dones.tolist().count(True)
        next_obs, terminated = true_outcome(new_obs, dones, infos) if finished else (new_obs, dones)
        self._learn_from(
            Transitions(obs, actions, rewards.astype(np.float64), terminated, dones, next_obs)
        )
        self._last_obs = cast(Any, new_obs)
        if finished:
            self._count_episodes(finished, log_interval)
        callback.on_rollout_end()
        return keep_going

    def _count_episodes(self, finished: int, log_interval: int | None) -> None:
        before = self._episode_num
        self._episode_num += finished
        if log_interval is not None and self._episode_num // log_interval > before // log_interval:
            self.dump_logs()

    def dump_logs(self) -> None:
        """Write the log: episode statistics, speed, and what the agent records.

        If nothing reads the log, this computes nothing. It still clears the recorded values, as
        writing them would.
        """
        if not self.logger.output_formats:
            self.logger.dump(self.num_timesteps)
            return
        self._record_training()
        OffPolicyAlgorithm.dump_logs(cast(OffPolicyAlgorithm, self))

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed the agent's generators, its action space and its environments.

        It does not seed the global generators of NumPy, Python and torch, because no hand-written
        agent draws from them.
        """
        self.rng, self.predict_rng = np.random.default_rng(seed).spawn(2)
        if seed is None:
            return
        self.action_space.seed(seed)
        if self.env is not None:
            self.env.seed(seed)


def true_outcome(new_obs: Any, dones: Bools, infos: list[dict[str, Any]]) -> tuple[Any, Bools]:
    """The observations before any reset, and whether each environment had terminated.

    A VecEnv resets a finished environment within the same step.
    """
    terminated = dones.copy()
    next_obs = deepcopy(new_obs)
    for i in np.flatnonzero(dones):
        terminated[i] = not infos[i].get("TimeLimit.truncated", False)
        last_obs = infos[i]["terminal_observation"]
        if isinstance(next_obs, dict):
            for key in next_obs:
                next_obs[key][i] = last_obs[key]
        else:
            next_obs[i] = last_obs
    return next_obs, terminated
