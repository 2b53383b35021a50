"""What a policy would have earned, estimated from pulls that another policy made.

Each estimator returns a term for each logged pull. The mean of the terms is the estimate, and their
spread over the square root of their number its standard error. Two policies on the same log are
therefore compared by the differences of their terms, pull by pull: see `difference_in_value`.

With a pull in context x of arm a, which the log chose with probability p and which gave r, a policy
of probabilities pi(arm | x), and q(x, arm) a guess at the mean reward:

    importance weight        w = pi(a | x) / p
    inverse propensities     mean of w r
    self-normalised          sum of w r / sum of w
    direct method            mean of sum over arms of pi(arm | x) q(x, arm)
    doubly robust            the direct method's terms, plus w (r - q(x, a))

The guesses q are linear in the rewards that they are fitted to, which tells how much each of those
counts in what comes of a prediction. Each pull is predicted by a model fitted to other pulls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from mdp.transition_model import Bools, Floats, Ints
from verdicts import Estimate, paired_difference

N_FOLDS = 5
# The weight of the prior of each coefficient, in pulls.
RIDGE = 1.0


class RewardModel(Protocol):
    """A model fitted to some pulls."""

    def predict(self, contexts: NDArray[Any]) -> Floats:
        """The mean reward of each arm in each of m contexts, shape (m, n_arms)."""
        ...

    def sensitivity(self, contexts: NDArray[Any], policy: Floats) -> Floats:
        """By how much the predicted total reward of a policy rises with each reward fitted to.

        That is, the derivatives of the sum of ``policy * predict(contexts)``; ``policy`` has the
        probability of each arm in each of m contexts, shape (m, n_arms).
        """
        ...


class ArmMeans:
    """The mean reward of each arm in each context; the arm's overall mean where there is none.

    Saturated: nothing is assumed about the rewards. Contexts are whole numbers from 0, shape (n,).
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
    an arm without pulls. Contexts have the shape (n, d).

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
    """Models of the rewards, none of which predicts a pull that it was fitted to."""

    contexts: NDArray[Any]  # of the pulls, shape (n,) or (n, d)
    arms: Ints  # shape (n,)
    rewards: Floats  # shape (n,)
    fold: Ints  # the fold of each pull, shape (n,)
    models: Sequence[RewardModel]  # for each fold the one fitted to all other folds
    predicted: Floats  # mean reward of each arm before each pull, shape (n, n_arms)

    def reward_influence(self, policy: Floats) -> Floats:
        """What each reward's deviation from its model adds to the predictions for the policy.

        On the scale of a single term: their mean is what they add together.
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


# --- The estimators.

# By how many standard errors weights may miss their mean of 1 before the log is refused. Chance
# does that only where next to none of what the policy does was logged.
MOST_ERRORS = 5.0
# By how much they may miss it besides: files round propensities.
ROUNDED = 0.02
_SUMS_TO_1 = 1e-6


@dataclass(frozen=True, eq=False)
class PolicyTerms:
    """The terms of each estimator, shapes (n,)."""

    ips: Floats  # inverse propensities
    snips: Floats  # self-normalised
    direct: Floats  # the direct method
    doubly_robust: Floats  # doubly robust
    effective: float  # how many pulls of the policy's own the log is worth
    weights: Floats  # how much more often the policy makes each pull than the log did
    errors: Floats  # by how much each reward was above what the model expected


def evaluate_policy(
    policy: Floats, arms: Ints, rewards: Floats, propensities: Floats, model: CrossFit
) -> PolicyTerms:
    """Judge a policy by all four estimators.

    Args:
        policy: its probability of each arm before each pull, shape (n, n_arms).
        arms: the arms pulled, shape (n,).
        rewards: what they gave, shape (n,).
        propensities: the probability with which each was chosen, shape (n,).
        model: of the rewards; see `experiments.off_policy.estimators.cross_fit`.

    Raises:
        ValueError: if the arrays are not such, or the log cannot tell what the policy is worth.
    """
    weights = importance_weights(policy, arms, propensities)
    check_rewards(rewards, len(arms))
    check_support(policy, arms, weights)
    return PolicyTerms(
        ips=ips(weights, rewards),
        snips=snips(weights, rewards),
        direct=direct_method(policy, model),
        doubly_robust=doubly_robust(policy, weights, arms, rewards, model.predicted),
        effective=effective_sample_size(weights),
        weights=weights,
        errors=_errors(arms, rewards, model.predicted),
    )


def terms_as_logged(arms: Ints, rewards: Floats, model: CrossFit) -> PolicyTerms:
    """The terms of the policy that made the log, which are the rewards themselves."""
    n, errors = len(rewards), _errors(arms, rewards, model.predicted)
    return PolicyTerms(rewards, rewards, rewards, rewards, float(n), np.ones(n), errors)


def mean_reward(terms: Floats, confidence: float = 0.95) -> Estimate:
    """The mean of an estimator's terms with its t interval.

    The interval holds where there are many terms and no few of them decide: look at the effective
    sample size. What an estimator is biased by, it does not cover.
    """
    return paired_difference(terms, np.zeros_like(terms), confidence)


def difference_in_value(
    first: PolicyTerms, second: PolicyTerms, n_comparisons: int = 1
) -> Estimate:
    """How much more the first policy earns a pull, doubly robust, with a t interval.

    The spread of the terms has a floor: what it would be if rewards erred by the same everywhere.
    Where few pulls tell of a choice, all of them may have given the same by chance, and the terms
    then look sure of it.

    Args:
        first: of the one policy.
        second: of the other, on the same log.
        n_comparisons: from among how many this one was picked; intervals of all of them hold
            together with 95 %.
    """
    confidence = 1 - 0.05 / n_comparisons
    found = paired_difference(first.doubly_robust, second.doubly_robust, confidence)
    apart = first.weights - second.weights
    variance = float((apart**2).mean() * (first.errors**2).mean()) / len(apart)
    half = float(stats.t.isf(0.05 / n_comparisons / 2, len(apart) - 1)) * np.sqrt(variance)
    half = max(half, found.high - found.point)
    return replace(found, low=found.point - half, high=found.point + half)


def importance_weights(policy: Floats, arms: Ints, propensities: Floats) -> Floats:
    """How much more often the policy makes each pull than the log did, shape (n,).

    Raises:
        ValueError: if the shapes do not fit, or something is no probability.
    """
    n_pulls, n_arms = policy.shape
    if arms.shape != (n_pulls,) or propensities.shape != (n_pulls,):
        raise ValueError(
            f"a policy of shape {policy.shape} needs {n_pulls} arms and propensities, "
            f"not {arms.shape} and {propensities.shape}"
        )
    if n_pulls and not (arms.min() >= 0 and arms.max() < n_arms):
        raise ValueError(f"arms must lie between 0 and {n_arms - 1}, as the policy's columns do")
    _refuse(~((propensities > 0) & (propensities <= 1)), "propensity", propensities)
    uneven = (policy < 0).any(axis=1) | ~(np.abs(policy.sum(axis=1) - 1) <= _SUMS_TO_1)
    _refuse(uneven, "sum of the policy's probabilities", policy.sum(axis=1))
    return np.asarray(policy[np.arange(n_pulls), arms] / propensities)


def check_rewards(rewards: Floats, n_pulls: int) -> None:
    """Refuse rewards that are not one finite number for each pull."""
    if rewards.shape != (n_pulls,):
        raise ValueError(f"{n_pulls} pulls need as many rewards, not {rewards.shape}")
    _refuse(~np.isfinite(rewards), "reward", rewards)


def check_support(policy: Floats, arms: Ints, weights: Floats) -> None:
    """Refuse a log that does not show what the policy would do.

    Weights are expected to be 1 if the propensities are right and the log could choose every arm
    that the policy chooses, wherever it does. How far their mean is from 1 is measured in standard
    errors, for a mean of 1: too few large weights would make their own variance too small.

    Raises:
        ValueError: naming the arm that was never logged, or what the weights are on average.
    """
    share = policy.mean(axis=0)
    unlogged = np.setdiff1d(np.flatnonzero(share > 0), arms)
    if len(unlogged):
        arm = unlogged[0]
        raise ValueError(
            f"arm {arm} was never logged, and the policy chooses it for {share[arm]:.1%} of the "
            "pulls: nothing is known of its rewards"
        )
    mean = weights.mean()
    if mean == 0:
        raise ValueError("the policy would have made none of the logged pulls")
    variance = max(float((weights**2).mean() / mean) - 1, 0.0)
    allowed = MOST_ERRORS * np.sqrt(variance / len(weights)) + ROUNDED
    if mean < 1 - allowed:
        raise ValueError(
            f"the log holds too little of what the policy does: its weights are {mean:.3g} on "
            "average, not 1, so it chooses arms in contexts in which they were hardly ever logged"
        )
    if mean > 1 + allowed:
        raise ValueError(
            f"the propensities are too small: the weights are {mean:.3g} on average, not 1; each "
            "must be the probability with which the logged arm was chosen"
        )


def ips(weights: Floats, rewards: Floats) -> Floats:
    """Inverse propensity scoring: w r, whose mean is unbiased where propensities are right.

    Source: Horvitz and Thompson (1952), "A generalization of sampling without replacement from a
    finite universe", JASA 47; for policies Strehl, Langford, Li and Kakade (2010), "Learning from
    logged implicit exploration data", NeurIPS.
    """
    return weights * rewards


def snips(weights: Floats, rewards: Floats) -> Floats:
    """Self-normalised inverse propensities: a weighted mean of the rewards, and so within them.

    Consistent, with a bias of order 1/n. The terms are the ratio's linear approximation (delta
    method): s + w (r - s) / mean(w), s being the estimate. Not all weights may be 0.

    Source: Swaminathan and Joachims (2015), "The self-normalized estimator for counterfactual
    learning", NeurIPS.
    """
    total = weights.sum()
    estimate = weights @ rewards / total
    return np.asarray(estimate + weights * (rewards - estimate) * (len(weights) / total))


def direct_method(policy: Floats, model: CrossFit) -> Floats:
    """The direct method: the rewards that a model predicts for what the policy does.

    It needs no propensities, and is as biased as the model is; the interval covers none of that.
    It does cover that the model was fitted to a sample: the terms contain what each reward adds
    through the model, to first order (delta method). That has mean 0.

    Source: Dudik, Langford and Li (2011), "Doubly robust policy evaluation and learning", ICML;
    the variance as in Stefanski and Boos (2002), "The calculus of M-estimation", The American
    Statistician 56.
    """
    added = model.reward_influence(policy)
    return np.asarray((policy * model.predicted).sum(axis=1) + added - added.mean())


def doubly_robust(
    policy: Floats, weights: Floats, arms: Ints, rewards: Floats, predicted: Floats
) -> Floats:
    """The direct method, corrected by inverse propensities where the log shows the model to err.

    Unbiased if the propensities are right, whatever the model, as long as no pull is predicted by a
    model that has seen it; and the closer the model, the smaller the variance.

    Source: Dudik, Langford and Li (2011); crossing folds as in Chernozhukov et al. (2018),
    "Double/debiased machine learning", The Econometrics Journal 21.
    """
    errors = _errors(arms, rewards, predicted)
    return np.asarray((policy * predicted).sum(axis=1) + weights * errors)


def _errors(arms: Ints, rewards: Floats, predicted: Floats) -> Floats:
    return np.asarray(rewards - predicted[np.arange(len(arms)), arms])


def effective_sample_size(weights: Floats) -> float:
    """How many pulls of the policy's own would be worth as much: (sum of w)^2 / sum of w^2.

    0 where every weight is. Source: Kish (1965), Survey Sampling, section 11.7.
    """
    squares = float(weights @ weights)
    return float(weights.sum()) ** 2 / squares if squares else 0.0


def _refuse(wrong: Bools, name: str, values: Floats) -> None:
    if wrong.any():
        place = int(np.flatnonzero(wrong)[0])
        wanted = {"reward": "finite", "propensity": "above 0 and at most 1"}.get(name, "1")
        raise ValueError(f"{name} of pull {place + 1} is {values[place]:g}, it must be {wanted}")
