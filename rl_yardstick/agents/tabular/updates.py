"""Tables of action values: acting on them, and moving entries towards targets."""

from __future__ import annotations

from typing import Any, NamedTuple

from rl_yardstick.agents.common.exploration import (
    GAUSSIAN_NOISE,
    choose_action,
    highest_value,
    random_action,
)
from rl_yardstick.agents.common.settings import step_size
from rl_yardstick.agents.compiled.loop import by_type, by_type_or_this, move_on
from rl_yardstick.agents.compiled.references import generator_of, next_uniform
from rl_yardstick.agents.compiled.worlds import UNDECIDED
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints


class Room(NamedTuple):
    """Scratch arrays, without meaning between two calls."""

    values: Floats  # a number for each allowed action, shape (n,)
    actions: Ints  # these actions, in order, shape (n,)
    draws: Floats  # the random numbers of one choice, shape (draws_per_choice,)


class Tables(NamedTuple):
    """The tables of an agent, in the memory of its policy, and the action masks."""

    values: Floats  # action values, shape (T, S, A)
    visit_counts: Ints  # updates of each entry so far, shape (T, S, A)
    # The allowed actions at each observation, bool of shape (S, A); all actions if a row is all
    # False (mask unknown). Without masks it has no rows.
    allowed: Bools


@inlined
def room_at(tables: Tables, obs: int, room: Room) -> Room:
    """The part of the room for the actions that are allowed at ``obs``, which it lists."""
    if len(tables.allowed) == 0:
        return room
    actions, n_allowed = room.actions, 0
    for action in range(len(actions)):
        if tables.allowed[obs, action]:
            actions[n_allowed] = action
            n_allowed += 1
    if n_allowed == 0:
        n_allowed = len(actions)
        for action in range(n_allowed):
            actions[action] = action
    return Room(room.values[:n_allowed], actions[:n_allowed], room.draws)


@inlined
def with_mean_values(tables: Tables, obs: int, room: Room) -> Room:
    """The room, with the means of the tables' values of its actions; do not change them."""
    if len(tables.allowed) == 0 and tables.values.shape[0] == 1:
        return Room(tables.values[0, obs], room.actions, room.draws)
    for k in range(len(room.values)):
        action = room.actions[k]
        room.values[k] = tables.values[0, obs, action]
        if tables.values.shape[0] > 1:
            room.values[k] = 0.5 * (room.values[k] + tables.values[1, obs, action])
    return room


@inlined
def best_value(tables: Tables, obs: int, room: Room) -> float:
    """The highest of the mean values of the actions that are allowed at ``obs``."""
    return highest_value(with_mean_values(tables, obs, room_at(tables, obs, room)).values)


# Acting on a table of action values, and moving its entries towards their targets.
#
# Compiled functions, shared by the interpreted and the compiled training loop. An update bootstraps
# from ``values`` of shape (T, S, A): one table, or two for double Q-learning. After termination the
# discount is 0; a truncated episode still bootstraps. An algorithm defines `next_value`, and
# `commit` if it chooses its next action before the update.
#
# Source: Sutton and Barto (2nd edition), chapter 6.


class TabularAgent(NamedTuple):
    """An agent for compiled functions."""

    settings: Any  # a record of its class's type
    tables: Tables
    room: Room  # scratch arrays
    rng: Any  # a handle of its generator
    memory: Any  # further arrays of its algorithm; see `TabularAlgorithm`
    seen: Any  # how observations are read; they are numbers, so it is not used


@by_type
def next_value(agent: Any, env: Any, progress: Any, table: int) -> float:
    """The value of the next state in the target of an update of ``table``.

    ``agent.room.values`` has the values of that table in ``env.next_obs``, for the allowed actions
    in ``agent.room.actions``; ``env.uniform`` is in [0, 1), a random number if there are several
    tables.
    """
    raise NotImplementedError


@by_type_or_this
def commit(agent: Any, env: Any, progress: Any) -> None:
    """Choose ``env.next_action``, or store anything else that is needed from unchanged tables."""


@inlined
def exploration_rate(agent: TabularAgent, progress: Any) -> float:
    """The present exploration rate: epsilon, temperature or standard deviation."""
    if agent.settings.strategy == GAUSSIAN_NOISE:
        return float(progress.exploration / (progress.episodes + 1))
    return float(progress.exploration)


@inlined
def choose(agent: TabularAgent, obs: int, progress: Any) -> int:
    """Choose an allowed action by the mean of the tables' values."""
    settings, tables = agent.settings, agent.tables
    room = room_at(tables, obs, agent.room)
    if settings.strategy == GAUSSIAN_NOISE:
        for k in range(len(room.draws)):
            room.draws[k] = generator_of(agent.rng).standard_normal()
    else:
        for k in range(len(room.draws)):
            room.draws[k] = next_uniform(agent.rng)
    rate = exploration_rate(agent, progress)
    chosen = random_action(settings.strategy, len(room.values), rate, room.draws)
    if chosen < 0:
        values = with_mean_values(tables, obs, room).values
        chosen = choose_action(settings.strategy, values, rate, settings.tie_scale, room.draws)
    return int(room.actions[chosen])


@inlined
def act_on_values(agent: TabularAgent, env: Any, progress: Any) -> None:
    """Take the action that the agent has committed to, or choose one."""
    env.action = env.next_action
    env.next_action = UNDECIDED
    if env.action == UNDECIDED:
        env.action = choose(agent, env.obs, progress)


@inlined
def values_at(agent: TabularAgent, obs: int, table: int) -> Room:
    """The room, filled with a table's values of the actions that are allowed at ``obs``."""
    room = room_at(agent.tables, obs, agent.room)
    for k in range(len(room.values)):
        room.values[k] = agent.tables.values[table, obs, room.actions[k]]
    return room


@inlined
def value_ahead(agent: TabularAgent, env: Any, progress: Any, table: int) -> float:
    """`next_value`, after filling the room that it needs."""
    room = values_at(agent, env.next_obs, table)
    ahead = TabularAgent(agent.settings, agent.tables, room, agent.rng, agent.memory, agent.seen)
    return float(next_value(ahead, env, progress, table))


@inlined
def count_visit(agent: TabularAgent, progress: Any, table: int, obs: int, action: int) -> float:
    """Count an update of an entry, and return its step size."""
    visit_counts = agent.tables.visit_counts
    visit_counts[table, obs, action] += 1
    count = visit_counts[table, obs, action]
    return float(step_size(progress.learning_rate, agent.settings.averages_samples, count))


@inlined
def move_towards(
    agent: TabularAgent, progress: Any, table: int, obs: int, action: int, target: float
) -> float:
    """Move one entry towards its target, and return its error before."""
    values = agent.tables.values
    size = count_visit(agent, progress, table, obs, action)
    error = target - values[table, obs, action]
    values[table, obs, action] += size * error
    return float(error)


@inlined
def update(agent: TabularAgent, env: Any, progress: Any) -> float:
    """Move one entry towards its target, and return the TD error.

    ``env.uniform`` decides which of two tables is updated.
    """
    table = int(env.uniform * agent.tables.values.shape[0])
    discount = 0.0 if env.terminated else agent.settings.gamma
    target = env.reward + discount * value_ahead(agent, env, progress, table)
    td_error = move_towards(agent, progress, table, env.obs, env.action, target)
    env.target, env.td_error = target, td_error
    return float(td_error)


@inlined
def td_learning(agent: TabularAgent, envs: Any, progress: Any) -> None:
    """All commitments, then all random numbers of the updates, then the updates in order."""
    for i in range(len(envs)):
        commit(agent, envs[i], progress)
    if agent.tables.values.shape[0] > 1:
        for i in range(len(envs)):
            envs[i].uniform = next_uniform(agent.rng)
    total_error = 0.0
    for i in range(len(envs)):
        env = envs[i]
        if not (env.terminated and agent.settings.skip_terminal_update):
            total_error += abs(update(agent, env, progress))
        env.obs = env.new_obs
        if env.done:
            env.next_action = UNDECIDED
    progress.mean_td_error = total_error if len(envs) == 1 else total_error / len(envs)


# Learning from the environments one after the other, for agents that plan or keep more than a step.

NOTHING_LEARNT = -1.0


@by_type
def learn_in(agent: Any, env: Any, progress: Any, i: int) -> float:
    """Learn from the step of environment ``i``; the absolute TD error, or `NOTHING_LEARNT`."""
    raise NotImplementedError


@inlined
def learning_in_turn(agent: Any, envs: Any, progress: Any) -> None:
    """All commitments, then the environments in order."""
    for i in range(len(envs)):
        commit(agent, envs[i], progress)
    total_error, n_learnt = 0.0, 0
    for i in range(len(envs)):
        env = envs[i]
        error = learn_in(agent, env, progress, i)
        if error != NOTHING_LEARNT:
            total_error += error
            n_learnt += 1
        move_on(agent.seen, env)
        if env.done:
            env.next_action = UNDECIDED
    if n_learnt > 0:
        progress.mean_td_error = total_error / n_learnt
