"""The base of the tabular agents: arguments, tables, masks, memory, acting and learning."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, Literal, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule

from rl_yardstick.agents.common.algorithm import Transitions
from rl_yardstick.agents.common.exploration import (
    STRATEGIES,
    action_probabilities,
    draws_per_choice,
)
from rl_yardstick.agents.common.given_spaces import in_given_spaces
from rl_yardstick.agents.common.masks import (
    MaskBufferPolicy,
    check_masks_exist,
    checked_masks,
    masks_of_observations,
    numbers_in,
    present_masks,
)
from rl_yardstick.agents.common.settings import (
    EPSILONS,
    POSITIVE,
    SHARE,
    ExplorationDecay,
    check_space,
)
from rl_yardstick.agents.compiled.engine import EngineChoice, Plan
from rl_yardstick.agents.compiled.learning_algorithm import StepSize
from rl_yardstick.agents.compiled.references import handles_of
from rl_yardstick.agents.compiled.worlds import NotCompilable
from rl_yardstick.agents.tabular.updates import (
    Room,
    Tables,
    TabularAgent,
    act_on_values,
    td_learning,
)
from rl_yardstick.agents.tabular.workspace import Workspace, WorkspaceAlgorithm
from rl_yardstick.envs.wrappers import INFO_KEY
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints

MOST_ENTRIES = 100_000_000  # of a table: 1.6 GB with the counts of visits


class QTablePolicy(MaskBufferPolicy):
    """Greedy in the mean of one or two tables of action values.

    The tables are float64 buffers, so that a model file's ``policy.pth`` contains them, and they
    need neither optimizer nor gradient.
    """

    q_tables: th.Tensor  # action values, float64 of shape (T, S, A)
    visit_counts: th.Tensor  # number of updates of each entry, int64 of shape (T, S, A)
    sizes: ClassVar[tuple[str, ...]] = ("n_tables",)

    def __init__(self, *args: Any, n_tables: int = 1, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.n_tables = n_tables
        spaced: Any = self.observation_space, self.action_space
        shape = (n_tables, *(int(space.n) for space in spaced))
        if math.prod(shape) > MOST_ENTRIES:
            states, actions = spaced
            raise ValueError(
                f"a table for {states.n:,} states and {actions.n:,} actions is too large: at most "
                f"{MOST_ENTRIES:,} entries; use a network, or a wrapper with fewer states"
            )
        self.register_buffer("q_tables", th.zeros(shape, dtype=th.float64))
        self.register_buffer("visit_counts", th.zeros(shape, dtype=th.int64))

    @property
    def q_table(self) -> Floats:
        """The action values that the agent acts on, shape (S, A)."""
        return np.asarray(self.q_tables.numpy().mean(axis=0))

    def note_masks(self, obs: Any, masks: Bools) -> None:
        """Store the masks, shape (n, A), of observations of shape (n,); ValueError if changed."""
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
        """Use other masks at these observations within a ``with`` statement; no change if None."""
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
        """Action values at n observations, minus infinity where masked, shape (n, A)."""
        values: Floats = self.q_tables.numpy()[:, obs].mean(axis=0)
        if not len(self.masks):
            return values
        masks = self.masks[obs]
        return np.where(masks | ~masks.any(axis=1, keepdims=True), values, -np.inf)

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        obs = numbers_in(self.observation_space, observation).reshape(-1)
        return th.from_numpy(self.allowed_values(obs).argmax(axis=1))


ExplorationStrategy = Literal["epsilon_greedy", "boltzmann", "gaussian_noise"]


class TableWorkspace(Workspace):
    """A workspace of an agent on tables."""

    _chosen: Ints | None = None

    def act(self, obs: Any) -> Ints:
        """An action for each observation."""
        self.fields["obs"][:] = obs
        self._chosen = self.choose()
        return self._chosen

    def learn(self, transitions: Transitions) -> float:
        """Learn from a step of each environment, and return the mean absolute TD error."""
        if transitions.actions is not self._chosen:
            # After `act`, its observations and actions are in the records already.
            self.fields["obs"][:] = transitions.obs
            self.fields["action"][:] = transitions.actions
        self.fields["next_obs"][:] = transitions.next_obs
        return self.learn_from(transitions)


class TabularAlgorithm(WorkspaceAlgorithm):
    """Temporal-difference control on a table of action values.

    An algorithm may have a memory besides its tables: a NamedTuple of arrays from `_make_memory`,
    which compiled functions get as ``agent.memory`` and change in place. Arrays for current
    episodes have a row for each environment. A model file does not contain the memory: permanent
    knowledge must be in buffers of the policy, which `_memory_in_use` may add to the memory.

    Args:
        policy: ``"QTablePolicy"``.
        env: environment with finite observations and actions, or its id. Those other than
            `Discrete` from 0 are numbered; `predict` takes and returns the original ones.
        learning_rate: step size, constant or scheduled, or ``"sample_average"`` for 1/N(s, a).
        gamma: discount factor.
        exploration: ``"epsilon_greedy"``; ``"boltzmann"`` (softmax of value / temperature); or
            ``"gaussian_noise"`` (greedy in value + noise_std / (episode + 1) * normal noise, with
            episodes counted over all environments).
        exploration_fraction: share of training over which epsilon falls.
        exploration_initial_eps: epsilon at the start.
        exploration_final_eps: epsilon at the end of that share.
        exploration_decay: how epsilon falls; ``"constant"`` stays at the initial value.
        temperature: of ``"boltzmann"``, above 0, constant or scheduled.
        noise_std: of ``"gaussian_noise"``, constant or scheduled.
        tie_breaking: as in `LearningAlgorithm`.
        initial_q: value of every entry of the table at the start; high values are optimistic.
        initial_q_std: standard deviation of normal noise on the entries at the start.
        skip_terminal_update: learn nothing from the step that terminates an episode, a common
            mistake in hand-written programs, to reproduce their results.
        engine: ``"compiled"`` trains on a compiled copy of the environments, with bit-identical
            results and a hundred times faster; ValueError if there is none. ``"interpreted"``
            calls them step by step; ``"auto"`` compiles if it can.
        policy_kwargs: further arguments of the policy.
        mask_actions: choose among the actions that the environment allows, and bootstrap from
            those allowed next. The environment's method `action_masks()` must depend on the
            observation only. At an observation never visited, all actions are allowed.

    Attributes:
        masks_are_known: whether the policy has the masks of all states.
        last_steps: a record for each environment, with target and TD error of its last update.

    Raises:
        ValueError: if an argument is outside its range, a space does not fit, or the environment
            has no masks for ``mask_actions``; while learning, if a mask is malformed, allows no
            action, or differs from an earlier one of the same observation.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"QTablePolicy": QTablePolicy}
    policy: QTablePolicy
    observed = ("Discrete",)
    n_tables: ClassVar[int] = 1
    parameters = {"gamma": np.float64, "skip_terminal_update": np.bool_}  # noqa: RUF012
    ranges = {"gamma": SHARE, "temperature": POSITIVE, **EPSILONS}  # noqa: RUF012

    # Called by the training loops; each algorithm defines `next_value`.
    act = act_on_values
    learn_from_step = td_learning

    _rebuilt = (*WorkspaceAlgorithm._rebuilt, *("masks_are_known", "_infos", "last_steps"))
    excluded_from_states = ("last_steps",)

    def __init__(
        self,
        policy: str | type[BasePolicy] = "QTablePolicy",
        env: GymEnv | str | None = None,
        *,
        learning_rate: StepSize = 0.1,
        gamma: float = 0.99,
        exploration: ExplorationStrategy = "epsilon_greedy",
        exploration_fraction: float = 0.5,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        exploration_decay: ExplorationDecay = "linear",
        temperature: float | Schedule = 1.0,
        noise_std: float | Schedule = 1.0,
        initial_q: float = 0.0,
        initial_q_std: float = 0.0,
        skip_terminal_update: bool = False,
        engine: EngineChoice = "auto",
        mask_actions: bool = False,
        **kwargs: Any,
    ) -> None:
        self.gamma = gamma
        self.exploration = exploration
        self.exploration_fraction = exploration_fraction
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_decay = exploration_decay
        self.temperature = temperature
        self.noise_std = noise_std
        self.initial_q = initial_q
        self.initial_q_std = initial_q_std
        self.skip_terminal_update = skip_terminal_update
        self.engine = engine
        self.mask_actions = mask_actions
        self.masks_are_known = False
        self.last_steps: NDArray[np.void] | None = None
        self._infos: list[dict[str, Any]] = []
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_arguments(self) -> None:
        if self.mask_actions and self.env is not None:
            check_masks_exist(self.env)
        check_space(self, "observations", self.observation_space)
        check_space(self, "actions", self.action_space)

    def _refuse_gaussian_noise(self, role: str) -> None:
        """Raise ValueError for an exploration without known probabilities, which are needed."""
        if self.exploration == "gaussian_noise":
            raise ValueError(
                f"{role} needs the probabilities of the actions, which gaussian_noise does not "
                "give: take epsilon_greedy or boltzmann"
            )

    def _make_policy(self) -> BasePolicy:
        policy = cast(QTablePolicy, super()._make_policy())
        if self.mask_actions:
            policy.keep_masks()
        noise = self.rng.standard_normal(policy.q_tables.shape)
        with np.errstate(over="ignore"):
            tables = self.initial_q + self.initial_q_std * noise
        if not np.isfinite(tables).all():
            given = f"{self.initial_q:g} and {self.initial_q_std:g}"
            raise ValueError(f"initial_q and initial_q_std must give finite values, not {given}")
        policy.q_tables.copy_(th.from_numpy(tables))
        return policy

    def _make_exploration_schedule(self) -> Schedule:
        if self.exploration == "boltzmann":
            return FloatSchedule(self.temperature)
        if self.exploration == "gaussian_noise":
            return FloatSchedule(self.noise_std)
        return super()._make_exploration_schedule()

    # Arguments of compiled functions.

    def compiled_agent(self, rng: np.random.Generator, seen: Any = ()) -> TabularAgent:
        """The agent for compiled functions, with its tables in the memory of its policy."""
        policy = self.policy
        values, counts = policy.q_tables.numpy(), policy.visit_counts.numpy()
        n_actions = values.shape[2]
        n_draws = draws_per_choice(self.strategy, n_actions)
        return TabularAgent(
            self.settings()[0],
            Tables(values, counts, policy.masks),
            Room(np.empty(n_actions), np.arange(n_actions), np.empty(n_draws)),
            handles_of([rng])[0],
            self._memory_in_use(),
            seen,
        )

    def greedy_player(self, seen: Any) -> Plan:
        """A player with the greedy actions of `predict` on compiled environments."""
        numbers = np.arange(self.policy.q_tables.shape[1])
        return Plan(self.predict(numbers, deterministic=True)[0].astype(np.int64), seen)

    # Training.

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
        if self.asks_for_masks:
            raise NotCompilable("the action masks are not known of all states")

    def take_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Take over the records of the compiled loop."""
        super().take_over(envs, progress)
        self.last_steps = envs

    def _make_workspace(self, rng: np.random.Generator, n: int) -> TableWorkspace:
        n_states = self.policy.q_tables.shape[1]
        return TableWorkspace(self.compiled_agent(rng), rng, n, n_numbers=n_states)

    def _choose_actions(self) -> Ints:
        if self.asks_for_masks:
            assert self.env is not None
            self.policy.note_masks(self._last_obs, present_masks(self.env, self._last_obs))
        return super()._choose_actions()

    def _learn_from(self, transitions: Transitions) -> None:
        if self.asks_for_masks:
            self._note_next_masks(transitions)
        super()._learn_from(transitions)
        self.last_steps = self._in_use.envs

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Bools | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        self._infos = infos

    @property
    def asks_for_masks(self) -> bool:
        """Whether to ask the environments for masks at each step."""
        return self.mask_actions and not self.masks_are_known

    def _note_next_masks(self, transitions: Transitions) -> None:
        """Store the masks of the states after the step.

        A finished environment has been reset by now. For the last state of a truncated episode,
        the mask is in ``info``, or else the one stored before is used.
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

    # Prediction and exploration.

    @in_given_spaces
    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The greedy action, or an exploring one unless ``deterministic``, as in DQN.

        Takes one state index or an array of shape (n,), and returns actions of the same shape and
        ``state``; ``episode_start`` is not used. With ``mask_actions``, ``action_masks`` of shape
        (n, A) replace the masks that the agent has stored.
        """
        if deterministic and action_masks is None:
            return super().predict(observation, state, episode_start, deterministic)
        obs = numbers_in(self.observation_space, observation)
        with self.policy.told(obs.reshape(-1), action_masks):
            if deterministic:
                return super().predict(obs, state, episode_start, deterministic)
            return self._exploring_actions(obs), state

    @property
    def strategy(self) -> int:
        """The exploration strategy, a number of `agents.common.exploration`."""
        return STRATEGIES[self.exploration]

    @property
    def exploration_rate(self) -> float:
        """The present exploration rate: epsilon, temperature or standard deviation."""
        rate = super().exploration_rate
        if self.exploration == "gaussian_noise":
            return rate / (self._episode_num + 1)
        return rate

    def action_probabilities(self) -> Floats:
        """The present probabilities of the exploring policy, shape (S, A).

        Raises:
            ValueError: for Gaussian noise, whose probabilities have no closed form.
        """
        return action_probabilities(
            self.strategy,
            self.policy.q_table,
            self.exploration_rate,
            random_ties=self.tie_breaking == "random",
            masks=self.policy.masks,
        )

    def _record_training(self) -> None:
        self.logger.record("rollout/exploration_rate", self.exploration_rate)
        super()._record_training()
