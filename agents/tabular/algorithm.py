"""The base of the tabular agents: their arguments, and how they act and learn."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, Unpack

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule

from agents.common.algorithm import Transitions
from agents.common.exploration import STRATEGIES, action_probabilities, draws_per_choice
from agents.common.masks import numbers_in
from agents.common.schedules import epsilon_schedule
from agents.common.settings import (
    ExplorationDecay,
    TieBreaking,
    check_above_zero,
    check_epsilons,
    check_option,
    check_share,
    check_space,
    settings_of,
)
from agents.compiled.engine import EngineChoice, choose_engine
from agents.compiled.generators import handles_of
from agents.compiled.greedy_play import Explorer, Plan
from agents.compiled.learning_algorithm import StepSize
from agents.compiled.worlds import ENV, PROGRESS, UNDECIDED, env_records
from agents.tabular.policy import EpisodeKeeper, MaskedArguments, QTablePolicy
from agents.tabular.updates import (
    Room,
    TabularAgent,
    act_in_all,
    act_on_values,
    learn_from_all,
    no_commitment,
    td_learning,
)
from mdp.array_types import Bools, Floats, Ints

# What compiled functions work on while the interpreted loop steps the environments.


class Workspace:
    """Records of n environments, of how far the training is, and of the agent.

    Args:
        agent: whose settings and tables are worked on in place.
        masks: what the environment allows at each observation, or of no rows for everything.
        rng: its generator, or another one to choose by.
        n: number of environments, or of observations.
    """

    def __init__(self, agent: TabularAgent, masks: Bools, rng: np.random.Generator, n: int) -> None:
        self.rng = rng  # the handle does not keep it alive
        self.envs = env_records(n, ENV)
        self.envs["next_action"] = UNDECIDED
        self.progress = np.zeros(1, dtype=PROGRESS)
        # In the order that `act_in_all` and `learn_from_all` take them in.
        self.arrays = (
            np.array([agent.settings]),
            self.envs,
            self.progress,
            *agent.tables[:2],
            masks,
            *agent.room,
            handles_of([rng]),
            agent.memory,
        )
        # Looked up once: finding a field takes longer than filling it.
        self.fields = {name: self.envs[name] for name in ENV.names or ()}
        names = ("exploration", "learning_rate", "episodes")
        self.exploration, self.learning_rate, self.episodes = (self.progress[n] for n in names)
        self._chosen: Ints | None = None

    @property
    def next_actions(self) -> Ints:
        """What the agent has committed to in each environment, or `UNDECIDED`; shape (n,)."""
        actions: Ints = self.fields["next_action"]
        return actions

    def note_progress(self, exploration: float, learning_rate: float, episodes: int) -> None:
        """Set how much to explore, the step size, and how many episodes have ended."""
        self.exploration[0] = exploration
        self.learning_rate[0] = learning_rate
        self.episodes[0] = episodes

    def _check(self, field: str, outside: int) -> None:
        """Refuse an observation that the tables have no row for, which compiled code would not see.

        Raises:
            ValueError: naming the observation and what it may be.
        """
        if outside >= 0:
            n_states = self.arrays[3].shape[1]
            obs = self.fields[field][outside]
            raise ValueError(f"observation {obs} is not in Discrete({n_states}), the agent's space")

    def act(self, obs: Any) -> Ints:
        """An action for each observation, the one that was committed to where there is one.

        Args:
            obs: observations, shape (n,).
        """
        fields = self.fields
        fields["obs"][:] = obs
        self._check("obs", act_in_all(*self.arrays))
        actions: Ints = fields["action"].copy()
        self._chosen = actions
        return actions

    def learn(self, transitions: Transitions) -> float:
        """Learn from a step of each environment, and return the mean absolute TD error."""
        fields = self.fields
        if transitions.actions is not self._chosen:
            # Not what `act` has just chosen, whose observations and actions are there already.
            fields["obs"][:] = transitions.obs
            fields["action"][:] = transitions.actions
        fields["reward"][:] = transitions.rewards
        fields["terminated"][:] = transitions.terminated
        fields["done"][:] = transitions.dones
        fields["next_obs"][:] = transitions.next_obs
        self._check("next_obs", learn_from_all(*self.arrays))
        return float(self.progress["mean_td_error"][0])


# How agents on tables act and learn: what both training loops are handed of them.


class TableTraining(EpisodeKeeper):
    """Acts and learns on the tables of its policy, interpreted or compiled.

    Attributes:
        engine_in_use: which loop the last training ran in, and why if it is not the compiled one.
        mean_td_error: mean absolute error of the last updates.
        last_steps: a record for each environment, with target and TD error of its last update.
    """

    # What the training loops call; `next_value` is each algorithm's own.
    act = act_on_values
    learn_from_step = td_learning
    commit = no_commitment

    _rebuilt = (*EpisodeKeeper._rebuilt, "_in_use", "last_steps")
    excluded_from_states = ("_in_use", "last_steps")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.engine_in_use = ""
        self.mean_td_error = 0.0
        self._in_use: Workspace | None = None
        self.last_steps: NDArray[np.void] | None = None
        super().__init__(*args, **kwargs)

    def compiled_agent(self, rng: np.random.Generator) -> TabularAgent:
        """The agent as compiled functions see it, its tables in the memory of its policy."""
        values = self.policy.q_tables.numpy()
        self._check_tables()
        self._check_memory()
        n_actions = values.shape[2]
        n_draws = draws_per_choice(self.strategy, n_actions)
        return TabularAgent(
            self.settings()[0],
            self._tables(),
            Room(np.empty(n_actions), np.arange(n_actions), np.empty(n_draws)),
            handles_of([rng])[0],
            self._memory_in_use(),
        )

    def greedy_player(self, seen: Any) -> Plan:
        """What plays as `predict` does on compiled environments, which show numbers."""
        numbers = np.arange(self.policy.q_tables.shape[1])
        return Plan(self.predict(numbers, deterministic=True)[0].astype(np.int64))

    def exploring_player(self, seen: Any) -> Explorer:
        """What plays as `predict` does that explores, and draws from the same generator."""
        return Explorer(self.compiled_agent(self.predict_rng), self.progress())

    def _check_tables(self) -> None:
        super()._check_tables()
        if self.strategy not in STRATEGIES.values():
            raise ValueError(f"unknown exploration strategy {self.strategy}")

    def _run(self, total_timesteps: int, callback: BaseCallback, log_interval: int | None) -> None:
        engine = choose_engine(self, callback, log_interval)
        if engine is not None:
            engine.run(total_timesteps)
            return
        self._in_use = None
        super()._run(total_timesteps, callback, log_interval)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_in_use": None, "last_steps": None}

    def hand_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Write what the compiled loop goes on from into its records."""
        super().hand_over(envs, progress)
        progress["mean_td_error"] = self.mean_td_error

    def take_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Go on from where the compiled loop is."""
        super().take_over(envs, progress)
        self.last_steps = envs
        self.mean_td_error = float(progress["mean_td_error"][0])

    def _present_workspace(self) -> Workspace:
        """The one of the training under way, up to date."""
        workspace: Workspace = self._workspace_for(self.rng, self.n_envs)
        self._note_progress(workspace)
        if self._next_actions is not workspace.next_actions:
            workspace.next_actions[:] = self._next_actions
            self._next_actions = workspace.next_actions
        return workspace

    def _note_progress(self, workspace: Workspace) -> None:
        remaining = self._current_progress_remaining
        exploration, step_size = self.exploration_schedule(remaining), self.lr_schedule(remaining)
        workspace.note_progress(exploration, step_size, self._episode_num)

    def _make_workspace(self, rng: np.random.Generator, n: int) -> Workspace:
        return Workspace(self.compiled_agent(rng), self.policy.masks, rng, n)

    def _choose_actions(self) -> Ints:
        if self.asks_for_masks:
            self._note_present_masks()
        workspace = self._in_use
        if workspace is None or workspace.rng is not self.rng:
            workspace = self._present_workspace()
        else:
            # Brought up to date when the agent learnt last: episodes have been counted since then.
            workspace.episodes[0] = self._episode_num
        return workspace.act(self._last_obs)

    def _learn_from(self, transitions: Transitions) -> None:
        if self.asks_for_masks:
            self._note_next_masks(transitions)
        self._in_use = workspace = self._present_workspace()
        self.last_steps = workspace.envs
        self.mean_td_error = workspace.learn(transitions)
        self._n_updates += self.n_envs

    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The greedy action, or an exploring one unless ``deterministic``, as DQN has it.

        Takes one state index or an array of shape (n,), and returns actions of the same shape and
        ``state``; ``episode_start`` is not used. With ``mask_actions``, ``action_masks`` of shape
        (n, A) count here in place of those that the agent has kept.
        """
        if deterministic and action_masks is None:
            return super().predict(observation, state, episode_start, deterministic)
        obs = numbers_in(self.observation_space, observation)
        with self.policy.told(obs.reshape(-1), action_masks):
            if deterministic:
                return super().predict(obs, state, episode_start, deterministic)
            return self._exploring_actions(obs), state


# What all tabular agents share: their arguments, their tables, and how they act and learn.

ExplorationStrategy = Literal["epsilon_greedy", "boltzmann", "gaussian_noise"]


class TabularAlgorithm(TableTraining):
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
        tie_breaking: as in `LearningAlgorithm`.
        initial_q: value of every entry of the table at the start; high values are optimistic.
        initial_q_std: standard deviation of normal noise on the entries at the start.
        skip_terminal_update: learn nothing from the step that terminates an episode, a common
            omission in hand-written programs, here to reproduce their results.
        engine: ``"compiled"`` trains on a compiled copy of the environments, to the same bits and
            a hundred times faster, and is refused where there is none; ``"interpreted"`` calls
            them step by step; ``"auto"`` compiles where it can.
        policy_kwargs: further arguments of the policy.
        kwargs: as in `MaskKeeper`, ``mask_actions`` among them.

    Raises:
        ValueError: if an argument lies outside its range or a space does not fit.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"QTablePolicy": QTablePolicy}
    parameters = {"gamma": np.float64, "skip_terminal_update": np.bool_}  # noqa: RUF012
    logs_by_records = True

    def __init__(
        self,
        policy: str | type[BasePolicy] = "QTablePolicy",
        env: GymEnv | str | None = None,
        learning_rate: StepSize = 0.1,
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
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Unpack[MaskedArguments],
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
        super().__init__(policy, env, learning_rate, tie_breaking, policy_kwargs, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_space(self, "observations", self.observation_space)
        check_space(self, "actions", self.action_space)
        check_option("exploration", self.exploration, ExplorationStrategy)
        check_option("engine", self.engine, EngineChoice)
        check_epsilons(self)
        check_share(settings_of(self, "gamma"))
        check_above_zero(settings_of(self, "temperature"))

    def _make_policy(self) -> QTablePolicy:
        policy = super()._make_policy()
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
        return epsilon_schedule(
            self.exploration_decay,
            self.exploration_initial_eps,
            self.exploration_final_eps,
            self.exploration_fraction,
        )

    @property
    def strategy(self) -> int:
        """How the agent explores around its values, one of `agents.common.exploration`."""
        return STRATEGIES[self.exploration]

    @property
    def exploration_rate(self) -> float:
        """How much the agent explores now: epsilon, temperature or standard deviation."""
        rate = super().exploration_rate
        if self.exploration == "gaussian_noise":
            return rate / (self._episode_num + 1)
        return rate

    def action_probabilities(self) -> Floats:
        """What the exploring policy does now, shape (S, A).

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
        self.logger.record("train/mean_absolute_td_error", self.mean_td_error)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if not self.averages_samples:
            rate = self.lr_schedule(self._current_progress_remaining)
            self.logger.record("train/learning_rate", rate)

    def log_columns(self, records: NDArray[np.void]) -> dict[str, list[float]]:
        """As above; Gaussian noise falls with the episodes."""
        columns = super().log_columns(records)
        if self.exploration == "gaussian_noise":
            rates = records["exploration"] / (records["episodes"] + 1)
            columns["rollout/exploration_rate"] = rates.tolist()
        return columns
