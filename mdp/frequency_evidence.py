"""How strongly counts speak against probabilities, whenever one stops to count.

A test at a fixed number of draws goes wrong where what is seen decides what is drawn next, as the
states of episodes do. A likelihood ratio does not: where the probabilities are right, that of any
mixture of others to them is a martingale with mean one, and exceeds 1/alpha, ever, with probability
alpha at most (Ville, Étude critique de la notion de collectif, 1939; Robbins, Annals of
Mathematical Statistics 41, 1970). Nothing is approximated, at any number of draws.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mdp.array_types import Floats, Ints


class Frequencies(NamedTuple):
    """What was counted in groups of draws, and what it says.

    Attributes:
        groups: the groups in which something was drawn, shape (G,).
        counts: how often each outcome was drawn in each, shape (G, K).
        evidence: natural logarithm of the likelihood ratio against the outcome's probability, shape
            (G, K); minus infinity where that is 0 or 1.
    """

    groups: Ints
    counts: Ints
    evidence: Floats


def frequencies(groups: Ints, outcomes: Ints, probabilities: Floats, n_alike: int) -> Frequencies:
    """Count draws, and hold each outcome's count against its probability.

    Args:
        groups: the group of each draw, from 0 on, shape (n,).
        outcomes: what was drawn, 0 to K - 1, shape (n,).
        probabilities: shape (H, K): row h holds those of the groups h * n_alike to
            (h + 1) * n_alike - 1.
        n_alike: how many groups share a row.
    """
    n_outcomes = probabilities.shape[1]
    found, index = np.unique(groups, return_inverse=True)
    cells = index * n_outcomes + outcomes
    counts = np.bincount(cells, minlength=len(found) * n_outcomes).reshape(-1, n_outcomes)
    evidence = log_evidence(counts, counts.sum(1, keepdims=True), probabilities[found // n_alike])
    return Frequencies(found, counts, evidence)


def log_evidence(counts: Ints, trials: Ints, prob: Floats) -> Floats:
    """Logarithm of how much likelier counts are under a probability that nobody knows.

    That one is drawn from Beta(1/2, 1/2); Krichevsky and Trofimov, IEEE Transactions on Information
    Theory 27, 1981.

    Args:
        counts: successes.
        trials: draws, of a shape that broadcasts with that of ``counts``.
        prob: the probability of a success that is doubted, likewise.

    Returns:
        The logarithms; minus infinity where the probability is 0 or 1, which counts cannot refute
        bit by bit: one draw does, or none.
    """
    from scipy.special import betaln

    open_ = (prob > 0) & (prob < 1)
    inside = np.where(open_, prob, 0.5)
    mixture = betaln(counts + 0.5, trials - counts + 0.5) - betaln(0.5, 0.5)
    doubted = counts * np.log(inside) + (trials - counts) * np.log1p(-inside)
    return np.where(open_, mixture - doubted, -np.inf)
