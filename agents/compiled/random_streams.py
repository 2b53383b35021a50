"""Uniform random numbers of an environment's generator, drawn ahead of their use."""

from __future__ import annotations

from typing import Any

import numpy as np


class UniformStreams:
    """Draws ahead for n generators, and puts them back to where the numbers were used up.

    Args:
        generators: one for each environment, on bit generators that can be advanced.
        most: the highest number that `refill` will be asked for.

    Attributes:
        uniforms: the numbers, shape (n, 2 * most): with room for two rounds, a short one seldom has
            to move any.
        used: how many of each row are used up, shape (n,); counted by who uses them.
    """

    def __init__(self, generators: list[np.random.Generator], most: int) -> None:
        self.generators = generators
        self.uniforms = np.empty((len(generators), 2 * most))
        self.used = np.zeros(len(generators), dtype=np.int64)
        self._drawn = np.zeros(len(generators), dtype=np.int64)

    def refill(self, need: int) -> None:
        """Have at least ``need`` numbers in each row that are not used up."""
        for i, (row, generator) in enumerate(zip(self.uniforms, self.generators, strict=True)):
            used, drawn = self.used[i], self._drawn[i]
            left = drawn - used
            if left >= need:
                continue
            if used + need > len(row):
                row[:left] = row[used:drawn]
                self.used[i] = used = 0
            row[used + left : used + need] = generator.random(need - left)
            self._drawn[i] = used + need

    def give_back(self) -> None:
        """Put the generators to where they would be had only the used numbers been drawn."""
        ahead = (self._drawn - self.used).tolist()
        for left, generator in zip(ahead, self.generators, strict=True):
            bits: Any = generator.bit_generator
            before = bits.state
            # One double takes one output of the bit generator, whose period is 2**128.
            bits.advance(2**128 - left)
            # Advancing forgets the half of an output that waits for the next 32-bit number.
            waiting = {name: before[name] for name in ("has_uint32", "uinteger")}
            bits.state = {**bits.state, **waiting}
        self._drawn[:] = self.used
