"""What is known of the regret of bandit agents beforehand."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike
from scipy import integrate, special, stats

from mdp.array_types import Floats


def auer_bound(means: ArrayLike, pulls: ArrayLike) -> Floats:
    """An upper bound on the expected regret of UCB1 for rewards between 0 and 1.

    Args:
        means: of the arms, shape (n_arms,).
        pulls: numbers of pulls, of any shape.

    Returns:
        The bound for each number of pulls.

    Source: Auer, Cesa-Bianchi and Fischer (2002), theorem 1.
    """
    arms = np.asarray(means, dtype=np.float64)
    gaps = arms.max() - arms
    gaps = gaps[gaps > 0]
    rate = (8 / gaps).sum()
    return np.asarray(rate * np.log(pulls) + (1 + np.pi**2 / 3) * gaps.sum())


def lai_robbins_slope(means: ArrayLike) -> float:
    """How fast the regret on Bernoulli arms must grow with the logarithm of the pulls, in the end.

    The bound is asymptotic: after a finite number of pulls an agent may lie below it.

    Args:
        means: of the arms, shape (n_arms,), strictly between 0 and 1.

    Source: Lai and Robbins (1985), theorem 1.
    """
    arms = np.asarray(means, dtype=np.float64)
    best = arms.max()
    worse = arms[arms < best]
    divergence = special.rel_entr(worse, best) + special.rel_entr(1 - worse, 1 - best)
    return float(((best - worse) / divergence).sum())


def best_of_normals(n: int) -> float:
    """The expected maximum of ``n`` independent standard normal variables."""
    value, _ = integrate.quad(
        lambda x: x * n * stats.norm.pdf(x) * stats.norm.cdf(x) ** (n - 1), -np.inf, np.inf
    )
    return float(value)


def best_expected_reward(env: gym.Env[object, object]) -> float | None:
    """The highest expected reward of a pull, over contexts and whatever is drawn at reset.

    None where it moves with time, or has no simple form.
    """
    bandit = env.unwrapped
    if getattr(bandit, "drift_std", 0.0) > 0:
        return None
    if getattr(bandit, "redraws", False):
        if bandit.kind != "gaussian":  # type: ignore[attr-defined]
            return None
        return float(bandit.mean_loc + best_of_normals(bandit.n_arms))  # type: ignore[attr-defined]
    means = getattr(bandit, "means", None)
    if means is None:
        return None
    weights = getattr(bandit, "context_probabilities", np.ones(1))
    return float(np.asarray(weights) @ np.asarray(means).max(axis=1))
