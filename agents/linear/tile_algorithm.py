"""What all agents on active tiles share: arguments, weights, and how they are trained."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Unpack

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from agents.common.online import Transitions
from agents.common.setting_checks import check_option, check_share, check_space, settings_of
from agents.common.signatures import CommonArguments, TieBreaking
from agents.compiled.engine_choice import EngineChoice, choose_engine
from agents.compiled.generators import handles_of
from agents.compiled.learning_algorithm import LearningAlgorithm
from agents.compiled.training_records import UNDECIDED
from agents.linear.tile_engine import TileEngine, tile_world
from agents.linear.tile_player import TilePlayer, tile_player
from agents.linear.tile_policy import TilePolicy
from agents.linear.tile_settings import Bound
from agents.linear.tile_workspace import TileWorkspace
from agents.linear.weighted_tiles import LinearAgent, Room, act_on_tiles
from mdp.array_types import Floats, Ints


class TileArguments(CommonArguments, total=False):
    """What the constructors of these agents hand on; see `TileAlgorithm`."""

    gamma: float
    n_tilings: int
    n_tiles: int | Sequence[int]
    low: Bound
    high: Bound
    engine: EngineChoice


class TileAlgorithm(LearningAlgorithm):
    """Learns weights of tiles: those of a tile coder, or a table's where observations are numbers.

    Args:
        policy: ``"TilePolicy"``.
        env: environment with `Discrete` actions, and observations in a `Box` of shape (d,), which
            count in single precision, or in a `Discrete` space; or its id.
        learning_rate: step size, constant or scheduled. It is divided by the number of tilings, so
            that 1 moves a sum all the way to its target; the book's alpha is this quotient.
        tie_breaking: as in `LearningAlgorithm`.
        gamma: discount factor.
        n_tilings: number of tilings. This and the next three are for a `Box`; of `Discrete`
            observations each number is a tile of its own.
        n_tiles: tiles of each tiling in each dimension, a number or a list of d.
        low: where tiles begin, a number or a list of d; None, there too, for the space's own bound.
        high: where they end, likewise. What lies outside counts as lying on the edge.
        engine: as in `TabularAlgorithm`; compiled are environments with a known model, CartPole and
            MountainCar.
        kwargs: as in `OnlineAlgorithm`.

    Raises:
        ValueError: if an argument lies outside its range, a space does not fit, a dimension has no
            bounds, or there would be too many weights.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TilePolicy": TilePolicy}
    policy: TilePolicy
    parameters = {"gamma": np.float64}  # noqa: RUF012
    values_states: ClassVar[bool] = False
    logs_by_records = True

    act = act_on_tiles

    _rebuilt = (*LearningAlgorithm._rebuilt, "_next_actions")

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = 0.1,
        tie_breaking: TieBreaking = "random",
        gamma: float = 1.0,
        n_tilings: int = 8,
        n_tiles: int | Sequence[int] = 8,
        low: Bound = None,
        high: Bound = None,
        engine: EngineChoice = "auto",
        **kwargs: Unpack[CommonArguments],
    ) -> None:
        self.gamma = gamma
        self.n_tilings = n_tilings
        self.n_tiles = n_tiles
        self.low = low
        self.high = high
        self.engine = engine
        self.engine_in_use = ""
        self.mean_td_error = 0.0
        self._next_actions: Ints = np.empty(0, dtype=np.int64)
        super().__init__(policy, env, learning_rate, tie_breaking, **kwargs)

    def _check_arguments(self) -> None:
        check_space(self, "actions", self.action_space)
        space = self.observation_space
        if not (isinstance(space, spaces.Box) and len(space.shape) == 1):
            check_space(self, "observations of shape (d,) in a Box space or", space)
        check_option("engine", self.engine, EngineChoice)
        if isinstance(self.learning_rate, str):
            raise ValueError(
                f"learning_rate must be a number or a schedule, not {self.learning_rate!r}"
            )
        check_share(settings_of(self, "gamma"))

    def _make_policy(self) -> TilePolicy:
        tiling = dict(settings_of(self, "n_tilings", "n_tiles", "low", "high"))
        policy: Any = self.policy_class
        made: TilePolicy = policy(
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            tiling=tiling,
            values_states=self.values_states,
        )
        made.weights[:] = th.from_numpy(self._initial_sums() / made.tiles.n_tilings)
        return made

    @property
    def n_actions(self) -> int:
        """Number of actions."""
        return int(self.action_space.n)  # type: ignore[attr-defined]

    @abstractmethod
    def _initial_sums(self) -> Floats:
        """Each action's sum at the start, shape (A,)."""

    @abstractmethod
    def _probabilities(self, sums: Floats) -> Floats:
        """How likely actions are by sums of shape (n, A), likewise."""

    def _memory_record(self) -> Any:
        """What compiled functions are handed besides the weights, in the memory of the agent."""
        return ()

    def compiled_agent(self, rng: np.random.Generator, seen: Any = None) -> LinearAgent:
        """The agent as compiled functions see it, its weights in the memory of its policy.

        Args:
            rng: its generator.
            seen: how observations are read, one of the kinds of `agents.networks.observations`.
        """
        tiles = self.policy.tiles
        here, ahead = np.empty((2, tiles.n_tilings), dtype=np.int64)
        room = Room(np.empty(len(tiles.dimensions)), here, ahead, np.empty(self.n_actions))
        return LinearAgent(
            self.settings()[0],
            self.policy.weights.numpy(),
            self._memory_record(),
            tiles,
            seen,
            room,
            handles_of([rng])[0],
        )

    def greedy_player(self, seen: Any) -> TilePlayer:
        """What plays as `predict` does on compiled environments, whose observations are read so."""
        return tile_player(self.compiled_agent(self.rng, seen))

    def _begin_episodes(self) -> None:
        self._next_actions = np.full(self.n_envs, UNDECIDED)

    def _run(self, total_timesteps: int, callback: BaseCallback, log_interval: int | None) -> None:
        engine = choose_engine(self, callback, log_interval, tile_world, TileEngine)
        if engine is not None:
            engine.run(total_timesteps)
            return
        super()._run(total_timesteps, callback, log_interval)

    def hand_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Write what the compiled loop goes on from into its records."""
        envs["next_action"] = self._next_actions
        progress["mean_td_error"] = self.mean_td_error

    def take_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Go on from where the compiled loop is."""
        self._next_actions = envs["next_action"].copy()
        self.mean_td_error = float(progress["mean_td_error"][0])

    def _make_workspace(self, rng: np.random.Generator, n: int) -> TileWorkspace:
        return TileWorkspace(self.compiled_agent(rng), self.observation_space, n)

    def _present_workspace(self) -> TileWorkspace:
        workspace: TileWorkspace = self._workspace_for(self.rng, self.n_envs)
        self._note_progress(workspace)
        workspace.next_actions[:] = self._next_actions
        return workspace

    def _note_progress(self, workspace: TileWorkspace) -> None:
        remaining = self._current_progress_remaining
        exploration, step_size = self.exploration_schedule(remaining), self.lr_schedule(remaining)
        workspace.note_progress(exploration, step_size, self.mean_td_error)

    def _choose_actions(self) -> Ints:
        workspace = self._present_workspace()
        actions = workspace.act(np.asarray(self._last_obs))
        self._next_actions = workspace.next_actions.copy()
        return actions

    def _learn_from(self, transitions: Transitions) -> None:
        workspace = self._present_workspace()
        self.mean_td_error = workspace.learn(transitions)
        self._next_actions = workspace.next_actions.copy()
        self._n_updates += self.n_envs

    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The action of the highest sum, or one as in training unless ``deterministic``.

        Takes one observation or an array of n, and returns an action or n of them, and ``state``;
        ``episode_start`` is not used.
        """
        if deterministic:
            return super().predict(observation, state, episode_start, deterministic)
        return self._exploring_actions(observation), state

    def action_probabilities(self, observations: NDArray[Any] | None = None) -> Floats:
        """What the policy does now that training acts by, shape (n, A).

        Args:
            observations: n of them; by default all numbers of a `Discrete` space.
        """
        if observations is None:
            check_space(self, "observations", self.observation_space)
            observations = np.arange(self.observation_space.n)  # type: ignore[attr-defined]
        return self._probabilities(self.policy.sums(observations))

    def _record_training(self) -> None:
        self.logger.record("train/mean_absolute_td_error", self.mean_td_error)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        rate = self.lr_schedule(self._current_progress_remaining)
        self.logger.record("train/learning_rate", rate)
