"""The divergence between two coins, and the bound of KL-UCB that comes from it."""

from __future__ import annotations

import math

from mdp.machine_code import inlined

MAX_NEWTON_STEPS = 60
PRECISION = 1e-13
LAST_BELOW_ONE = 1.0 - 2.0**-53


@inlined
def bernoulli_kl(p: float, q: float) -> float:
    """Kullback-Leibler divergence from a coin of probability ``p`` to one of ``q`` in (0, 1)."""
    divergence = 0.0
    if p > 0.0:
        divergence += p * math.log(p / q)
    if p < 1.0:
        divergence += (1.0 - p) * math.log((1.0 - p) / (1.0 - q))
    return divergence


@inlined
def kl_upper_bound(p: float, budget: float) -> float:
    """The highest q with kl(p, q) <= ``budget``, for ``p`` in [0, 1].

    Newton's method from above: the divergence is convex in q, so that the steps never cross the
    solution, and Pinsker's inequality gives where to start.
    """
    if budget <= 0.0 or p >= 1.0:
        return p
    q = min(p + math.sqrt(0.5 * budget), LAST_BELOW_ONE)
    for _ in range(MAX_NEWTON_STEPS):
        excess = bernoulli_kl(p, q) - budget
        step = excess * q * (1.0 - q) / (q - p)
        if step <= PRECISION * min(q, 1.0 - q):
            break
        q -= step
    return q
