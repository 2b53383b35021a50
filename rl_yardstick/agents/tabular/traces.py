"""Methods with eligibility traces: SARSA(lambda) and Watkins's Q(lambda)."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, cast

import numpy as np

from rl_yardstick.agents.common.exploration import highest_value
from rl_yardstick.agents.common.settings import SHARE
from rl_yardstick.agents.compiled.loop import CompiledOnlyError, by_type
from rl_yardstick.agents.tabular.n_step import EpisodicAlgorithm
from rl_yardstick.agents.tabular.one_step import (
    best_next_value,
    commit_to_next_action,
    committed_value,
)
from rl_yardstick.agents.tabular.updates import TabularAgent, count_visit, value_ahead, values_at
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats, Ints

# Eligibility traces of the entries that an episode has visited, and learning along them.
#
# A stored trace is multiplied by the step size of the entry's visit: with varying step sizes a
# dutch trace needs that; with a constant one it makes no difference.
#
# Source: Sutton and Barto (2nd edition), chapter 12.

TraceType = Literal["accumulating", "replacing", "dutch"]
ACCUMULATING, REPLACING, DUTCH = 0, 1, 2
TRACE_TYPES = {"accumulating": ACCUMULATING, "replacing": REPLACING, "dutch": DUTCH}

# Smaller traces are dropped: their effect is below the rounding error of most tables.
SMALLEST_TRACE = 1e-12


class Traces(NamedTuple):
    """Entries with a trace, in arbitrary order."""

    states: Ints  # shape (n_envs, S * A)
    actions: Ints  # shape (n_envs, S * A)
    sizes: Floats  # traces times step sizes, shape (n_envs, S * A)
    lengths: Ints  # number of entries, shape (n_envs,)
    # The next value in the last step's target, shape (n_envs,).
    expected: Floats


@by_type
def trace_kept(agent: TabularAgent, env: Any) -> float:
    """The factor of earlier traces after the action: 1, or 0 if it cuts them."""
    raise CompiledOnlyError


@inlined
def kept_whole(agent: TabularAgent, env: Any) -> float:
    """On-policy methods never cut traces."""
    return 1.0


@inlined
def fade(traces: Traces, i: int, factor: float, state: int, action: int) -> float:
    """Decay all traces, drop the smallest, and remove and return that of an entry."""
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
    """The new trace of the visited entry; both traces are multiplied by its step size."""
    if trace_type == REPLACING:
        return size
    if trace_type == DUTCH:
        return earlier * (1.0 - size) + size
    return earlier + size


@inlined
def learn_along_traces(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Move all entries that have a trace; returns the absolute TD error.

    With dutch traces the update corrects for the change in Q(s, a) since the previous step, which
    makes it equal to the online lambda-return (van Seijen et al., 2016).
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
    """Updates after each step all entries that have led to it, by their eligibility traces.

    A truncated episode bootstraps from its last state. An entry is dropped when its trace times
    step size falls below 1e-12.

    Args:
        args: as in `TabularAlgorithm`.
        learning_rate: as in `TabularAlgorithm`; an entry's trace keeps that of its last visit.
        trace_decay: lambda, in [0, 1]; with 0 only the last step's entry is updated.
        trace_type: the new trace at a visit, given the decayed trace e of earlier visits:
            ``"accumulating"`` e + 1; ``"replacing"`` 1, and the traces of the state's other
            actions stay; ``"dutch"`` e + 1 - learning_rate * e, with the update of true online
            TD(lambda).
        kwargs: as in `TabularAlgorithm`.
    """

    parameters = {"trace_decay": np.float64, "trace_kind": np.int64}  # noqa: RUF012
    ranges = {"trace_decay": SHARE}  # noqa: RUF012
    learn_in = learn_along_traces
    trace_kept = kept_whole

    def __init__(
        self,
        *args: Any,
        trace_decay: float = 0.9,
        trace_type: TraceType = "replacing",
        **kwargs: Any,
    ) -> None:
        self.trace_decay = trace_decay
        self.trace_type = trace_type
        super().__init__(*args, **kwargs)

    @property
    def trace_kind(self) -> int:
        """The number of ``trace_type``."""
        return TRACE_TYPES[self.trace_type]

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
    """Store whether the action is a best one (probability 1 or 0), before any table changes."""
    best = highest_value(values_at(agent, env.obs, 0).values)
    env.probability = 1.0 if agent.tables.values[0, env.obs, env.action] == best else 0.0


@inlined
def cut_where_exploring(agent: TabularAgent, env: Any) -> float:
    """Cut the traces after an action that is not greedy."""
    return float(env.probability)


class QLambda(TraceAlgorithm):
    """Watkins's Q(lambda) (Watkins, 1989; Sutton and Barto, section 12.10).

    An action that is not greedy cuts the traces; with ``trace_decay`` 0 it is Q-learning.
    """

    commit = note_greediness
    next_value = best_next_value
    trace_kept = cut_where_exploring
