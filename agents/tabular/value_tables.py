"""What a tabular agent knows, as compiled functions see it, and room to work with it."""

from __future__ import annotations

from typing import Any, NamedTuple

from agents.common.exploration import highest_value
from agents.compiled.dispatch import CompiledOnlyError, by_type
from machine_code.compiling import inlined
from mdp.array_types import Bools, Floats, Ints


class Room(NamedTuple):
    """Where numbers are worked out; what it holds between two calls means nothing.

    Attributes:
        values: a number for each action that is allowed, shape (n,).
        actions: which actions these are, in order, shape (n,).
        draws: the random numbers of one choice, shape (draws_per_choice,).
    """

    values: Floats
    actions: Ints
    draws: Floats


@by_type
def room_at(tables: Any, obs: int, room: Room) -> Room:
    """The room for the actions that are allowed at ``obs``."""
    raise CompiledOnlyError


@by_type
def action_at(tables: Any, room: Room, k: int) -> int:
    """The action whose number is ``room.values[k]``."""
    raise CompiledOnlyError


@by_type
def with_mean_values(tables: Any, obs: int, room: Room) -> Room:
    """The room, with the means of the tables' values of its actions, to be read and not changed."""
    raise CompiledOnlyError


@inlined
def average_tables(tables: Any, obs: int, room: Room) -> Room:
    """The room, in which those means are worked out."""
    for k in range(len(room.values)):
        action = action_at(tables, room, k)
        room.values[k] = tables.values[0, obs, action]
        if tables.values.shape[0] > 1:
            room.values[k] = 0.5 * (room.values[k] + tables.values[1, obs, action])
    return room


@inlined
def best_value(tables: Any, obs: int, room: Room) -> float:
    """The highest of the mean values of the actions that are allowed at ``obs``."""
    return highest_value(with_mean_values(tables, obs, room_at(tables, obs, room)).values)


class Tables(NamedTuple):
    """What an agent knows, in the memory of its policy, where all actions are allowed.

    `MaskedTables` of no rows mean the same, and cost the compiled loop a sixth of its speed.

    Attributes:
        values: action values, shape (T, S, A).
        visit_counts: updates of each entry so far, shape (T, S, A).
    """

    values: Floats
    visit_counts: Ints

    @inlined
    def room_at(self, obs: int, room: Room) -> Room:
        """All of it."""
        return room

    @inlined
    def action_at(self, room: Room, k: int) -> int:
        """The k-th of all."""
        return k

    @inlined
    def with_mean_values(self, obs: int, room: Room) -> Room:
        """A row of the table as it lies there, where there is only one."""
        if self.values.shape[0] == 1:
            return Room(self.values[0, obs], room.actions, room.draws)
        return average_tables(self, obs, room)


class MaskedTables(NamedTuple):
    """What an agent knows, and what the environment allows.

    Attributes:
        values: as in `Tables`.
        visit_counts: as in `Tables`.
        allowed: what may be done at each observation, bool of shape (S, A); everything where a row
            is False, which means that nothing is known, or where there are no rows.
    """

    values: Floats
    visit_counts: Ints
    allowed: Bools

    @inlined
    def room_at(self, obs: int, room: Room) -> Room:
        """As much as there are allowed actions, which are listed in it."""
        actions, n_allowed = room.actions, 0
        if len(self.allowed) > 0:
            for action in range(len(actions)):
                if self.allowed[obs, action]:
                    actions[n_allowed] = action
                    n_allowed += 1
        if n_allowed == 0:
            n_allowed = len(actions)
            for action in range(n_allowed):
                actions[action] = action
        return Room(room.values[:n_allowed], actions[:n_allowed], room.draws)

    @inlined
    def action_at(self, room: Room, k: int) -> int:
        """The k-th that is allowed."""
        return int(room.actions[k])

    @inlined
    def with_mean_values(self, obs: int, room: Room) -> Room:
        """The means, worked out in the room."""
        return average_tables(self, obs, room)
