"""Methods with eligibility traces: SARSA(lambda) and Watkins's Q(lambda)."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, cast

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.common.exploration import highest_value
from agents.common.settings import check_option, check_share, settings_of
from agents.compiled.learning_algorithm import StepSize
from agents.compiled.loop import CompiledOnlyError, by_type
from agents.tabular.n_step import EpisodicAlgorithm
from agents.tabular.one_step import best_next_value, commit_to_next_action, committed_value
from agents.tabular.updates import TabularAgent, count_visit, value_ahead, values_at
from machine_code.compiling import inlined
from mdp.transition_model import Floats, Ints

# Eligibility traces of the entries that an episode has visited, and learning along them.
#
# Traces are kept with the step size folded in, which the entry had when it was visited: where step
# sizes differ, a dutch trace needs that, and where they do not it comes to the same.
#
# Source: Sutton and Barto (2nd edition), chapter 12.

TraceType = Literal["accumulating", "replacing", "dutch"]
ACCUMULATING, REPLACING, DUTCH = 0, 1, 2
TRACE_TYPES = {"accumulating": ACCUMULATING, "replacing": REPLACING, "dutch": DUTCH}

# A trace below it is forgotten: what it would still move lies below the rounding of most tables.
SMALLEST_TRACE = 1e-12


class Traces(NamedTuple):
    """Entries that have a trace, in no order that means anything."""

    states: Ints  # shape (n_envs, S * A)
    actions: Ints  # shape (n_envs, S * A)
    sizes: Floats  # traces times step sizes, shape (n_envs, S * A)
    lengths: Ints  # how many there are, shape (n_envs,)
    # What the last step took the value of the present state to be, shape (n_envs,).
    expected: Floats


@by_type
def trace_kept(agent: TabularAgent, env: Any) -> float:
    """The share of earlier traces that survives the action: 1, or 0 where it cuts them."""
    raise CompiledOnlyError


@inlined
def kept_whole(agent: TabularAgent, env: Any) -> float:
    """Whatever is done is what is learnt about."""
    return 1.0


@inlined
def fade(traces: Traces, i: int, factor: float, state: int, action: int) -> float:
    """Let all traces fade, forget the smallest, and take one out, which is returned."""
    found, n_left = 0.0, 0
    for k in range(traces.lengths[i]):
        size = traces.sizes[i, k] * factor
        if traces.states[i, k] == state and traces.actions[i, k] == action:
            found = size
        elif abs(size) > SMALLEST_TRACE:
            traces.states[i, n_left] = traces.states[i, k]
            traces.actions[i, n_left] = traces.actions[i, k]
            traces.sizes[i, n_left] = size
            n_left += 1
    traces.lengths[i] = n_left
    return found


@inlined
def visited(trace_type: int, size: float, earlier: float) -> float:
    """The trace of the entry that was just visited, both times its step size."""
    if trace_type == REPLACING:
        return size
    if trace_type == DUTCH:
        return earlier * (1.0 - size) + size
    return earlier + size


@inlined
def learn_along_traces(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Move all entries that have a trace; returns the absolute TD error.

    A dutch trace makes up for what the last step took this one to be worth, and has changed since
    then: with it the result is that of the online lambda-return (van Seijen et al., 2016).
    """
    settings, values, traces = agent.settings, agent.tables.values, agent.memory
    value = values[0, env.obs, env.action]
    ahead = 0.0 if env.terminated else value_ahead(agent, env, progress, 0)
    env.target = env.reward + settings.gamma * ahead
    env.td_error = td_error = env.target - value
    size = count_visit(agent, progress, 0, env.obs, env.action)
    factor = settings.gamma * settings.trace_decay * trace_kept(agent, env)
    earlier = fade(traces, i, factor, env.obs, env.action)
    n_others = traces.lengths[i]
    has_past = n_others > 0 or earlier != 0.0
    late = value - traces.expected[i] if settings.trace_kind == DUTCH and has_past else 0.0
    for k in range(n_others):
        change = (td_error + late) * traces.sizes[i, k]
        values[0, traces.states[i, k], traces.actions[i, k]] += change
    trace = visited(settings.trace_kind, size, earlier)
    values[0, env.obs, env.action] += td_error * trace + late * (trace - size)
    traces.states[i, n_others] = env.obs
    traces.actions[i, n_others] = env.action
    traces.sizes[i, n_others] = trace
    traces.lengths[i] = 0 if env.done else n_others + 1
    traces.expected[i] = ahead
    return float(abs(td_error))


class TraceAlgorithm(EpisodicAlgorithm):
    """Learns from each step about all entries that have led to it, the more recent the more.

    Where an episode is truncated, the value of the state that it was cut off in counts. An entry
    whose trace times step size falls below 1e-12 is forgotten.

    Args:
        policy: as in `TabularAlgorithm`.
        env: as in `TabularAlgorithm`.
        learning_rate: as in `TabularAlgorithm`; an entry's trace keeps that of its last visit.
        trace_decay: lambda, in [0, 1]: 0 learns about the last step alone.
        trace_type: what a visit makes of the trace e that is left of earlier ones:
            ``"accumulating"`` e + 1; ``"replacing"`` 1, and the traces of the state's other
            actions stay; ``"dutch"`` e + 1 - learning_rate * e, with the update of true online
            TD(lambda).
        kwargs: as in `TabularAlgorithm`.
    """

    parameters = {"trace_decay": np.float64, "trace_kind": np.int64}  # noqa: RUF012
    learn_in = learn_along_traces
    trace_kept = kept_whole

    def __init__(
        self,
        policy: str | type[BasePolicy] = "QTablePolicy",
        env: GymEnv | str | None = None,
        learning_rate: StepSize = 0.1,
        trace_decay: float = 0.9,
        trace_type: TraceType = "replacing",
        **kwargs: Any,
    ) -> None:
        self.trace_decay = trace_decay
        self.trace_type = trace_type
        super().__init__(policy, env, learning_rate, **kwargs)

    @property
    def trace_kind(self) -> int:
        """The number of ``trace_type``."""
        return TRACE_TYPES[self.trace_type]

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_option("trace_type", self.trace_type, TraceType)
        check_share(settings_of(self, "trace_decay"))

    def _make_memory(self) -> Traces:
        sizes = cast(Any, (self.observation_space, self.action_space))
        shape = (self.n_envs, int(sizes[0].n) * int(sizes[1].n))
        states, actions = (np.zeros(shape, dtype=np.int64) for _ in range(2))
        lengths = np.zeros(self.n_envs, dtype=np.int64)
        return Traces(states, actions, np.zeros(shape), lengths, np.zeros(self.n_envs))


# SARSA(lambda).


class SARSALambda(TraceAlgorithm):
    """SARSA(lambda) (Rummery and Niranjan, 1994; Sutton and Barto, section 12.7).

    With dutch traces it is true online SARSA(lambda); with ``trace_decay`` 0 it is SARSA.
    """

    commit = commit_to_next_action
    next_value = committed_value


# Watkins's Q(lambda).


@inlined
def note_greediness(agent: TabularAgent, env: Any, progress: Any) -> None:
    """The greedy policy's probability of the action, while the tables are those it was chosen by.

    All best actions are one to it.
    """
    best = highest_value(values_at(agent, env.obs, 0).values)
    env.probability = 1.0 if agent.tables.values[0, env.obs, env.action] == best else 0.0


@inlined
def cut_where_exploring(agent: TabularAgent, env: Any) -> float:
    """What the greedy policy would not have done says nothing of what led to it."""
    return float(env.probability)


class QLambda(TraceAlgorithm):
    """Watkins's Q(lambda) (Watkins, 1989; Sutton and Barto, section 12.10).

    Traces are cut where an action is taken that is none of the best; with ``trace_decay`` 0 it is
    Q-learning.
    """

    commit = note_greediness
    next_value = best_next_value
    trace_kept = cut_where_exploring
