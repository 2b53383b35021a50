"""What all bandit agents share: pulling arms, waiting for feedback, learning from it."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule

from agents.bandits.arguments import (
    TieBreaking,
    check_option,
    check_space,
    full_signature,
)
from agents.bandits.rewards import ANY, check_kinds, check_reward
from agents.common.online import OnlineAlgorithm, Transitions
from agents.common.step_sizes import SAMPLE_AVERAGE


class Pull(NamedTuple):
    """A pull and its reward, kept until the feedback is due.

    Attributes:
        context: what the arm was chosen in: a row of the tables, or a list of features.
        arm: what was pulled.
        reward: what it gave.
        probability: how likely the choice was, for the rules that need to know; else 1.
    """

    context: Any
    arm: int
    reward: float
    probability: float


class BanditAlgorithm(OnlineAlgorithm):
    """Learns which arm is best in a context, as if what it does changed nothing later.

    Where the environment's ``info`` says ``feedback_due: False``, rewards are kept until it says
    ``True``, and learnt from then in their order; pulls that it says were not ``matched`` by a log
    are not learnt from.

    Args:
        policy: name of the policy.
        env: environment with `Discrete` actions, the arms, or its id.
        tie_breaking: which of several best arms to pull while learning: a random one, or the first,
            as NumPy's argmax does. `predict` takes the first.
        stats_window_size: episodes over which logged statistics are averaged.
        tensorboard_log: folder for TensorBoard, or None.
        verbose: 0 silent, 1 information.
        seed: seeds the agent's generators, its action space and its environments.
        device: not used, as tables live on the CPU.

    Raises:
        ValueError: if an argument lies outside its range, or a space or a reward does not fit.
    """

    rule: ClassVar[int]
    __signature__: ClassVar[inspect.Signature]

    # An agent with a step size sets its own before it calls this constructor.
    _step_size: Any = 0.0

    _rebuilt = (
        *OnlineAlgorithm._rebuilt,
        "exploration_schedule",
        "_infos",
        "_probabilities",
        "_step_size",
    )

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        tie_breaking: TieBreaking = "random",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "cpu",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            self._step_size,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device="cpu",
            support_multi_env=True,
            seed=seed,
        )
        self.tie_breaking = tie_breaking
        self.exploration_schedule: Schedule = FloatSchedule(0.0)
        self._pending: list[list[Any]] = []
        self._infos: list[dict[str, Any]] = []
        self._probabilities: NDArray[np.float64] = np.ones(0)
        if _init_setup_model:
            self._setup_model()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.__signature__ = full_signature(cls)

    def _setup_model(self) -> None:
        check_space(self, "actions", self.action_space)
        check_option("tie_breaking", self.tie_breaking, TieBreaking)
        self._check_arguments()
        self.lr_schedule = FloatSchedule(1.0 if self.averages_samples else self.learning_rate)
        self.exploration_schedule = self._make_exploration_schedule()
        self.set_random_seed(self.seed)
        self.policy = self._make_policy()

    @property
    def n_arms(self) -> int:
        """Number of arms."""
        return int(cast(spaces.Discrete, self.action_space).n)

    @property
    def averages_samples(self) -> bool:
        """Whether the step size is 1/N."""
        return bool(cast(Any, self.learning_rate) == SAMPLE_AVERAGE)

    @property
    def exploration_rate(self) -> float:
        """Epsilon or temperature now; 0 for agents that explore by a rule of their own."""
        return self.exploration_schedule(self._current_progress_remaining)

    @property
    def tie_scale(self) -> float:
        """1 to break ties at random, 0 to take the first."""
        return float(self.tie_breaking == "random")

    @property
    def rewards_known(self) -> str:
        """The rewards that the agent can learn from, one of `agents.bandits.rewards`."""
        return ANY

    @abstractmethod
    def _check_arguments(self) -> None:
        """Refuse what does not work out, before anything is made of it."""

    @abstractmethod
    def _make_policy(self) -> BasePolicy:
        """The policy at the start."""

    @abstractmethod
    def _contexts(self, obs: NDArray[Any]) -> Any:
        """What arms are chosen in, one for each of the observations, shape (n, ...)."""

    @abstractmethod
    def _choose(
        self, contexts: Any, rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """An arm for each context and how likely it was, shapes (n,)."""

    @abstractmethod
    def _learn(self, pull: Pull) -> None:
        """Learn from one pull."""

    def _make_exploration_schedule(self) -> Schedule:
        return FloatSchedule(0.0)

    def _setup_learn(
        self, total_timesteps: int, callback: MaybeCallback = None, *args: Any, **kwargs: Any
    ) -> tuple[int, BaseCallback]:
        assert self.env is not None
        check_kinds(self, self.env)
        return super()._setup_learn(total_timesteps, callback, *args, **kwargs)

    def _begin_episodes(self) -> None:
        self._pending = [[] for _ in range(self.n_envs)]

    def _choose_actions(self) -> NDArray[np.int64]:
        contexts = self._contexts(cast(Any, self._last_obs))
        actions, self._probabilities = self._choose(contexts, self.rng)
        return actions

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: NDArray[np.bool_] | None = None
    ) -> None:
        super()._update_info_buffer(infos, dones)
        # What an environment says of a pull decides what is learnt from it.
        self._infos = infos

    def _learn_from(self, transitions: Transitions) -> None:
        contexts = self._contexts(transitions.obs).tolist()
        for i, info in enumerate(self._infos):
            pending = self._pending[i]
            if info.get("matched", True):
                reward = float(transitions.rewards[i])
                check_reward(self, reward)
                arm, probability = int(transitions.actions[i]), float(self._probabilities[i])
                pending.append([contexts[i], arm, reward, probability])
            if info.get("feedback_due", True) or transitions.dones[i]:
                for pull in pending:
                    self._learn(Pull(*pull))
                self._n_updates += len(pending)
                pending.clear()

    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The arm judged best, or an exploring choice unless ``deterministic``.

        Takes one observation or an array of n, and returns an action or n of them, and ``state``;
        ``episode_start`` is not used.
        """
        if deterministic:
            return super().predict(observation, state, episode_start, deterministic)
        obs = np.asarray(observation)
        actions, _ = self._choose(self._contexts(obs), self.predict_rng)
        shape = obs.shape[: obs.ndim - len(self.observation_space.shape or ())]
        return actions.reshape(shape), state

    def _record_training(self) -> None:
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if self.exploration_schedule(1.0) > 0:
            self.logger.record("rollout/exploration_rate", self.exploration_rate)
