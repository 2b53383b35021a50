"""Prioritised sweeping: planning first where values change most."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np

from rl_yardstick.agents.common.settings import NOT_NEGATIVE, step_size, whole
from rl_yardstick.agents.tabular.dyna import ModelArray, ModelKeeper, ModelPolicy, note_outcome
from rl_yardstick.agents.tabular.updates import TabularAgent, best_value
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints

# A learnt model with the predecessors of each state, and a priority queue of pairs to update.
#
# Compiled functions. A pair is the number ``obs * A + action``. Pairs that lead to the same state
# form a doubly linked list; the queue is a binary heap, in which each pair has its place.

NONE = -1


class SweepingModel(NamedTuple):
    """The last outcome of each pair, and the queue."""

    next_obs: Ints
    rewards: Floats
    terminated: Bools
    counts: Ints
    first_into: Ints  # the first pair that leads to a state, or `NONE`, shape (S,)
    behind: Ints  # the next pair that leads to the same state, or `NONE`, shape (S * A,)
    before: Ints  # the previous pair that leads to the same state, or `NONE`, shape (S * A,)
    queue: Ints  # the heap, the most urgent pair first, shape (S * A,)
    n_queued: Ints  # number of pairs in the heap, shape (1,)
    place: Ints  # index of a pair in the heap, or `NONE`, shape (S * A,)
    urgency: Floats  # priority of a pair, shape (S * A,)


@inlined
def remember_step(model: SweepingModel, env: Any) -> None:
    """Store the environment's last step, and the state to which its pair leads."""
    pair = env.obs * model.counts.shape[1] + env.action
    if model.counts[env.obs, env.action] > 0 and not model.terminated[env.obs, env.action, 0]:
        _unlink(model, pair, model.next_obs[env.obs, env.action, 0])
    note_outcome(model, env)
    # After a termination the pair leads to no state.
    if not env.terminated:
        _link(model, pair, env.next_obs)


@inlined
def _link(model: SweepingModel, pair: int, obs: int) -> None:
    """Put a pair at the head of the list of pairs that lead to a state."""
    first = model.first_into[obs]
    model.before[pair] = NONE
    model.behind[pair] = first
    if first != NONE:
        model.before[first] = pair
    model.first_into[obs] = pair


@inlined
def _unlink(model: SweepingModel, pair: int, obs: int) -> None:
    before, behind = model.before[pair], model.behind[pair]
    if before == NONE:
        model.first_into[obs] = behind
    else:
        model.behind[before] = behind
    if behind != NONE:
        model.before[behind] = before


@inlined
def _put(model: SweepingModel, pair: int, place: int) -> None:
    model.queue[place] = pair
    model.place[pair] = place


@inlined
def enqueue(model: SweepingModel, pair: int, urgency: float) -> None:
    """Put a pair into the queue; a pair that is there already keeps at least its urgency."""
    place = model.place[pair]
    if place == NONE:
        if model.n_queued[0] == len(model.queue):  # in a damaged file only
            return
        place = model.n_queued[0]
        model.n_queued[0] += 1
    elif urgency <= model.urgency[pair]:
        return
    model.urgency[pair] = urgency
    while place > 0:
        above = (place - 1) // 2
        if model.urgency[model.queue[above]] >= urgency:
            break
        _put(model, model.queue[above], place)
        place = above
    _put(model, pair, place)


@inlined
def most_urgent(model: SweepingModel) -> int:
    """Take the most urgent pair out of the queue, which must not be empty."""
    first = model.queue[0]
    model.place[first] = NONE
    model.n_queued[0] -= 1
    n = model.n_queued[0]
    if n > 0:
        _sink(model, model.queue[n], n)
    return int(first)


@inlined
def _sink(model: SweepingModel, pair: int, n: int) -> None:
    """Sift a pair down from the root of a heap of ``n``."""
    place = 0
    while 2 * place + 1 < n:
        below = 2 * place + 1
        if below + 1 < n and (
            model.urgency[model.queue[below + 1]] > model.urgency[model.queue[below]]
        ):
            below += 1
        if model.urgency[model.queue[below]] <= model.urgency[pair]:
            break
        _put(model, model.queue[below], place)
        place = below
    _put(model, pair, place)


class SweepingPolicy(ModelPolicy):
    """Greedy in a table, with a `SweepingModel` beside it."""

    model_type: ClassVar[Any] = SweepingModel

    def _arrays(self) -> dict[str, ModelArray]:
        n_states, n_actions = self.visit_counts.shape[1:]
        n_pairs = n_states * n_actions
        of_pairs = ModelArray((n_pairs,), n_pairs, NONE)
        return {
            **super()._arrays(),
            "first_into": ModelArray((n_states,), n_pairs, NONE),
            **dict.fromkeys(("behind", "before", "place"), of_pairs),
            "queue": ModelArray((n_pairs,), n_pairs),
            "n_queued": ModelArray((1,), n_pairs + 1),
            "urgency": ModelArray((n_pairs,), kind=np.float64),
        }


@inlined
def expected_error(agent: TabularAgent, pair: int) -> float:
    """The TD error of a pair's outcome in the model."""
    model, values = agent.memory, agent.tables.values
    obs, action = pair // values.shape[2], pair % values.shape[2]
    target = model.rewards[obs, action, 0]
    if not model.terminated[obs, action, 0]:
        following = best_value(agent.tables, model.next_obs[obs, action, 0], agent.room)
        target += agent.settings.gamma * following
    return float(target - values[0, obs, action])


@inlined
def notice(agent: TabularAgent, pair: int) -> float:
    """Queue a pair if its error is above the threshold; returns the error."""
    error = expected_error(agent, pair)
    if abs(error) > agent.settings.threshold:
        enqueue(agent.memory, pair, abs(error))
    return error


@inlined
def sweep(agent: TabularAgent, progress: Any) -> None:
    """Update the most urgent pair, and queue the pairs that lead to its state."""
    model, tables = agent.memory, agent.tables
    pair = most_urgent(model)
    obs, action = pair // tables.values.shape[2], pair % tables.values.shape[2]
    count = tables.visit_counts[0, obs, action]
    size = step_size(progress.learning_rate, agent.settings.averages_samples, max(count, 1))
    tables.values[0, obs, action] += size * expected_error(agent, pair)
    leading = model.first_into[obs]
    for _ in range(len(model.behind)):  # lists of a damaged file may have no end
        if leading == NONE:
            break
        notice(agent, leading)
        leading = model.behind[leading]


@inlined
def remember_and_sweep(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Store the environment's step, and update the most urgent pairs."""
    if env.terminated and agent.settings.skip_terminal_update:
        return 0.0
    remember_step(agent.memory, env)
    agent.tables.visit_counts[0, env.obs, env.action] += 1
    error = abs(notice(agent, env.obs * agent.tables.values.shape[2] + env.action))
    for _ in range(agent.settings.planning_steps):
        if agent.memory.n_queued[0] == 0:
            break
        sweep(agent, progress)
    return error


class PrioritizedSweeping(ModelKeeper):
    """Prioritised sweeping: updates pairs with the largest errors first (Sutton and Barto, 8.4).

    A step with a large TD error is queued by its size. When values of a state change, the pairs
    that lead to it are queued, too, so that changes propagate backwards. All updates come from the
    queue. The model has the last outcome of each pair of state and action, which is enough in
    deterministic environments; in stochastic ones, values follow the last outcome. Source: Moore
    and Atkeson ("Prioritized sweeping", 1993).

    Updates by planning are not counted: ``"sample_average"`` is 1/N after N real visits.

    Args:
        planning_steps: maximal number of updates after each step of an environment.
        threshold: errors above this are queued.
    """

    policy_aliases = {"QTablePolicy": SweepingPolicy}  # noqa: RUF012
    parameters = {"planning_steps": np.int64, "threshold": np.float64}  # noqa: RUF012
    ranges = {"planning_steps": whole(0), "threshold": NOT_NEGATIVE}  # noqa: RUF012
    learn_in = remember_and_sweep

    def __init__(
        self, *args: Any, planning_steps: int = 5, threshold: float = 1e-4, **kwargs: Any
    ) -> None:
        self.planning_steps = planning_steps
        self.threshold = threshold
        super().__init__(*args, **kwargs)
