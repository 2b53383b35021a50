"""Tables of which only the actions count that the environment allows."""

from __future__ import annotations

from typing import Any, ClassVar, Unpack, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.common.mask_reading import (
    check_masks_exist,
    checked_masks,
    masks_of_observations,
    present_masks,
)
from agents.common.online import Transitions
from agents.common.signatures import CommonArguments, TieBreaking
from agents.compiled.compile_envs import NotCompilable
from agents.compiled.learning_algorithm import LearningAlgorithm, StepSize
from agents.tabular.q_table_policy import QTablePolicy
from agents.tabular.value_tables import MaskedTables, Tables
from envs.action_masks import INFO_KEY
from mdp.array_types import Bools


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
