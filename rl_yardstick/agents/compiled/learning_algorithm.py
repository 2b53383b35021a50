"""The base class of tabular and bandit agents: step sizes, exploration, ties, settings."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, ClassVar, Literal, cast

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule

from rl_yardstick.agents.common.algorithm import OnlineAlgorithm
from rl_yardstick.agents.common.exploration import EPSILON_GREEDY
from rl_yardstick.agents.common.schedules import ScheduleRow, epsilon_schedule, schedule_row
from rl_yardstick.agents.common.settings import (
    NOT_NEGATIVE,
    SAMPLE_AVERAGE,
    Range,
    TieBreaking,
    check_settings,
    words,
)
from rl_yardstick.agents.compiled.loop import settings_dtype
from rl_yardstick.agents.compiled.worlds import PROGRESS, NotCompilable

# One for training, and some for exploring with another generator or number of observations.
MOST_WORKSPACES = 4

StepSize = float | Schedule | Literal["sample_average"]


class LearningAlgorithm(OnlineAlgorithm):
    """Learns with a step size, explores by a schedule, and breaks ties between best actions.

    Compiled functions, which are attributes of the class, define how the agent acts and learns.
    They get a record of the agent's settings: those that the class names in ``parameters``, and
    those of its base classes.

    Args:
        policy: name of the policy.
        env: environment, or its id.
        learning_rate: step size, constant or scheduled, or ``"sample_average"`` for 1/N.
        tie_breaking: which of several best actions to take while learning: a random one, or the
            first, as NumPy's argmax does. `predict` takes the first.
        policy_kwargs: further arguments of the policy.

    Attributes:
        parameters: types of the settings that compiled functions read, by attribute name.
        ranges: the numbers that settings may be; each class may add some.
        settings_type: the type of the record.
    """

    parameters: ClassVar[Mapping[str, Any]] = {
        "tie_scale": np.float64,
        "averages_samples": np.bool_,
        "strategy": np.int64,
    }
    ranges: ClassVar[Mapping[str, Range]] = {"learning_rate": NOT_NEGATIVE}
    settings_type: ClassVar[np.dtype[np.void]]
    # The algorithm's own arrays for compiled functions.
    _memory: tuple[Any, ...] = ()
    _read_settings: ClassVar[Any]
    # Makes the arrays of compiled functions for a generator and a number of environments.
    _make_workspace: ClassVar[Callable[..., Any]]

    hidden_arguments: ClassVar[tuple[str, ...]] = ("supported_action_spaces",)

    _rebuilt = (*OnlineAlgorithm._rebuilt, "exploration_schedule", "_workspaces")
    excluded_from_states: ClassVar[tuple[str, ...]] = ("_workspaces",)

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None = None,
        learning_rate: StepSize = 0.0,
        tie_breaking: TieBreaking = "random",
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        self.tie_breaking = tie_breaking
        self.exploration_schedule: Schedule = FloatSchedule(0.0)
        self._workspaces: dict[tuple[int, int], tuple[tuple[Any, ...], Any]] = {}
        super().__init__(policy, env, cast(Any, learning_rate), policy_kwargs, **kwargs)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        above = [vars(base).get("parameters", {}) for base in reversed(cls.__mro__)]
        fields = {name: kind for parameters in above for name, kind in parameters.items()}
        cls.settings_type = settings_dtype(cls, fields)
        cls._read_settings = attrgetter(*fields)

    def _setup_model(self) -> None:
        check_settings(self)
        self._check_arguments()
        self.lr_schedule = FloatSchedule(1.0 if self.averages_samples else self.learning_rate)
        self.exploration_schedule = self._make_exploration_schedule()
        self.set_random_seed(self.seed)
        self.policy = self._make_policy()
        # A model file contains nothing about running episodes.
        self._begin_episodes()

    @abstractmethod
    def _check_arguments(self) -> None:
        """Refuse invalid arguments before anything is built."""

    def _policy_arguments(self) -> dict[str, Any]:
        """The policy's arguments besides spaces and schedule."""
        sizes = {name: getattr(self, name) for name in getattr(self.policy_class, "sizes", ())}
        return {**sizes, **self.policy_kwargs}

    def _make_policy(self) -> BasePolicy:
        return self.policy_class(
            self.observation_space, self.action_space, self.lr_schedule, **self._policy_arguments()
        )

    def _make_exploration_schedule(self) -> Schedule:
        """Make the schedule of the exploration rate: of epsilon, for agents that have one."""
        return epsilon_schedule(self) if hasattr(self, "exploration_decay") else FloatSchedule(0.0)

    @property
    def tie_scale(self) -> float:
        """1 to break ties at random, 0 to take the first."""
        return float(self.tie_breaking == "random")

    @property
    def averages_samples(self) -> bool:
        """Whether the step size is 1/N."""
        return bool(cast(Any, self.learning_rate) == SAMPLE_AVERAGE)

    @property
    def strategy(self) -> int:
        """The exploration strategy, a constant of `agents.common.exploration`."""
        return EPSILON_GREEDY

    @property
    def exploration_rate(self) -> float:
        """The current exploration rate; 0 for agents with their own rule of exploration."""
        return self.exploration_schedule(self._current_progress_remaining)

    def check_compilable(self) -> None:
        """Raise `NotCompilable` if the training needs something that compiled functions lack."""

    def made_from(self, rng: np.random.Generator) -> tuple[Any, ...]:
        """The inputs of a workspace: once they differ, the workspace is out of date.

        Callbacks may change settings, replace a table or the memory, or reseed the agent.
        """
        # Fast look-ups, because this runs after every step.
        tables = [
            buffer.data_ptr() for buffer in self.policy._buffers.values() if buffer is not None
        ]
        # The workspace keeps the memory alive, so no other memory can get the same id.
        return rng, self._read_settings(self), id(self._memory), *tables

    def _workspace_for(self, rng: np.random.Generator, n: int) -> Any:
        """A cached workspace that is up to date, and keeps its generator alive."""
        made_from = self.made_from(rng)
        known = self._workspaces.get((id(rng), n))
        if known is None or known[0] != made_from:
            if len(self._workspaces) >= MOST_WORKSPACES:
                self._workspaces.clear()
            known = made_from, self._make_workspace(rng, n)
            self._workspaces[id(rng), n] = known
        return known[1]

    def __getstate__(self) -> dict[str, Any]:
        # A copied workspace would not share its arrays with the copied policy.
        classes = (vars(cls) for cls in type(self).__mro__)
        names = {name for known in classes for name in known.get("excluded_from_states", ())}
        return {**self.__dict__, **dict.fromkeys(names), "_workspaces": {}}

    def settings(self) -> NDArray[np.void]:
        """The agent's settings: an array of one record; a word is its place in its `Literal`."""
        settings = np.zeros(1, dtype=self.settings_type)
        known, fields = type(self).__signature__.parameters, cast(Any, self.settings_type.names)
        # The first field is the class.
        for name, value in zip(fields[1:], self._read_settings(self), strict=True):
            is_word = isinstance(value, str)
            settings[name] = words(known[name].annotation).index(value) if is_word else value
        return settings

    def schedules(self) -> dict[str, Schedule]:
        """The schedules, by their field names in the `PROGRESS` record."""
        return {"exploration": self.exploration_schedule, "learning_rate": self.lr_schedule}

    def progress(self) -> NDArray[np.void]:
        """The training's progress: an array of one record."""
        progress = np.zeros(1, dtype=PROGRESS)
        remaining = self._current_progress_remaining
        for name, schedule in self.schedules().items():
            progress[name] = schedule(remaining)
        progress["episodes"] = self._episode_num
        return progress


def compiled_schedule(schedule: Schedule) -> ScheduleRow:
    """The schedule in the form that compiled code reads."""
    row = schedule_row(schedule)
    if row is None:
        raise NotCompilable("a schedule is a Python function")
    return row
