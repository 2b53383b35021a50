"""Mean rewards of arms in contexts, fitted to logged pulls: what off-policy evaluation guesses by.

Each pull is predicted by a model fitted to other pulls. Models are linear in the rewards that they
are fitted to, which tells how much each of those counts in what comes of a prediction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from mdp.array_types import Floats, Ints

N_FOLDS = 5
# The weight of the prior of each coefficient, in pulls.
RIDGE = 1.0


class RewardModel(Protocol):
    """A model fitted to some pulls."""

    def predict(self, contexts: NDArray[Any]) -> Floats:
        """The mean reward of each arm in each of m contexts, shape (m, n_arms)."""
        ...

    def sensitivity(self, contexts: NDArray[Any], policy: Floats) -> Floats:
        """By how much a prediction of the policy's total reward rises with each reward fitted to.

        Args:
            contexts: m of them.
            policy: probability of each arm in each, shape (m, n_arms).

        Returns:
            Derivatives of the sum of ``policy * predict(contexts)``, one for each pull that the
            model was fitted to.
        """
        ...


class ArmMeans:
    """The mean reward of each arm in each context; the arm's overall mean where there is none.

    Saturated: nothing is assumed about the rewards.

    Args:
        contexts: whole numbers from 0, shape (n,).
        arms: shape (n,).
        rewards: shape (n,).
        n_arms: number of arms.
        n_contexts: number of contexts.
    """

    def __init__(
        self, contexts: Ints, arms: Ints, rewards: Floats, n_arms: int, n_contexts: int
    ) -> None:
        self.contexts, self.arms = contexts, arms
        size, cells = n_contexts * n_arms, contexts * n_arms + arms
        shape = (n_contexts, n_arms)
        self.counts = np.bincount(cells, minlength=size).reshape(shape)
        sums = np.bincount(cells, rewards, minlength=size).reshape(shape)
        self.arm_counts = self.counts.sum(axis=0)
        overall = np.full(n_arms, rewards.mean())
        np.divide(sums.sum(axis=0), self.arm_counts, out=overall, where=self.arm_counts > 0)
        self.means = np.tile(overall, (n_contexts, 1))
        np.divide(sums, self.counts, out=self.means, where=self.counts > 0)

    def predict(self, contexts: Ints) -> Floats:
        """See `RewardModel`."""
        return np.asarray(self.means[contexts])

    def sensitivity(self, contexts: Ints, policy: Floats) -> Floats:
        """See `RewardModel`."""
        n_contexts = len(self.counts)
        mass = np.stack([np.bincount(contexts, p, minlength=n_contexts) for p in policy.T], axis=1)
        seen = self.counts > 0
        by_cell = np.where(seen, mass, 0) / np.maximum(self.counts, 1)
        by_arm = np.where(seen, 0, mass).sum(axis=0) / np.maximum(self.arm_counts, 1)
        return np.asarray(by_cell[self.contexts, self.arms] + by_arm[self.arms])


class ArmRegressions:
    """A ridge regression of the rewards on the context for each arm.

    Features are standardised, and rewards counted from their mean, which is what is predicted for
    an arm without pulls.

    Args:
        contexts: shape (n, d).
        arms: shape (n,).
        rewards: shape (n,).
        n_arms: number of arms.

    Source: Hoerl and Kennard (1970), "Ridge regression", Technometrics 12.
    """

    def __init__(self, contexts: Floats, arms: Ints, rewards: Floats, n_arms: int) -> None:
        self.arms, self.centre, self.scale = arms, contexts.mean(axis=0), contexts.std(axis=0)
        self.scale[self.scale == 0] = 1
        self.inputs = self._standardised(contexts)
        self.level = float(rewards.mean())
        prior = RIDGE * np.eye(self.inputs.shape[1])
        self._factors = []
        self.coefficients = np.zeros((n_arms, len(prior)))
        for arm in range(n_arms):
            rows = self.inputs[arms == arm]
            self._factors.append(linalg.cho_factor(rows.T @ rows + prior))
            moments = rows.T @ (rewards[arms == arm] - self.level)
            self.coefficients[arm] = linalg.cho_solve(self._factors[arm], moments)

    def predict(self, contexts: Floats) -> Floats:
        """See `RewardModel`."""
        return np.asarray(self.level + self._standardised(contexts) @ self.coefficients.T)

    def sensitivity(self, contexts: Floats, policy: Floats) -> Floats:
        """See `RewardModel`; of the regressions, the mean reward being taken as it is."""
        totals = policy.T @ self._standardised(contexts)
        solved = [linalg.cho_solve(*pair) for pair in zip(self._factors, totals, strict=True)]
        return np.asarray((self.inputs * np.stack(solved)[self.arms]).sum(axis=1))

    def _standardised(self, contexts: Floats) -> Floats:
        scaled = (contexts - self.centre) / self.scale
        return np.column_stack([np.ones(len(contexts)), scaled])


@dataclass(frozen=True, eq=False)
class CrossFit:
    """Models of the rewards, none of which predicts a pull that it was fitted to.

    Attributes:
        contexts: of the pulls, shape (n,) or (n, d).
        arms: shape (n,).
        rewards: shape (n,).
        fold: the fold of each pull, shape (n,).
        models: for each fold the one fitted to all other folds.
        predicted: mean reward of each arm before each pull, shape (n, n_arms).
    """

    contexts: NDArray[Any]
    arms: Ints
    rewards: Floats
    fold: Ints
    models: Sequence[RewardModel]
    predicted: Floats

    def reward_influence(self, policy: Floats) -> Floats:
        """What each reward's deviation from its model adds to the predictions for the policy.

        Args:
            policy: probability of each arm before each pull, shape (n, n_arms).

        Returns:
            Shape (n,), on the scale of a single term: their mean is what they add together.
        """
        added = np.zeros(len(self.arms))
        for fold, model in enumerate(self.models):
            held_out = self.fold == fold
            fitted = np.flatnonzero(~held_out)
            arms = self.arms[fitted]
            expected = model.predict(self.contexts[fitted])[np.arange(len(arms)), arms]
            counts = model.sensitivity(self.contexts[held_out], policy[held_out])
            added[fitted] += counts * (self.rewards[fitted] - expected)
        return added


def cross_fit(
    contexts: NDArray[Any],
    arms: Ints,
    rewards: Floats,
    n_arms: int,
    *,
    n_folds: int = N_FOLDS,
    seed: int = 0,
) -> CrossFit:
    """Fit models of the rewards: means for contexts that are numbered, else regressions.

    Args:
        contexts: whole numbers from 0, shape (n,), or vectors, shape (n, d).
        arms: shape (n,).
        rewards: shape (n,).
        n_arms: number of arms, also of those that were not pulled.
        n_folds: parts into which the pulls are divided at random.
        seed: of the division.

    Raises:
        ValueError: if there are fewer than two pulls or folds.
    """
    if len(arms) < 2 or n_folds < 2:
        raise ValueError(
            f"a model of the rewards needs two pulls and two folds or more: there are {len(arms)} "
            f"and {n_folds}"
        )
    n_folds = min(n_folds, len(arms))
    fold = np.random.default_rng(seed).permutation(len(arms)) % n_folds
    models: list[RewardModel] = []
    predicted = np.zeros((len(arms), n_arms))
    for held_out in (fold == i for i in range(n_folds)):
        part = contexts[~held_out], arms[~held_out], rewards[~held_out], n_arms
        model = (
            ArmMeans(*part, int(contexts.max()) + 1)
            if contexts.ndim == 1
            else ArmRegressions(*part)
        )
        models.append(model)
        predicted[held_out] = model.predict(contexts[held_out])
    return CrossFit(contexts, arms, rewards, fold, models, predicted)
