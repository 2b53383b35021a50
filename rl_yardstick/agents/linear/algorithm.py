"""The base of the agents on active tiles: arguments, weights, policy, and training."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from rl_yardstick.agents.common.algorithm import Transitions
from rl_yardstick.agents.common.exploration import first_best
from rl_yardstick.agents.common.model_files import TablePolicy
from rl_yardstick.agents.common.settings import SHARE, TieBreaking, check_space, check_vectors
from rl_yardstick.agents.compiled.engine import EngineChoice
from rl_yardstick.agents.compiled.env_states import BEFORE, move_on
from rl_yardstick.agents.compiled.references import handles_of
from rl_yardstick.agents.compiled.worlds import env_dtype
from rl_yardstick.agents.linear.tiles import (
    Bound,
    HandedVectors,
    LinearAgent,
    Room,
    Tiles,
    act_on_tiles,
    add_up,
    look,
    make_tiles,
    tiles_of_all,
    vectors_of,
)
from rl_yardstick.agents.tabular.workspace import Workspace, WorkspaceAlgorithm
from rl_yardstick.machine_code.compiling import called
from rl_yardstick.mdp.transition_model import Floats, Ints

# The policy of agents on active tiles: their weights, in buffers.


class TilePolicy(TablePolicy):
    """Takes the action of the highest sum of weights over the active tiles."""

    weights: th.Tensor  # of action values or preferences, float64 of shape (tiles, A)
    state_weights: th.Tensor  # of state values, float64 of shape (tiles,), or (0,) without them

    def __init__(
        self,
        *args: Any,
        tiling: dict[str, Any] | None = None,
        values_states: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.tiling = dict(tiling or {})
        n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
        self.tiles = make_tiles(self.observation_space, **self.tiling, n_actions=n_actions)
        n_tiles = self.tiles.n_tiles
        self.register_buffer("weights", th.zeros((n_tiles, n_actions), dtype=th.float64))
        n_valued = n_tiles if values_states else 0
        self.register_buffer("state_weights", th.zeros(n_valued, dtype=th.float64))

    def _sizes(self) -> dict[str, Any]:
        return {"tiling": self.tiling, "values_states": len(self.state_weights) > 0}

    def sums(self, observations: NDArray[Any]) -> Floats:
        """Action values or preferences at n observations, shape (n, A)."""
        active = tiles_of_all(self.tiles, vectors_of(self.observation_space, observations))
        weights = self.weights.numpy()
        sums = np.zeros((len(active), weights.shape[1]))
        for tiles in active.T:  # in the order in which the training loops add up
            sums += weights[tiles]
        return sums

    def _predict(
        self, observation: th.Tensor | dict[str, th.Tensor], deterministic: bool = False
    ) -> th.Tensor:
        """The first of the best actions for each observation, shape (n,)."""
        assert isinstance(observation, th.Tensor)
        return th.from_numpy(self.sums(observation.numpy()).argmax(axis=1))


NUMBERED_ENV = env_dtype(("number", np.int64))


class TileWorkspace(Workspace):
    """A workspace of an agent on tiles."""

    def __init__(
        self, agent: LinearAgent, space: spaces.Space[Any], rng: np.random.Generator, n: int
    ) -> None:
        self.space = space
        before, after = np.zeros((2, n, len(agent.room.vector)))
        self.seen = HandedVectors(before, after)
        super().__init__(agent._replace(seen=self.seen), rng, n, NUMBERED_ENV)
        self.envs["number"] = np.arange(n)

    def act(self, observations: Any) -> Ints:
        """An action for each observation."""
        self.seen.before[:] = vectors_of(self.space, observations)
        return self.choose()

    def learn(self, transitions: Transitions) -> float:
        """Learn from a step of each environment, and return the mean absolute TD error."""
        self.seen.before[:] = vectors_of(self.space, transitions.obs)
        self.seen.after[:] = vectors_of(self.space, transitions.next_obs)
        self.fields["action"][:] = transitions.actions
        return self.learn_from(transitions)


class TilePlayer(NamedTuple):
    """Plays without learning: takes the first of the actions with the highest sum."""

    weights: Floats
    tiles: Tiles
    seen: Any
    room: Room

    @called
    def act(self: Any, env: Any, progress: Any) -> None:
        """Take the best action."""
        look(self, env, BEFORE, self.room.tiles)
        add_up(self, self.room.tiles)
        env.action = first_best(self.room.sums)

    @called
    def learn_from_step(self, envs: Any, progress: Any) -> None:
        """Learn nothing; move on to the next observations."""
        for i in range(len(envs)):
            move_on(self.seen, envs[i])


class TileAlgorithm(WorkspaceAlgorithm):
    """Learns weights of tiles: by tile coding, or as a table if observations are numbers.

    Args:
        policy: ``"TilePolicy"``.
        env: environment with `Discrete` actions, and observations in a `Box` of shape (d,), read in
            single precision, or in a `Discrete` space; or its id.
        learning_rate: step size, constant or scheduled. It is divided by the number of tilings, so
            that 1 moves a sum all the way to its target; the book's alpha is this quotient.
        tie_breaking: as in `LearningAlgorithm`.
        gamma: discount factor.
        n_tilings: number of tilings. This and the next three are for a `Box`; each number of a
            `Discrete` space is a tile of its own.
        n_tiles: tiles of each tiling in each dimension, a number or a list of d.
        low: where tiles begin, a number or a list of d; None for the space's own bound.
        high: where they end, likewise. Values outside count as lying on the bound.
        engine: as in `TabularAlgorithm`; environments with a known model, CartPole and MountainCar
            can be compiled.

    Raises:
        ValueError: if an argument is outside its range, a space does not fit, a dimension has no
            bounds, or there would be too many weights.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TilePolicy": TilePolicy}
    policy: TilePolicy
    parameters = {"gamma": np.float64}  # noqa: RUF012
    ranges = {"gamma": SHARE}  # noqa: RUF012
    values_states: ClassVar[bool] = False
    hidden_arguments: ClassVar[tuple[str, ...]] = ("policy_kwargs",)

    act = act_on_tiles

    def __init__(
        self,
        policy: str | type[BasePolicy] = "TilePolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = 0.1,
        tie_breaking: TieBreaking = "random",
        gamma: float = 1.0,
        n_tilings: int = 8,
        n_tiles: int | Sequence[int] = 8,
        low: Bound = None,
        high: Bound = None,
        engine: EngineChoice = "auto",
        **kwargs: Any,
    ) -> None:
        self.gamma = gamma
        self.n_tilings = n_tilings
        self.n_tiles = n_tiles
        self.low = low
        self.high = high
        self.engine = engine
        super().__init__(policy, env, learning_rate, tie_breaking, **kwargs)

    def _check_arguments(self) -> None:
        check_space(self, "actions", self.action_space)
        check_vectors(self, self.observation_space)

    def _policy_arguments(self) -> dict[str, Any]:
        tiling = {name: getattr(self, name) for name in ("n_tilings", "n_tiles", "low", "high")}
        return {"tiling": tiling, "values_states": self.values_states}

    def _make_policy(self) -> BasePolicy:
        policy = cast(TilePolicy, super()._make_policy())
        policy.weights[:] = th.from_numpy(self._initial_sums() / policy.tiles.n_tilings)
        return policy

    @property
    def n_actions(self) -> int:
        """Number of actions."""
        return int(self.action_space.n)  # type: ignore[attr-defined]

    @abstractmethod
    def _initial_sums(self) -> Floats:
        """Each action's sum at the start, shape (A,)."""

    @abstractmethod
    def _probabilities(self, sums: Floats) -> Floats:
        """The probabilities of actions for sums of shape (n, A), same shape."""

    def compiled_agent(self, rng: np.random.Generator, seen: Any = None) -> LinearAgent:
        """The agent for compiled functions, with its weights in the memory of its policy."""
        tiles = self.policy.tiles
        here, ahead = np.empty((2, tiles.n_tilings), dtype=np.int64)
        room = Room(np.empty(len(tiles.dimensions)), here, ahead, np.empty(self.n_actions))
        return LinearAgent(
            self.settings()[0],
            self.policy.weights.numpy(),
            self._memory_in_use(),
            tiles,
            seen,
            room,
            handles_of([rng])[0],
        )

    def greedy_player(self, seen: Any) -> TilePlayer:
        """A player with the same actions as `predict` on compiled environments."""
        agent = self.compiled_agent(self.rng, seen)
        return TilePlayer(agent.weights, agent.tiles, agent.seen, agent.room)

    def _make_workspace(self, rng: np.random.Generator, n: int) -> TileWorkspace:
        return TileWorkspace(self.compiled_agent(rng), self.observation_space, rng, n)

    def predict(
        self,
        observation: NDArray[Any] | dict[str, NDArray[Any]],
        state: tuple[NDArray[Any], ...] | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], tuple[NDArray[Any], ...] | None]:
        """The action of the highest sum, or an exploring one unless ``deterministic``.

        Takes one observation or an array of n, and returns an action or n of them, and ``state``;
        ``episode_start`` is not used.
        """
        if deterministic:
            return super().predict(observation, state, episode_start, deterministic)
        return self._exploring_actions(observation), state

    def action_probabilities(self, observations: NDArray[Any] | None = None) -> Floats:
        """The present probabilities of the policy that acts in training, shape (n, A).

        Args:
            observations: n of them; by default all numbers of a `Discrete` space.
        """
        if observations is None:
            check_space(self, "observations", self.observation_space)
            observations = np.arange(self.observation_space.n)  # type: ignore[attr-defined]
        return self._probabilities(self.policy.sums(observations))
