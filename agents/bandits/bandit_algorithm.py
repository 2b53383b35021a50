"""What all bandit agents share: pulling arms, waiting for feedback, learning from it."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple, Unpack, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback

from agents.bandits.reward_checks import ANY, check_kinds, check_reward
from agents.common.online import Transitions
from agents.common.setting_checks import check_space
from agents.common.signatures import LearningArguments
from agents.compiled.learning_algorithm import LearningAlgorithm, StepSize
from mdp.array_types import Bools, Floats, Ints


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


class BanditAlgorithm(LearningAlgorithm):
    """Learns which arm is best in a context, as if what it does changed nothing later.

    Where the environment's ``info`` says ``feedback_due: False``, rewards are kept until it says
    ``True``, and learnt from then in their order; pulls that it says were not ``matched`` by a log
    are not learnt from.

    Args:
        policy: name of the policy.
        env: environment with `Discrete` actions, the arms, or its id.
        learning_rate: step size, for agents that have one.
        kwargs: as in `LearningAlgorithm`.

    Raises:
        ValueError: if an argument lies outside its range, or a space or a reward does not fit.
    """

    _rebuilt = (*LearningAlgorithm._rebuilt, "_infos", "_probabilities")

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        learning_rate: StepSize = 0.0,
        **kwargs: Unpack[LearningArguments],
    ) -> None:
        self._pending: list[list[Any]] = []
        self._infos: list[dict[str, Any]] = []
        self._probabilities: Floats = np.ones(0)
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_arguments(self) -> None:
        check_space(self, "actions", self.action_space)

    @property
    def n_arms(self) -> int:
        """Number of arms."""
        return int(cast(spaces.Discrete, self.action_space).n)

    @property
    def rewards_known(self) -> str:
        """The rewards that the agent can learn from, one of `agents.bandits.reward_checks`."""
        return ANY

    @abstractmethod
    def _contexts(self, obs: NDArray[Any]) -> Any:
        """What arms are chosen in, one for each of the observations, shape (n, ...)."""

    @abstractmethod
    def _choose(self, contexts: Any, rng: np.random.Generator) -> tuple[Ints, Floats]:
        """An arm for each context and how likely it was, shapes (n,)."""

    @abstractmethod
    def _learn(self, pull: Pull) -> None:
        """Learn from one pull."""

    def _setup_learn(
        self, total_timesteps: int, callback: MaybeCallback = None, *args: Any, **kwargs: Any
    ) -> tuple[int, BaseCallback]:
        assert self.env is not None
        check_kinds(self, self.env)
        return super()._setup_learn(total_timesteps, callback, *args, **kwargs)

    def _begin_episodes(self) -> None:
        self._pending = [[] for _ in range(self.n_envs)]

    def _choose_actions(self) -> Ints:
        contexts = self._contexts(cast(Any, self._last_obs))
        actions, self._probabilities = self._choose(contexts, self.rng)
        return actions

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Bools | None = None) -> None:
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
