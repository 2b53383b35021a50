"""The policy of the tabular agents: tables in buffers, masks, and what episodes keep."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, Unpack, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from agents.common.algorithm import Transitions
from agents.common.masks import (
    MaskBufferPolicy,
    check_masks_exist,
    checked_masks,
    masks_of_observations,
    numbers_in,
    present_masks,
)
from agents.common.settings import CommonArguments, TieBreaking
from agents.compiled.learning_algorithm import LearningAlgorithm, StepSize
from agents.compiled.worlds import UNDECIDED, NotCompilable
from agents.tabular.updates import MaskedTables, Tables
from envs.wrappers import INFO_KEY
from mdp.array_types import Bools, Floats, Ints

# The policy of the tabular agents: action values in tables.


class QTablePolicy(MaskBufferPolicy):
    """Greedy in the mean of one or two tables of action values.

    The tables are float64 buffers, so that they travel in the ``policy.pth`` of a model file and
    need neither optimizer nor gradient.

    Args:
        observation_space: `Discrete` with S values.
        action_space: `Discrete` with A values.
        lr_schedule: not used; here because every policy is handed one.
        n_tables: number of tables T.

    Attributes:
        q_tables: action values, float64 of shape (T, S, A).
        visit_counts: number of updates of each entry, int64 of shape (T, S, A).
    """

    q_tables: th.Tensor
    visit_counts: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Discrete,
        action_space: spaces.Discrete,
        lr_schedule: Schedule | None = None,
        n_tables: int = 1,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, **kwargs)
        shape = (n_tables, int(observation_space.n), int(action_space.n))
        self.register_buffer("q_tables", th.zeros(shape, dtype=th.float64))
        self.register_buffer("visit_counts", th.zeros(shape, dtype=th.int64))

    def _sizes(self) -> dict[str, Any]:
        return {"n_tables": len(self.q_tables)}

    @property
    def q_table(self) -> Floats:
        """The action values that the agent acts on, shape (S, A)."""
        return np.asarray(self.q_tables.numpy().mean(axis=0))

    def note_masks(self, obs: Any, masks: Bools) -> None:
        """Keep what may be done at observations, which are of shape (n,); masks of shape (n, A).

        Raises:
            ValueError: if something else was allowed at one of them before.
        """
        allowed, obs = self.masks, np.asarray(obs)
        before = allowed[obs]
        changed = before.any(axis=1) & (before != masks).any(axis=1)
        allowed[obs] = masks
        if changed.any() or not np.array_equal(allowed[obs], masks):
            odd = obs[np.flatnonzero(changed | (allowed[obs] != masks).any(axis=1))[0]]
            raise ValueError(
                f"observation {odd} comes with different action masks: mask_actions needs masks "
                "that depend on the observation alone"
            )

    @contextmanager
    def told(self, obs: Ints, masks: Any) -> Iterator[None]:
        """Within the ``with`` statement these masks count at these observations; none if None."""
        if masks is None or not len(self.masks):
            yield
            return
        kept = self.masks[obs]
        self.masks[obs] = masks
        try:
            yield
        finally:
            self.masks[obs] = kept

    def allowed_values(self, obs: Ints) -> Floats:
        """Action values at some observations, minus infinity where masked, shape (n, A)."""
        values: Floats = self.q_tables.numpy()[:, obs].mean(axis=0)
        if not len(self.masks):
            return values
        masks = self.masks[obs]
        return np.where(masks | ~masks.any(axis=1, keepdims=True), values, -np.inf)

    def _predict(
        self, observation: th.Tensor | dict[str, th.Tensor], deterministic: bool = False
    ) -> th.Tensor:
        """The first of the best allowed actions; shapes (n,) to (n,)."""
        obs = numbers_in(self.observation_space, observation).reshape(-1)
        return th.from_numpy(self.allowed_values(obs).argmax(axis=1))


# Tables of which only the actions count that the environment allows.


class MaskedArguments(CommonArguments, total=False):
    """What the constructors of tabular agents hand on; see `MaskKeeper`."""

    mask_actions: bool


class MaskKeeper(LearningAlgorithm):
    """Acts and bootstraps among the actions that the environment allows, where it is asked to.

    Masks have to depend on the observation alone: they are kept in the policy, a row for each
    observation. Where they are known of all states, they are filled in before the training; else as
    observations are met. At an observation that was never met all actions count.

    Args:
        policy: name of the policy.
        env: environment, or its id.
        learning_rate: as in `LearningAlgorithm`.
        tie_breaking: as in `LearningAlgorithm`.
        policy_kwargs: further arguments of the policy.
        mask_actions: choose among the actions that the environment allows, and bootstrap from
            those that it allows next. It says so by a method `action_masks()`.
        kwargs: as in `OnlineAlgorithm`.

    Attributes:
        masks_are_known: whether the policy holds the masks of all states.

    Raises:
        ValueError: if masks are asked for and the environment has none; while learning, if one is
            malformed, allows nothing, or differs from another one of the same observation.
    """

    policy: QTablePolicy
    n_tables: ClassVar[int] = 1

    _rebuilt = (*LearningAlgorithm._rebuilt, "masks_are_known", "_infos")

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        learning_rate: StepSize = 0.0,
        tie_breaking: TieBreaking = "random",
        policy_kwargs: dict[str, Any] | None = None,
        mask_actions: bool = False,
        **kwargs: Unpack[CommonArguments],
    ) -> None:
        self.mask_actions = mask_actions
        self.masks_are_known = False
        self._infos: list[dict[str, Any]] = []
        super().__init__(policy, env, learning_rate, tie_breaking, policy_kwargs, **kwargs)

    def _check_arguments(self) -> None:
        if self.mask_actions and self.env is not None:
            check_masks_exist(self.env)

    def _make_policy(self) -> QTablePolicy:
        policy: QTablePolicy = self.policy_class(  # type: ignore[assignment]
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            n_tables=self.n_tables,
            **self.policy_kwargs,
        )
        if self.mask_actions:
            policy.keep_masks()
        return policy

    def _check_tables(self) -> None:
        """Refuse tables that compiled code would read beside.

        Raises:
            ValueError: naming the shape that they must have.
        """
        spaces_ = cast(Any, (self.observation_space, self.action_space))
        shape = (self.n_tables, *(int(space.n) for space in spaces_))
        found = tuple(self.policy.q_tables.shape), tuple(self.policy.visit_counts.shape)
        if found != (shape, shape) or self.n_tables not in (1, 2):
            raise ValueError(f"tables must be 1 or 2, of shape {shape}, not {found[0]}")
        if self.mask_actions and self.policy.masks.shape != shape[1:]:
            raise ValueError(f"masks must be of shape {shape[1:]}, not {self.policy.masks.shape}")

    def _tables(self) -> Tables | MaskedTables:
        """What the agent knows, in the memory of its policy."""
        policy = self.policy
        values, counts = policy.q_tables.numpy(), policy.visit_counts.numpy()
        return (
            MaskedTables(values, counts, policy.masks)
            if self.mask_actions
            else Tables(values, counts)
        )

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        prepared = super()._setup_learn(*args, **kwargs)
        if self.mask_actions:
            assert self.env is not None
            check_masks_exist(self.env)
            known = masks_of_observations(self.env, len(self.policy.masks))
            self.masks_are_known = known is not None
            if known is not None:
                self.policy.masks[:] = known
        return prepared

    def check_compilable(self) -> None:
        if self.mask_actions and not self.masks_are_known:
            raise NotCompilable("the action masks are not known of all states")

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Bools | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        self._infos = infos

    @property
    def asks_for_masks(self) -> bool:
        """Whether the environments have to be asked at each step."""
        return self.mask_actions and not self.masks_are_known

    def _note_present_masks(self) -> None:
        """Keep what may be done where the environments are."""
        assert self.env is not None
        self.policy.note_masks(self._last_obs, present_masks(self.env, self._last_obs))

    def _note_next_masks(self, transitions: Transitions) -> None:
        """Keep what may be done where the step has led.

        By now a finished environment has been reset. Of the state in which an episode was cut off,
        ``info`` may tell; else what was seen there before counts.
        """
        assert self.env is not None
        going_on = np.flatnonzero(~transitions.dones)
        if going_on.size:
            masks = present_masks(self.env, transitions.next_obs)
            self.policy.note_masks(transitions.next_obs[going_on], masks[going_on])
        n_actions = int(cast(spaces.Discrete, self.action_space).n)
        for i in np.flatnonzero(transitions.dones & ~transitions.terminated):
            if INFO_KEY in self._infos[i]:
                obs = transitions.next_obs[i : i + 1]
                masks = checked_masks([self._infos[i][INFO_KEY]], obs, n_actions)
                self.policy.note_masks(obs, masks)


# What a tabular agent keeps beside its tables, for the episodes under way or for good.


class EpisodeKeeper(MaskKeeper):
    """Remembers between two steps: actions that were committed to, and the algorithm's own memory.

    The memory is a NamedTuple of arrays, which compiled functions are handed as ``agent.memory``
    and work on in place. What belongs to episodes under way has a row for each environment. Neither
    is part of a model file: what is learnt for good belongs into buffers of the policy, which
    `_memory_in_use` may put beside it. States of a training, to resume from, hold all of it.

    Raises:
        ValueError: while learning, if the memory is not of the shapes that the settings ask for.
    """

    _rebuilt = (*MaskKeeper._rebuilt, "_memory", "_next_actions")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._next_actions: Ints = np.empty(0, dtype=np.int64)
        self._memory: tuple[Any, ...] = ()
        super().__init__(*args, **kwargs)

    def _make_memory(self) -> tuple[Any, ...]:
        """A memory of nothing, for ``n_envs`` environments."""
        return ()

    def _memory_in_use(self) -> tuple[Any, ...]:
        """What compiled functions are handed; their algorithm's memory, unless it says more."""
        return self._memory

    def _check_memory(self) -> None:
        """Refuse a memory that compiled code would read beside.

        Raises:
            ValueError: naming the array, and what it must be.
        """
        expected: Any = self._make_memory()
        if type(self._memory) is not type(expected):
            raise ValueError(f"the agent's memory must be a {type(expected).__name__}")
        for name, found, like in zip(
            getattr(expected, "_fields", ()), self._memory, expected, strict=True
        ):
            if (found.dtype, found.shape) != (like.dtype, like.shape):
                raise ValueError(
                    f"the agent's memory was made for other settings: {name} must be of shape "
                    f"{like.shape} and {like.dtype}, not {found.shape} and {found.dtype}"
                )

    def _begin_episodes(self) -> None:
        self._next_actions = np.full(self.n_envs, UNDECIDED)
        self._memory = self._make_memory()

    def hand_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Write what the compiled loop goes on from into its records."""
        envs["next_action"] = self._next_actions

    def take_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Go on from where the compiled loop is."""
        self._next_actions = envs["next_action"].copy()
