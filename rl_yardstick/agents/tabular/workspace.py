"""The base of agents on tables and on tiles, which learn from records of their environments.

Compiled functions read and write these records. In the interpreted loop a `Workspace` has them.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import is_vectorized_observation

from rl_yardstick.agents.common.algorithm import Transitions
from rl_yardstick.agents.compiled.engine import choose_engine
from rl_yardstick.agents.compiled.learning_algorithm import LearningAlgorithm
from rl_yardstick.agents.compiled.loop import act, learn_from_step
from rl_yardstick.agents.compiled.references import Reference, address_of
from rl_yardstick.agents.compiled.worlds import ENV, PROGRESS, UNDECIDED, env_records
from rl_yardstick.machine_code.compiling import kernel
from rl_yardstick.mdp.transition_model import Ints


class Bench(NamedTuple):
    """What compiled functions of the interpreted loop work on."""

    agent: Any  # the agent for compiled functions
    envs: NDArray[np.void]  # records of its environments, shape (n,)
    progress: NDArray[np.void]  # a record of type `PROGRESS`, shape (1,)
    n_numbers: int  # observations that are numbers must be below this


@kernel
def act_in_all(bench: Any, _: float, __: float) -> int:
    """`act` in each environment.

    Returns -1, or the number of an environment whose observation is no number; none acts then.
    """
    for i in range(len(bench.envs)):
        if not 0 <= bench.envs[i].obs < bench.n_numbers:
            return i
    for i in range(len(bench.envs)):
        act(bench.agent, bench.envs[i], bench.progress[0])
    return -1


@kernel
def learn_from_all(bench: Any, _: float, __: float) -> int:
    """`learn_from_step` of all environments; returns as `act_in_all`."""
    for i in range(len(bench.envs)):
        if not 0 <= bench.envs[i].next_obs < bench.n_numbers:
            return i
    learn_from_step(bench.agent, bench.envs, bench.progress[0])
    return -1


_CALLED = ctypes.PYFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_double, ctypes.c_double)


class Workspace:
    """Records of n environments and of the training's progress, for the interpreted loop.

    Args:
        agent: the agent for compiled functions, whose tables are changed in place.
        rng: its generator, kept here because a handle does not keep it alive.
        n: the number of environments.
        kind: the type of their records.
        n_numbers: observations that are numbers must be below this.
    """

    def __init__(
        self,
        agent: Any,
        rng: np.random.Generator,
        n: int,
        kind: np.dtype[np.void] = ENV,
        n_numbers: int = 1,
    ) -> None:
        self.rng = rng
        self.envs = env_records(n, kind)
        self.envs["next_action"] = UNDECIDED
        self.progress = np.zeros(1, dtype=PROGRESS)
        self.bench = Reference(Bench(agent, self.envs, self.progress, n_numbers))
        self._act, self._learn = (
            _CALLED(int(address_of(function, self.bench)))
            for function in (act_in_all, learn_from_all)
        )
        # Looked up once, because finding a field takes longer than filling it.
        self.fields = {name: self.envs[name] for name in kind.names or ()}
        # The action committed to in each environment, or `UNDECIDED`, shape (n,).
        self.next_actions: Ints = self.fields["next_action"]
        names = ("exploration", "learning_rate", "episodes", "mean_td_error")
        self.exploration, self.learning_rate, self.episodes, self.mean_td_error = (
            self.progress[name] for name in names
        )

    def choose(self) -> Ints:
        """An action for each observation: the one committed to, if there is one."""
        self._check("obs", self._act(self.bench.address, 0.0, 0.0))
        actions: Ints = self.fields["action"].copy()
        return actions

    def learn_from(self, transitions: Transitions) -> float:
        """Learn from rewards and ends of a step, and return the mean absolute TD error."""
        fields = self.fields
        fields["reward"][:] = transitions.rewards
        fields["terminated"][:] = transitions.terminated
        fields["done"][:] = transitions.dones
        self._check("next_obs", self._learn(self.bench.address, 0.0, 0.0))
        return float(self.mean_td_error[0])

    def _check(self, field: str, outside: int) -> None:
        """Raise ValueError for an observation that is no number, unless ``outside`` is -1."""
        if outside >= 0:
            space = f"Discrete({self.bench.held.n_numbers})"
            obs = self.fields[field][outside]
            raise ValueError(f"observation {obs} is not in {space}, the agent's space")


class WorkspaceAlgorithm(LearningAlgorithm):
    """Acts and learns in a workspace, interpreted, or on the records of the compiled loop.

    Attributes:
        engine_in_use: the loop of the last training, with the reason if it was not compiled.
        mean_td_error: mean absolute TD error of the last updates.
    """

    _rebuilt = (*LearningAlgorithm._rebuilt, "_next_actions", "_in_use", "_memory")
    excluded_from_states = ("_in_use",)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.engine_in_use = ""
        self.mean_td_error = 0.0
        self._next_actions: Ints = np.empty(0, dtype=np.int64)
        self._in_use: Any = None  # the workspace of the last learning
        super().__init__(*args, **kwargs)

    def _make_memory(self) -> tuple[Any, ...]:
        """An empty memory for ``n_envs`` environments: a NamedTuple of arrays."""
        return ()

    def _memory_in_use(self) -> tuple[Any, ...]:
        """The memory for compiled functions; a subclass may add to it."""
        return self._memory

    def _begin_episodes(self) -> None:
        self._next_actions = np.full(self.n_envs, UNDECIDED)
        self._memory = self._make_memory()

    def _run(self, total_timesteps: int, callback: BaseCallback, log_interval: int | None) -> None:
        engine = choose_engine(self, callback, log_interval)
        if engine is None:
            super()._run(total_timesteps, callback, log_interval)
        else:
            engine.run(total_timesteps)

    def hand_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Write the agent's state into the records of the compiled loop."""
        envs["next_action"] = self._next_actions
        progress["mean_td_error"] = self.mean_td_error

    def take_over(self, envs: NDArray[np.void], progress: NDArray[np.void]) -> None:
        """Read the agent's state from the records of the compiled loop."""
        self._next_actions = envs["next_action"].copy()
        self.mean_td_error = float(progress["mean_td_error"][0])

    def _present_workspace(self) -> Any:
        """The workspace of the current training, brought up to date."""
        workspace = self._workspace_for(self.rng, self.n_envs)
        self._note_progress(workspace)
        if self._next_actions is not workspace.next_actions:
            workspace.next_actions[:] = self._next_actions
            self._next_actions = workspace.next_actions
        return workspace

    def _note_progress(self, workspace: Workspace) -> None:
        remaining = self._current_progress_remaining
        workspace.exploration[0] = self.exploration_schedule(remaining)
        workspace.learning_rate[0] = self.lr_schedule(remaining)
        workspace.episodes[0] = self._episode_num
        workspace.mean_td_error[0] = self.mean_td_error

    def _choose_actions(self) -> Ints:
        actions: Ints = self._present_workspace().act(self._last_obs)
        return actions

    def _learn_from(self, transitions: Transitions) -> None:
        self._in_use = self._present_workspace()
        self.mean_td_error = self._in_use.learn(transitions)
        self._n_updates += self.n_envs

    def _exploring_actions(self, observation: Any) -> Ints:
        """An exploring action for one observation, or n actions for n observations.

        Raises:
            ValueError: for an observation of another shape.
        """
        obs = np.asarray(observation)
        many = is_vectorized_observation(obs, self.observation_space)
        workspace = self._workspace_for(self.predict_rng, len(obs) if many else 1)
        self._note_progress(workspace)
        workspace.next_actions[:] = UNDECIDED
        actions: Ints = workspace.act(obs if many else obs[None])
        return actions.reshape(len(obs) if many else ())

    def _record_training(self) -> None:
        self.logger.record("train/mean_absolute_td_error", self.mean_td_error)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if not self.averages_samples:
            rate = self.lr_schedule(self._current_progress_remaining)
            self.logger.record("train/learning_rate", rate)
