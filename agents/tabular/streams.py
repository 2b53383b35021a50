"""Uniform random numbers of an environment's generator, drawn ahead of their use."""

from __future__ import annotations

from typing import Any

import numpy as np


class UniformStreams:
    """Draws ahead for n generators, and puts them back to where the numbers were used up.

    Args:
        generators: one for each environment, on bit generators that can be advanced.
        capacity: how many numbers of each may be used between two calls of `refill`.

    Attributes:
        uniforms: the numbers, shape (n, capacity).
        used: how many of each row are used up, shape (n,); counted by who uses them.
    """

    def __init__(self, generators: list[np.random.Generator], capacity: int) -> None:
        self.generators = generators
        self.uniforms = np.empty((len(generators), capacity))
        self.used = np.full(len(generators), capacity, dtype=np.int64)

    def refill(self) -> None:
        """Put new numbers in place of those that are used up."""
        for row, used, generator in zip(self.uniforms, self.used, self.generators, strict=True):
            left = len(row) - used
            row[:left] = row[used:].copy()
            row[left:] = generator.random(used)
        self.used[:] = 0

    def give_back(self) -> None:
        """Put the generators to where they would be had only the used numbers been drawn."""
        capacity = self.uniforms.shape[1]
        for used, generator in zip(self.used.tolist(), self.generators, strict=True):
            bits: Any = generator.bit_generator
            ahead = bits.state
            # One double takes one output of the bit generator, whose period is 2**128.
            bits.advance(2**128 - (capacity - used))
            # Advancing forgets the half of an output that waits for the next 32-bit number.
            waiting = {name: ahead[name] for name in ("has_uint32", "uinteger")}
            bits.state = {**bits.state, **waiting}
        self.used[:] = capacity
