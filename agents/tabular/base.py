"""What all tabular agents share: their arguments, their tables, and how they act and learn."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, cast

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule

from agents.common.exploration import (
    GAUSSIAN_NOISE,
    STRATEGIES,
    action_probabilities,
    draws_per_choice,
)
from agents.common.online import OnlineAlgorithm, Transitions
from agents.common.schedules import epsilon_schedule
from agents.common.step_sizes import SAMPLE_AVERAGE
from agents.tabular.arguments import (
    EngineChoice,
    ExplorationDecay,
    ExplorationStrategy,
    TieBreaking,
    check_arguments,
)
from agents.tabular.engine_choice import choose_engine
from agents.tabular.policy import QTablePolicy, Tables
from agents.tabular.rules import EXPECTED_SARSA
from agents.tabular.steps import NO_DRAWS, UNDECIDED, choose_actions, update_tables


class TabularAlgorithm(OnlineAlgorithm):
    """Temporal-difference control on a table of action values.

    Args:
        policy: ``"QTablePolicy"``.
        env: environment with `Discrete` observations and actions, or its id.
        learning_rate: step size, constant or scheduled, or ``"sample_average"`` for 1/N(s, a).
        gamma: discount factor.
        exploration: ``"epsilon_greedy"``; ``"boltzmann"`` (softmax of value / temperature); or
            ``"gaussian_noise"`` (greedy in value + noise_std / (episode + 1) * normal noise, the
            episodes counted over all environments).
        exploration_fraction: share of training over which epsilon falls.
        exploration_initial_eps: epsilon at the start.
        exploration_final_eps: epsilon at the end of that share.
        exploration_decay: how epsilon falls; ``"constant"`` stays at the initial value.
        temperature: of ``"boltzmann"``, above 0, constant or scheduled.
        noise_std: of ``"gaussian_noise"``, constant or scheduled.
        tie_breaking: which of several best actions to take while learning: a random one, or the
            first, as NumPy's argmax does. `predict` takes the first.
        initial_q: value of every entry of the table at the start; high values are optimistic.
        initial_q_std: standard deviation of normal noise on the entries at the start.
        skip_terminal_update: learn nothing from the step that terminates an episode, a common
            omission in hand-written programs, here to reproduce their results.
        engine: ``"compiled"`` trains on a compiled copy of the environments, to the same bits and
            a hundred times faster, and is refused where there is none; ``"interpreted"`` calls
            them step by step; ``"auto"`` compiles where it can.
        stats_window_size: episodes over which logged statistics are averaged.
        tensorboard_log: folder for TensorBoard, or None.
        policy_kwargs: further arguments of the policy.
        verbose: 0 silent, 1 information.
        seed: seeds the agent's generators, its action space and its environments.
        device: not used, as tables live on the CPU.

    Raises:
        ValueError: if an argument lies outside its range or a space does not fit.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"QTablePolicy": QTablePolicy}
    policy: QTablePolicy
    rule: ClassVar[int]
    n_tables: ClassVar[int] = 1

    _rebuilt = (*OnlineAlgorithm._rebuilt, "exploration_schedule", "_tables")

    def __init__(
        self,
        policy: str | type[BasePolicy] = "QTablePolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule | Literal["sample_average"] = 0.1,
        gamma: float = 0.99,
        exploration: ExplorationStrategy = "epsilon_greedy",
        exploration_fraction: float = 0.5,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
        exploration_decay: ExplorationDecay = "linear",
        temperature: float | Schedule = 1.0,
        noise_std: float | Schedule = 1.0,
        tie_breaking: TieBreaking = "random",
        initial_q: float = 0.0,
        initial_q_std: float = 0.0,
        skip_terminal_update: bool = False,
        engine: EngineChoice = "auto",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "cpu",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate,  # type: ignore[arg-type]  # the word is taken care of in _setup_model
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device="cpu",
            support_multi_env=True,
            seed=seed,
        )
        self.gamma = gamma
        self.exploration = exploration
        self.exploration_fraction = exploration_fraction
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_decay = exploration_decay
        self.temperature = temperature
        self.noise_std = noise_std
        self.tie_breaking = tie_breaking
        self.initial_q = initial_q
        self.initial_q_std = initial_q_std
        self.skip_terminal_update = skip_terminal_update
        self.engine = engine
        self.engine_in_use = ""
        self.mean_td_error = 0.0
        self._next_actions: NDArray[np.int64] | None = None
        self._tables: Tables | None = None
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._check_arguments()
        self.lr_schedule = FloatSchedule(1.0 if self.averages_samples else self.learning_rate)
        self.exploration_schedule = self._make_exploration_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            n_tables=self.n_tables,
            **self.policy_kwargs,
        )
        noise = self.rng.standard_normal(self.policy.q_tables.shape)
        self.policy.q_tables.copy_(th.from_numpy(self.initial_q + self.initial_q_std * noise))

    def _check_arguments(self) -> None:
        check_arguments(self)

    def _make_exploration_schedule(self) -> Schedule:
        """How much to explore, by the progress remaining."""
        if self.exploration == "boltzmann":
            return FloatSchedule(self.temperature)
        if self.exploration == "gaussian_noise":
            return FloatSchedule(self.noise_std)
        return epsilon_schedule(
            self.exploration_decay,
            self.exploration_initial_eps,
            self.exploration_final_eps,
            self.exploration_fraction,
        )

    @property
    def averages_samples(self) -> bool:
        """Whether the step size is 1/N(s, a)."""
        return bool(self.learning_rate == SAMPLE_AVERAGE)  # type: ignore[comparison-overlap]

    @property
    def exploration_rate(self) -> float:
        """How much the agent explores now: epsilon, temperature or standard deviation."""
        rate = self.exploration_schedule(self._current_progress_remaining)
        if self.exploration == "gaussian_noise":
            return rate / (self._episode_num + 1)
        return rate

    def _begin_episodes(self) -> None:
        self._next_actions = np.full(self.n_envs, UNDECIDED)

    def _run(self, total_timesteps: int, callback: BaseCallback, log_interval: int | None) -> None:
        engine = choose_engine(self, callback, log_interval)
        if engine is not None:
            engine.run(total_timesteps)
            return
        # Looked up once: finding the policy's tables takes longer than a step's learning.
        self._tables = self.policy.tables()
        try:
            super()._run(total_timesteps, callback, log_interval)
        finally:
            self._tables = None

    def __getstate__(self) -> dict[str, Any]:
        # A copy's arrays would no longer be its policy's.
        return {**self.__dict__, "_tables": None}

    def _decide(
        self, obs: NDArray[np.int64], actions: NDArray[np.int64], rng: np.random.Generator
    ) -> None:
        """Fill in the undecided of ``actions``, both of shape (n,), in place."""
        undecided = actions.tolist().count(UNDECIDED)
        if undecided == 0:
            return
        tables = self._tables or self.policy.tables()
        strategy = STRATEGIES[self.exploration]
        shape = undecided, draws_per_choice(strategy, len(tables.scratch))
        choose_actions(
            strategy,
            tables.values,
            obs,
            self.exploration_rate,
            float(self.tie_breaking == "random"),
            rng.standard_normal(shape) if strategy == GAUSSIAN_NOISE else rng.random(shape),
            actions,
            tables.scratch,
        )

    def _choose_actions(self) -> NDArray[np.int64]:
        assert self._next_actions is not None
        actions = self._next_actions.copy()
        self._decide(cast(Any, self._last_obs), actions, self.rng)
        return actions

    def _commit_to_next_actions(self, transitions: Transitions) -> NDArray[np.int64]:
        """Actions that the target uses, shape (n_envs,); only SARSA's does, and decides on them."""
        actions: NDArray[np.int64] = transitions.actions
        return actions

    def _learn_from(self, transitions: Transitions) -> None:
        tables = self._tables or self.policy.tables()
        next_actions = self._commit_to_next_actions(transitions)
        uniforms = self.rng.random(self.n_envs) if self.n_tables > 1 else NO_DRAWS
        # The other targets do not look at it, and asking a schedule takes its time.
        rate = self.exploration_rate if self.rule == EXPECTED_SARSA else 0.0
        self.mean_td_error = update_tables(
            self.rule,
            tables.values,
            tables.visit_counts,
            transitions.obs,
            transitions.actions,
            transitions.rewards,
            transitions.terminated,
            transitions.next_obs,
            next_actions,
            self.gamma,
            self.lr_schedule(self._current_progress_remaining),
            self.averages_samples,
            self.skip_terminal_update,
            STRATEGIES[self.exploration],
            rate,
            float(self.tie_breaking == "random"),
            uniforms,
            tables.scratch,
        )
        self._n_updates += self.n_envs

    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The greedy action, or an exploring one unless ``deterministic``, as DQN has it.

        Takes one state index or an array of shape (n,), and returns actions of the same shape and
        ``state``; ``episode_start`` is not used.
        """
        if deterministic:
            return super().predict(observation, state, episode_start, deterministic)
        obs = np.asarray(observation, dtype=np.int64)
        actions = np.full(obs.size, UNDECIDED)
        self._decide(obs.reshape(-1), actions, self.predict_rng)
        return actions.reshape(obs.shape), state

    def action_probabilities(self) -> NDArray[np.float64]:
        """What the exploring policy does now, shape (S, A).

        Raises:
            ValueError: for Gaussian noise, whose probabilities have no closed form.
        """
        return action_probabilities(
            STRATEGIES[self.exploration],
            self.policy.q_table,
            self.exploration_rate,
            random_ties=self.tie_breaking == "random",
        )

    def _record_training(self) -> None:
        self.logger.record("rollout/exploration_rate", self.exploration_rate)
        self.logger.record("train/mean_absolute_td_error", self.mean_td_error)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if not self.averages_samples:
            rate = self.lr_schedule(self._current_progress_remaining)
            self.logger.record("train/learning_rate", rate)
