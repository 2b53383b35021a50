"""The base of the bandit agents: pulling arms, waiting for feedback, learning from it."""

from __future__ import annotations

import inspect
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from rl_yardstick.agents.bandits.choosing import (
    act_in_context,
    allowed_room,
    choose_arms,
    learn_from_feedback,
)
from rl_yardstick.agents.common.algorithm import Transitions
from rl_yardstick.agents.common.exploration import EPSILON_GREEDY
from rl_yardstick.agents.common.masks import (
    MaskBufferPolicy,
    check_masks_exist,
    checked_masks,
    present_masks,
)
from rl_yardstick.agents.common.settings import EPSILONS, ExplorationDecay, check_space
from rl_yardstick.agents.compiled.learning_algorithm import LearningAlgorithm, StepSize
from rl_yardstick.agents.compiled.worlds import NotCompilable
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints


class ArmPolicy(MaskBufferPolicy):
    """Pulls the first arm of the highest score, among the allowed ones if masks are kept."""

    @abstractmethod
    def judged(self, observations: NDArray[Any]) -> Floats:
        """The score of each arm at each of n observations, shape (n, arms)."""

    def kept_masks(self, observations: Ints) -> Bools:
        """The last masks seen at observations of shape (n,), all arms where none was seen."""
        outside = observations[(observations < 0) | (observations >= len(self.masks))]
        if outside.size:
            raise ValueError(f"context {outside[0]} is not in Discrete({len(self.masks)})")
        masks = self.masks[observations]
        return np.asarray(masks | ~masks.any(axis=1, keepdims=True))

    def best_arms(self, observations: NDArray[Any], masks: Bools) -> Ints:
        """The first of the best arms among those in ``masks``, of shape (n, arms)."""
        judged = self.judged(observations)
        # Among the allowed arms only: the score of an arm may be minus infinity.
        allowed = [np.flatnonzero(mask) for mask in masks]
        best = [arms[row[arms].argmax()] for arms, row in zip(allowed, judged, strict=True)]
        return np.array(best, dtype=np.int64)

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        observations = observation.numpy()
        if len(self.masks):
            rows = observations.astype(np.int64).reshape(-1)
            return th.from_numpy(self.best_arms(rows, self.kept_masks(rows)))
        return th.from_numpy(self.judged(observations).argmax(axis=1))


# Which rewards an agent can learn from.

ANY = "any"
UNIT = "between 0 and 1"
BINARY = "0 or 1"


# Environments whose rewards have normal noise on them.
UNBOUNDED_KINDS = ("gaussian", "linear")


class Pull(NamedTuple):
    """A pull and its reward, kept until the feedback is due."""

    context: Any  # a row of the tables, or a list of features
    arm: int
    reward: float
    probability: float  # of the choice, for rules that need it; else 1
    # The arms that were allowed, a bool for each; None for agents without masks.
    mask: list[bool] | None = None


class BanditAlgorithm(LearningAlgorithm):
    """Learns which arm is best in a context, as if actions did not affect later contexts.

    While the environment's ``info`` has ``feedback_due: False``, rewards are kept; at ``True`` the
    agent learns from them in order. It ignores pulls with ``matched: False``, which are not in a
    log.

    Args:
        policy: name of the policy.
        env: environment with `Discrete` actions, the arms, or its id.
        learning_rate: step size, for agents that have one.
        mask_actions: choose among the arms that the environment allows at each pull, and learn as
            if there were no others. The environment's method `action_masks()` may depend on more
            than the context.

    Raises:
        ValueError: if an argument is outside its range, or a space or a reward does not fit; with
            ``mask_actions``, if the environment has no masks, the agent does not support them, or
            a mask is malformed or allows no arm.
    """

    hidden_arguments: ClassVar[tuple[str, ...]] = ("policy_kwargs",)
    rewards_known: str = ANY  # rewards that the agent can learn from: `ANY`, `UNIT` or `BINARY`

    _rebuilt = (*LearningAlgorithm._rebuilt, "_infos", "_probabilities", "_masks")

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        learning_rate: StepSize = 0.0,
        mask_actions: bool = False,
        **kwargs: Any,
    ) -> None:
        self.mask_actions = mask_actions
        self._masks: Bools = np.ones((0, 0), dtype=np.bool_)
        self._pending: list[list[Any]] = []
        self._infos: list[dict[str, Any]] = []
        self._probabilities: Floats = np.ones(0)
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_arguments(self) -> None:
        check_space(self, "actions", self.action_space)
        if self.mask_actions:
            self._check_masks()

    def _check_masks(self) -> None:
        """Raise ValueError if the environment has no masks, or the agent does not support them."""
        if "masks" not in inspect.signature(self._choose).parameters:
            raise ValueError(f"mask_actions: {type(self).__name__} chooses among all arms")
        if self.env is not None:
            check_masks_exist(self.env)

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.mask_actions and isinstance(self.observation_space, spaces.Discrete):
            cast(ArmPolicy, self.policy).keep_masks()

    def check_compilable(self) -> None:
        if self.mask_actions:
            raise NotCompilable("the environment is asked for its action masks at each pull")

    @property
    def n_arms(self) -> int:
        """Number of arms."""
        return int(cast(spaces.Discrete, self.action_space).n)

    def check_reward(self, reward: float) -> None:
        """Raise ValueError for a reward that the agent cannot learn from."""
        known = self.rewards_known
        if not (known == ANY or reward in (0.0, 1.0) or (known == UNIT and 0.0 <= reward <= 1.0)):
            raise ValueError(f"{self._misfit()}, not {reward:g}")

    def check_kinds(self, env: VecEnv) -> None:
        """Raise ValueError for environments that are known to give unsuitable rewards."""
        if self.rewards_known == ANY or not env.has_attr("kind"):
            return
        if set(env.get_attr("kind")) & set(UNBOUNDED_KINDS):
            raise ValueError(f"{self._misfit()}, and this environment's have normal noise")

    def _misfit(self) -> str:
        return (
            f"{type(self).__name__} as it is set learns from rewards that are {self.rewards_known}"
        )

    @abstractmethod
    def _contexts(self, obs: NDArray[Any]) -> Any:
        """The context of each observation, shape (n, ...)."""

    @abstractmethod
    def _choose(
        self, contexts: Any, rng: np.random.Generator, masks: Bools | None = None
    ) -> tuple[Ints, Floats]:
        """An arm for each context and the probability of the choice, shapes (n,).

        ``masks`` of shape (n, arms) has the allowed arms; a class may leave the argument out.
        """

    @abstractmethod
    def _learn(self, pull: Pull) -> None:
        """Learn from one pull."""

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        assert self.env is not None
        self.check_kinds(self.env)
        if self.mask_actions:
            self._check_masks()
        return super()._setup_learn(*args, **kwargs)

    def _begin_episodes(self) -> None:
        self._pending = [[] for _ in range(self.n_envs)]

    def _choose_actions(self) -> Ints:
        obs: Any = self._last_obs
        contexts = self._contexts(obs)
        if not self.mask_actions:
            actions, self._probabilities = self._choose(contexts, self.rng)
            return actions
        assert self.env is not None
        self._masks = present_masks(self.env, obs)
        actions, self._probabilities = self._choose(contexts, self.rng, self._masks)
        # The last masks seen in each context; no rows if contexts are vectors.
        kept = cast(ArmPolicy, self.policy).masks
        if len(kept):
            kept[obs] = self._masks
        return actions

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Bools | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        # Kept for `_learn_from`, which reads ``matched`` and ``feedback_due``.
        self._infos = infos

    def _learn_from(self, transitions: Transitions) -> None:
        contexts = self._contexts(transitions.obs).tolist()
        for i, info in enumerate(self._infos):
            pending = self._pending[i]
            if info.get("matched", True):
                reward = float(transitions.rewards[i])
                self.check_reward(reward)
                arm, probability = int(transitions.actions[i]), float(self._probabilities[i])
                told = [self._masks[i].tolist()] if self.mask_actions else []
                pending.append([contexts[i], arm, reward, probability, *told])
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
        action_masks: Any = None,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The arm judged best, or an exploring choice unless ``deterministic``.

        Takes one observation or an array of n, and returns an action or n of them, and ``state``;
        ``episode_start`` is not used. With ``mask_actions``, ``action_masks`` of shape (n, arms)
        are the allowed arms; the default is the last mask seen in the context.

        Raises:
            ValueError: if masks are given without ``mask_actions``, or are missing and needed.
        """
        if action_masks is not None and not self.mask_actions:
            raise ValueError("action_masks: the agent was made without mask_actions")
        if deterministic and not self.mask_actions:
            return super().predict(observation, state, episode_start, deterministic)
        obs = np.asarray(observation)
        contexts = self._contexts(obs)
        if not self.mask_actions:
            actions, _ = self._choose(contexts, self.predict_rng)
        else:
            masks = self._masks_at(obs, len(contexts), action_masks)
            if deterministic:
                actions = cast(ArmPolicy, self.policy).best_arms(obs, masks)
            else:
                actions, _ = self._choose(contexts, self.predict_rng, masks)
        shape = obs.shape[: obs.ndim - len(self.observation_space.shape or ())]
        return actions.reshape(shape), state

    def _masks_at(self, obs: NDArray[Any], n: int, told: Any) -> Bools:
        """The given or kept masks at ``n`` observations, shape (n, arms)."""
        if told is None and not len(cast(ArmPolicy, self.policy).masks):
            raise ValueError("mask_actions: predict needs action_masks where contexts are vectors")
        if told is None:
            return cast(ArmPolicy, self.policy).kept_masks(obs.reshape(-1).astype(np.int64))
        masks = np.atleast_2d(told)
        if len(masks) != n:
            shape, right = np.shape(told), (n, self.n_arms)
            raise ValueError(f"action_masks must be of shape {right}, not {shape}")
        one_each = obs.reshape(n, *(self.observation_space.shape or ()))
        return checked_masks(masks, one_each, self.n_arms)

    def _record_training(self) -> None:
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if self.exploration_schedule(1.0) > 0:
            self.logger.record("rollout/exploration_rate", self.exploration_rate)


class RuleBandit(BanditAlgorithm):
    """Chooses and learns by compiled rules.

    Subclasses set `choose_arm`, `context_row`, `learn_from_reward` and `choose_allowed`.
    """

    act = act_in_context
    learn_from_step = learn_from_feedback
    compiled_agent: ClassVar[Callable[..., Any]]  # with room for ``capacity`` pulls

    def _make_workspace(self, rng: np.random.Generator, n: int) -> Any:
        return self.compiled_agent(rng, capacity=n)

    @abstractmethod
    def _rows(self, agent: Any, contexts: Any) -> tuple[Ints, int]:
        """The agent's rows for these contexts, shape (n,), and the number of all rows."""

    def _choose(
        self, contexts: Any, rng: np.random.Generator, masks: Bools | None = None
    ) -> tuple[Ints, Floats]:
        n = len(contexts)
        arms, probabilities = np.empty(n, dtype=np.int64), np.empty(n)
        agent = self._workspace_for(rng, n)
        rows, n_rows = self._rows(agent, contexts)
        if masks is None:
            masks = np.ones((n, self.n_arms), dtype=np.bool_)
        room, progress = allowed_room(self.n_arms), self.progress()[0]
        outside = choose_arms(agent, rows, n_rows, progress, arms, probabilities, masks, room)
        if outside >= 0:
            raise ValueError(f"context {rows[outside]} is not in Discrete({n_rows})")
        return arms, probabilities


class EpsilonGreedyBandit(RuleBandit):
    """Pulls a random arm with probability epsilon.

    Args:
        exploration_initial_eps: epsilon at the start.
        exploration_final_eps: epsilon at the end of ``exploration_fraction``.
        exploration_fraction: share of training over which epsilon falls.
        exploration_decay: how epsilon falls; ``"constant"`` stays at the initial value.
    """

    strategy = EPSILON_GREEDY
    ranges = EPSILONS

    def __init__(
        self,
        *args: Any,
        exploration_initial_eps: float = 0.1,
        exploration_final_eps: float = 0.01,
        exploration_fraction: float = 1.0,
        exploration_decay: ExplorationDecay = "constant",
        **kwargs: Any,
    ) -> None:
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_fraction = exploration_fraction
        self.exploration_decay = exploration_decay
        super().__init__(*args, **kwargs)
