"""Methods that learn from several steps: n-step SARSA, tree backup, and traces."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from rl_yardstick.agents.common.exploration import action_probability, expected_value, highest_value
from rl_yardstick.agents.common.settings import SHARE, whole
from rl_yardstick.agents.compiled.loop import by_type_or_this
from rl_yardstick.agents.tabular.algorithm import TabularAlgorithm
from rl_yardstick.agents.tabular.q_learning_and_sarsa import (
    best_next_value,
    commit_to_next_action,
    committed_value,
)
from rl_yardstick.agents.tabular.updates import (
    NOTHING_LEARNT,
    Room,
    TabularAgent,
    count_visit,
    exploration_rate,
    learning_in_turn,
    move_towards,
    value_ahead,
    values_at,
)
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Floats, Ints

# The probabilities of actions, and the base of agents with a memory of their episodes.


@inlined
def place_of(room: Room, action: int) -> int:
    """The index of an action's value in the room; -1 if it is not allowed."""
    for k in range(len(room.values)):
        if room.actions[k] == action:
            return k
    return -1


@inlined
def probability_of(agent: TabularAgent, room: Room, action: int, progress: Any) -> float:
    """The probability of the action under the exploring policy, by the values in the room."""
    place = place_of(room, action)
    if place < 0:
        return 0.0
    settings, rate = agent.settings, exploration_rate(agent, progress)
    return float(
        action_probability(settings.strategy, room.values, rate, settings.tie_scale, place)
    )


class EpisodicAlgorithm(TabularAlgorithm):
    """A tabular agent that stores more of an episode than its last step; see the base class.

    Several environments share the table; each has its own memory. ``skip_terminal_update`` is not
    supported, because the agent learns from a reward at many steps.

    Raises:
        ValueError: as in the base class, and with ``skip_terminal_update``.
    """

    learn_from_step = learning_in_turn

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.skip_terminal_update:
            raise ValueError(
                f"{type(self).__name__} learns from the last reward at many steps: "
                "skip_terminal_update is for the agents that learn from single steps"
            )


# The last n steps of each environment, and learning from them together.
#
# Source: Sutton and Barto (2nd edition), chapter 7.


class Windows(NamedTuple):
    """Steps that the agent has not learnt from yet, a ring for each environment."""

    states: Ints  # shape (n_envs, n_steps)
    actions: Ints  # shape (n_envs, n_steps)
    rewards: Floats  # shape (n_envs, n_steps)
    oldest: Ints  # index of the first step in the ring, shape (n_envs,)
    lengths: Ints  # number of steps in it, shape (n_envs,)


@by_type_or_this
def backed_up(agent: TabularAgent, progress: Any, obs: int, action: int, later: float) -> float:
    """The backed-up value of a state in the window: ``later``, the return after its action."""
    return later


@inlined
def windowed_return(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """The return of the oldest step in the window, from the newest backwards."""
    windows, n_places = agent.memory, agent.memory.states.shape[1]
    later = 0.0 if env.terminated else value_ahead(agent, env, progress, 0)
    after = windows.lengths[i] - 1
    for k in range(after, -1, -1):
        place = (windows.oldest[i] + k) % n_places
        if k < after:
            next_place = (place + 1) % n_places
            state, action = windows.states[i, next_place], windows.actions[i, next_place]
            later = backed_up(agent, progress, state, action, later)
        later = windows.rewards[i, place] + agent.settings.gamma * later
    return float(later)


@inlined
def learn_oldest(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Learn from the oldest step in the window and drop it; returns its absolute error."""
    windows, place = agent.memory, agent.memory.oldest[i]
    target = windowed_return(agent, env, progress, i)
    state, action = windows.states[i, place], windows.actions[i, place]
    error = move_towards(agent, progress, 0, state, action, target)
    env.target, env.td_error = target, error
    windows.oldest[i] = (place + 1) % windows.states.shape[1]
    windows.lengths[i] -= 1
    return abs(error)


@inlined
def learn_from_window(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Learn from the step n steps ago, and at the end of an episode from all remaining steps."""
    windows, n_places = agent.memory, agent.memory.states.shape[1]
    place = (windows.oldest[i] + windows.lengths[i]) % n_places
    windows.states[i, place] = env.obs
    windows.actions[i, place] = env.action
    windows.rewards[i, place] = env.reward
    windows.lengths[i] += 1
    if not env.done and windows.lengths[i] < n_places:
        return NOTHING_LEARNT
    error, n_learnt = learn_oldest(agent, env, progress, i), 1
    while env.done and windows.lengths[i] > 0:
        error += learn_oldest(agent, env, progress, i)
        n_learnt += 1
        env.target = env.td_error = math.nan  # there is more than one
    return error / n_learnt


class WindowAlgorithm(EpisodicAlgorithm):
    """Learns from the rewards of ``n_steps`` steps, and bootstraps from the state after them.

    A truncated episode bootstraps from its last state.

    Args:
        learning_rate: as in `TabularAlgorithm`.
        n_steps: number of rewards in a target, at least 1.
    """

    learn_in = learn_from_window
    ranges = {"n_steps": whole(1)}  # noqa: RUF012

    def __init__(self, *args: Any, n_steps: int = 4, **kwargs: Any) -> None:
        self.n_steps = n_steps
        super().__init__(*args, **kwargs)

    def _make_memory(self) -> Windows:
        shape = (self.n_envs, self.n_steps)
        states, actions = (np.zeros(shape, dtype=np.int64) for _ in range(2))
        oldest, lengths = (np.zeros(self.n_envs, dtype=np.int64) for _ in range(2))
        return Windows(states, actions, np.zeros(shape), oldest, lengths)


class NStepSARSA(WindowAlgorithm):
    """n-step SARSA (Sutton and Barto, section 7.2); with one step it is SARSA."""

    commit = commit_to_next_action
    next_value = committed_value


TargetPolicy = Literal["exploring", "greedy"]
GREEDY = 1


@inlined
def target_mean(agent: TabularAgent, room: Room, progress: Any) -> float:
    """The mean of the values in the room under the target policy."""
    if agent.settings.target_policy == GREEDY:
        return highest_value(room.values)
    rate = exploration_rate(agent, progress)
    return float(expected_value(agent.settings.strategy, room.values, rate))


@inlined
def target_probability(agent: TabularAgent, room: Room, action: int, progress: Any) -> float:
    """The target policy's probability of the action; the greedy one gives 1 to any best action."""
    if agent.settings.target_policy != GREEDY:
        return probability_of(agent, room, action, progress)
    place = place_of(room, action)
    return 1.0 if place >= 0 and room.values[place] == highest_value(room.values) else 0.0


@inlined
def target_value_ahead(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """The mean next value under the target policy."""
    return target_mean(agent, agent.room, progress)


@inlined
def tree_backed_up(
    agent: TabularAgent, progress: Any, obs: int, action: int, later: float
) -> float:
    """The mean value, with the return after the taken action in place of its value."""
    room = values_at(agent, obs, 0)
    probability = target_probability(agent, room, action, progress)
    surprise = later - agent.tables.values[0, obs, action]
    return float(target_mean(agent, room, progress) + probability * surprise)


class NStepTreeBackup(WindowAlgorithm):
    """n-step tree backup (Precup et al., 2000; Sutton and Barto, section 7.5).

    For each state in the window it takes the mean value under the target policy, with the return
    after the taken action in place of that action's value. So it is off-policy without importance
    sampling. With one step it is Expected SARSA or, for the greedy target policy, Q-learning.

    Args:
        target_policy: the policy whose values it learns: the ``"exploring"`` policy, with the
            present epsilon or temperature, or the ``"greedy"`` one.
    """

    parameters = {"target_policy": np.int64}  # noqa: RUF012
    next_value = target_value_ahead
    backed_up = tree_backed_up

    def __init__(
        self, *args: Any, target_policy: TargetPolicy = "exploring", **kwargs: Any
    ) -> None:
        self.target_policy = target_policy
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.target_policy != "greedy":
            self._refuse_gaussian_noise("target_policy: exploring")


# Eligibility traces of the entries that an episode has visited, and learning along them.
#
# A stored trace is multiplied by the step size of the entry's visit: with varying step sizes a
# dutch trace needs that; with a constant one it makes no difference.
#
# Source: Sutton and Barto (2nd edition), chapter 12.

TraceType = Literal["accumulating", "replacing", "dutch"]
ACCUMULATING, REPLACING, DUTCH = range(3)

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


@by_type_or_this
def trace_kept(agent: TabularAgent, env: Any) -> float:
    """The factor of earlier traces after the action: 1, or 0 if it cuts them."""
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
    late = value - traces.expected[i] if settings.trace_type == DUTCH and has_past else 0.0
    for k in range(n_others):
        change = (td_error + late) * traces.sizes[i, k]
        values[0, traces.states[i, k], traces.actions[i, k]] += change
    trace = visited(settings.trace_type, size, earlier)
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
        learning_rate: as in `TabularAlgorithm`; an entry's trace keeps that of its last visit.
        trace_decay: lambda, in [0, 1]; with 0 only the last step's entry is updated.
        trace_type: the new trace at a visit, given the decayed trace e of earlier visits:
            ``"accumulating"`` e + 1; ``"replacing"`` 1, and the traces of the state's other
            actions stay; ``"dutch"`` e + 1 - learning_rate * e, with the update of true online
            TD(lambda).
    """

    parameters = {"trace_decay": np.float64, "trace_type": np.int64}  # noqa: RUF012
    ranges = {"trace_decay": SHARE}  # noqa: RUF012
    learn_in = learn_along_traces

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

    def _make_memory(self) -> Traces:
        sizes = cast(Any, (self.observation_space, self.action_space))
        shape = (self.n_envs, int(sizes[0].n) * int(sizes[1].n))
        states, actions = (np.zeros(shape, dtype=np.int64) for _ in range(2))
        lengths = np.zeros(self.n_envs, dtype=np.int64)
        return Traces(states, actions, np.zeros(shape), lengths, np.zeros(self.n_envs))


class SARSALambda(TraceAlgorithm):
    """SARSA(lambda) (Rummery and Niranjan, 1994; Sutton and Barto, section 12.7).

    With dutch traces it is true online SARSA(lambda); with ``trace_decay`` 0 it is SARSA.
    """

    commit = commit_to_next_action
    next_value = committed_value


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
