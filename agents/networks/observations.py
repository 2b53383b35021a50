"""What networks are shown of compiled environments.

Environments keep numbers of states; CartPole, whose states nobody counts, keeps vectors. Networks
and their buffers want rows. Which of the kinds applies is looked up by type
(`agents.compiled.loop`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.compiled.loop import by_type
from agents.networks.perceptron import Inputs, Singles
from machine_code.compiling import inlined

# Before a step; and after it, before any reset.
BEFORE, AFTER = range(2)


@by_type
def observe(seen: Any, env: Any, moment: int, row: Any) -> None:
    """Write what the environment showed at that moment of its last step into ``row``."""


@by_type
def move_on(seen: Any, env: Any) -> None:
    """Let the present observation be the one that the next action is chosen for."""


@inlined
def number_at(env: Any, moment: int) -> int:
    """The number that stands for the observation."""
    return int(env.obs if moment == BEFORE else env.next_obs)


@inlined
def look(seen: Any, env: Any, moment: int, inputs: Inputs, one_hot: int) -> None:
    """Let the first row of a network's inputs be what the environment showed at that moment."""
    if one_hot:
        inputs.indices[0] = number_at(env, moment)
    else:
        observe(seen, env, moment, inputs.vectors[0])


@inlined
def show(inputs: Inputs, i: int, row: Any, one_hot: int) -> None:
    """Put a row of a buffer into the i-th of a network's inputs."""
    if one_hot:
        inputs.indices[i] = int(row[0])
    else:
        for j in range(len(row)):
            inputs.vectors[i, j] = np.float32(row[j])


class Numbers(NamedTuple):
    """Observations are numbers, which networks see as one-hot vectors."""

    n: int  # how many there are

    @inlined
    def observe(self, env: Any, moment: int, row: Any) -> None:
        """The number itself, shape (1,)."""
        row[0] = number_at(env, moment)

    @inlined
    def move_on(self, env: Any) -> None:
        """Only the number changes."""
        env.obs = env.new_obs


class StateVectors(NamedTuple):
    """Observations are vectors, one for each state of a known model."""

    table: Singles  # what is observed in each state, shape (S, d)

    @inlined
    def observe(self, env: Any, moment: int, row: Any) -> None:
        """The vector of that state, shape (d,)."""
        vector = self.table[number_at(env, moment)]
        for j in range(len(row)):
            row[j] = vector[j]

    @inlined
    def move_on(self, env: Any) -> None:
        """Only the number changes."""
        env.obs = env.new_obs


class OwnVectors(NamedTuple):
    """Observations are vectors that the environments' records hold."""

    n: int  # length of the vectors

    @inlined
    def observe(self, env: Any, moment: int, row: Any) -> None:
        """The vector of that moment, shape (n,)."""
        for j in range(self.n):
            row[j] = env.vector[j] if moment == BEFORE else env.next_vector[j]

    @inlined
    def move_on(self, env: Any) -> None:
        """All of the vector changes."""
        for j in range(self.n):
            env.vector[j] = env.new_vector[j]
