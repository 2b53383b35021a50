"""Off-policy evaluation: the value of policies, estimated from pulls that another policy made.

``compare.py --logged`` judges trained agents by a log of pulls. Each estimator returns a term for
each logged pull. The estimate is the mean of the terms; its standard error is their standard
deviation divided by the square root of their number. So two policies on one log are compared by
differences of their terms: see `difference_in_value`.

For a pull in context x of arm a, which the log chose with probability p and which gave reward r, a
policy with probabilities pi(arm | x), and an estimate q(x, arm) of the mean reward:

    importance weight        w = pi(a | x) / p
    inverse propensities     mean of w r
    self-normalised          sum of w r / sum of w
    doubly robust            mean of sum over arms of pi(arm | x) q(x, arm), plus w (r - q(x, a))

A model of the rewards predicts only pulls to which it was not fitted (cross-fitting).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy import linalg, special

from rl_yardstick.envs.bandits import LoggedData, read_log
from rl_yardstick.mdp.transition_model import Floats, Ints
from rl_yardstick.pipeline.errors import UserError, as_user_error, one_line
from rl_yardstick.pipeline.models import Wanted, find_model, load_agent
from rl_yardstick.verdicts import Estimate

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

N_FOLDS = 5
RIDGE = 1.0  # the weight of each coefficient's prior, in pulls

# --- models of the rewards ------------------------------------------------------------------------


def arm_means(contexts: Ints, arms: Ints, rewards: Floats, shape: tuple[int, int]) -> Floats:
    """The mean reward of each arm in each context; without pulls, the arm's overall mean.

    A saturated model: it assumes nothing about rewards. Contexts are integers from 0, shape (n,);
    the result has the ``shape`` of the numbers of contexts and arms.
    """
    cells, size = contexts * shape[1] + arms, shape[0] * shape[1]
    counts = np.bincount(cells, minlength=size).reshape(shape)
    sums = np.bincount(cells, rewards, minlength=size).reshape(shape)
    overall, by_arm = np.full(shape[1], rewards.mean()), counts.sum(axis=0)
    np.divide(sums.sum(axis=0), by_arm, out=overall, where=by_arm > 0)
    means = np.tile(overall, (shape[0], 1))
    np.divide(sums, counts, out=means, where=counts > 0)
    return means


def arm_regressions(
    contexts: Floats, arms: Ints, rewards: Floats, n_arms: int, asked: Floats
) -> Floats:
    """The predictions of a ridge regression of the rewards on the context for each arm.

    Features are standardised, and rewards are centred on their mean, which is the prediction for an
    arm without pulls. Contexts have the shape (n, d), ``asked`` (m, d), the result (m, n_arms).

    Source: Hoerl and Kennard (1970), "Ridge regression", Technometrics 12.
    """
    centre, scale = contexts.mean(axis=0), contexts.std(axis=0)
    scale[scale == 0] = 1
    known, inputs = (
        np.column_stack([np.ones(len(rows)), (rows - centre) / scale]) for rows in (contexts, asked)
    )
    level = rewards.mean()
    prior = RIDGE * np.eye(known.shape[1])
    coefficients = np.zeros((n_arms, len(prior)))
    for arm in range(n_arms):
        rows = known[arms == arm]
        moments = rows.T @ (rewards[arms == arm] - level)
        coefficients[arm] = linalg.cho_solve(linalg.cho_factor(rows.T @ rows + prior), moments)
    return np.asarray(level + inputs @ coefficients.T)


def cross_fit(
    contexts: NDArray[Any], arms: Ints, rewards: Floats, n_arms: int, n_folds: int = N_FOLDS
) -> Floats:
    """The mean reward of each arm before each pull, shape (n, n_arms), from the other folds' pulls.

    Contexts are integers from 0, shape (n,), for means; or vectors, shape (n, d), for regressions.
    ``n_arms`` counts arms that were not pulled, too.

    Raises ValueError if there are fewer than two pulls.
    """
    if len(arms) < 2:
        raise ValueError("a model of the rewards needs two pulls or more")
    fold = np.random.default_rng(0).permutation(len(arms)) % min(n_folds, len(arms))
    predicted = np.zeros((len(arms), n_arms))
    for held_out in (fold == i for i in range(fold.max() + 1)):
        part = contexts[~held_out], arms[~held_out], rewards[~held_out]
        if contexts.ndim == 1:
            means = arm_means(*part, (int(contexts.max()) + 1, n_arms))
            predicted[held_out] = means[contexts[held_out]]
        else:
            predicted[held_out] = arm_regressions(*part, n_arms, contexts[held_out])
    return predicted


# --- the estimators -------------------------------------------------------------------------------

# By how many standard errors the mean weight may differ from 1 before the log is refused, and a
# tolerance beside, because files round propensities.
MOST_ERRORS, ROUNDED = 5.0, 0.02


@dataclass(frozen=True, eq=False)
class PolicyTerms:
    """The terms of each estimator, shapes (n,)."""

    ips: Floats  # inverse propensities
    snips: Floats  # self-normalised
    doubly_robust: Floats  # doubly robust
    effective: float  # the effective sample size, in pulls of the policy itself
    weights: Floats  # probability of each pull under the policy, relative to the log
    errors: Floats  # each reward minus the model's prediction


def evaluate_policy(
    policy: Floats, arms: Ints, rewards: Floats, propensities: Floats, predicted: Floats
) -> PolicyTerms:
    """Evaluate a policy by all three estimators.

    Args:
        policy: its probability of each arm at each pull, shape (n, n_arms).
        arms: the arms pulled, shape (n,).
        rewards: their rewards, likewise.
        propensities: the log's probabilities of these arms, likewise.
        predicted: mean reward of each arm at each pull; see `cross_fit`.

    Raises:
        ValueError: if the log cannot support an estimate.
    """
    weights = importance_weights(policy, arms, propensities)
    check_support(policy, arms, weights)
    return PolicyTerms(
        ips=ips(weights, rewards),
        snips=snips(weights, rewards),
        doubly_robust=doubly_robust(policy, weights, arms, rewards, predicted),
        effective=effective_sample_size(weights),
        weights=weights,
        errors=_errors(arms, rewards, predicted),
    )


def terms_as_logged(arms: Ints, rewards: Floats, predicted: Floats) -> PolicyTerms:
    """The terms of the log's own policy, which are the rewards themselves."""
    n, errors = len(rewards), _errors(arms, rewards, predicted)
    return PolicyTerms(rewards, rewards, rewards, float(n), np.ones(n), errors)


def mean_reward(terms: Floats, confidence: float = 0.95) -> Estimate:
    """The mean of an estimator's terms with its t interval.

    The interval is valid for many terms without dominating ones: check the effective sample size.
    It does not cover the bias of an estimator.
    """
    n, mean = len(terms), float(terms.mean())
    reach = -float(special.stdtrit(n - 1, (1 - confidence) / 2) * (terms.std(ddof=1) / n**0.5))
    return Estimate(mean, mean - reach, mean + reach, n)


def difference_in_value(
    first: PolicyTerms, second: PolicyTerms, n_comparisons: int = 1
) -> Estimate:
    """The difference of two policies' values per pull, doubly robust, with a t interval.

    The standard deviation of the terms has a lower bound: its value if rewards had the same noise
    everywhere. If few pulls inform a choice, all may have had equal rewards by chance, and the
    terms alone would look too certain. All ``n_comparisons`` hold together with 95 %.
    """
    found = mean_reward(first.doubly_robust - second.doubly_robust, 1 - 0.05 / n_comparisons)
    apart = first.weights - second.weights
    variance = float((apart**2).mean() * (first.errors**2).mean()) / len(apart)
    half = -float(special.stdtrit(len(apart) - 1, 0.05 / n_comparisons / 2)) * np.sqrt(variance)
    half = max(half, found.high - found.point)
    return replace(found, low=found.point - half, high=found.point + half)


def importance_weights(policy: Floats, arms: Ints, propensities: Floats) -> Floats:
    """The policy's probability of each pull divided by the log's, shape (n,)."""
    return np.asarray(policy[np.arange(len(arms)), arms] / propensities)


def check_support(policy: Floats, arms: Ints, weights: Floats) -> None:
    """Refuse a log that does not cover the policy's actions.

    The mean weight is 1 if the propensities are right and the log could choose every arm that the
    policy chooses in each context. The deviation from 1 is measured in standard errors under a
    mean of 1, because too few large weights would underestimate their own variance.

    Raises:
        ValueError: names the arm that was never logged, or the mean weight.
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
    """Inverse propensity scoring: w r, with an unbiased mean if the propensities are right.

    Source: Horvitz and Thompson (1952), "A generalization of sampling without replacement from a
    finite universe", JASA 47; for policies Strehl, Langford, Li and Kakade (2010), "Learning from
    logged implicit exploration data", NeurIPS.
    """
    return weights * rewards


def snips(weights: Floats, rewards: Floats) -> Floats:
    """Self-normalised inverse propensities: a weighted mean of rewards, so within their range.

    Consistent, with a bias of order 1/n. The terms are the ratio's linear approximation (delta
    method): s + w (r - s) / mean(w), where s is the estimate. Not all weights may be 0.

    Source: Swaminathan and Joachims (2015), "The self-normalized estimator for counterfactual
    learning", NeurIPS.
    """
    total = weights.sum()
    estimate = weights @ rewards / total
    return np.asarray(estimate + weights * (rewards - estimate) * (len(weights) / total))


def doubly_robust(
    policy: Floats, weights: Floats, arms: Ints, rewards: Floats, predicted: Floats
) -> Floats:
    """A model's mean reward of the policy's actions, its errors corrected by inverse propensities.

    Unbiased if the propensities are right, for any model that predicts only pulls outside its fit.
    A better model gives a smaller variance.

    Source: Dudik, Langford and Li (2011); crossing folds as in Chernozhukov et al. (2018),
    "Double/debiased machine learning", The Econometrics Journal 21.
    """
    errors = _errors(arms, rewards, predicted)
    return np.asarray((policy * predicted).sum(axis=1) + weights * errors)


def _errors(arms: Ints, rewards: Floats, predicted: Floats) -> Floats:
    return np.asarray(rewards - predicted[np.arange(len(arms)), arms])


def effective_sample_size(weights: Floats) -> float:
    """The equivalent number of pulls by the policy itself: (sum of w)^2 / sum of w^2.

    0 if all weights are 0. Source: Kish (1965), Survey Sampling, section 11.7.
    """
    squares = float(weights @ weights)
    return float(weights.sum()) ** 2 / squares if squares else 0.0


# --- agents on a log ------------------------------------------------------------------------------


@dataclass(frozen=True)
class LoggedPolicy:
    """A trained agent for evaluation on a log."""

    name: str  # its path, as given
    agent: BaseAlgorithm  # the loaded agent
    log: Path | None  # the log of its training; None if there was none, or it is unknown


@dataclass(frozen=True)
class Judged:
    """One row of the comparison."""

    name: str  # of the policy
    terms: PolicyTerms  # the terms of its estimates
    is_given: bool = False  # whether the user asked about it; otherwise it is an alternative


@dataclass(frozen=True)
class Comparison:
    """The comparison of policies on one log."""

    data: LoggedData  # the log
    # The user's policies; then each arm as a constant policy, and the log's own policy.
    rows: tuple[Judged, ...]
    notes: tuple[str, ...]  # notes for reading the figures


def read_logged(path: Path, columns: Mapping[str, str] | None = None) -> LoggedData:
    """Read a log with propensities.

    ``columns`` has the file's names of ``arm``, ``reward`` and ``propensity``, where they differ.

    Raises UserError if it cannot be read or lacks them.
    """
    try:
        data = read_log(path, columns or {})
    except ValueError as error:
        raise UserError(one_line(error)) from error
    if data.propensities is None:
        raise UserError(
            f"{path} has no column 'propensity': off-policy evaluation needs the probability with "
            "which each arm was chosen, 1 divided by the number of arms where all were equally "
            "likely; --columns propensity=NAME says which column it is"
        )
    return data


def load_policy(path: Path, typed: Sequence[str] = ()) -> LoggedPolicy:
    """Load the agent of a run folder or a zip; ``typed`` are modules that the user typed.

    Raises UserError if there is none, or it does not observe the log's contexts.
    """
    wanted = Wanted(path, env_id="ReplayBandit-v0", typed=list(typed), device="cpu")
    model = find_model(wanted)
    # Settings that change an agent's observations, so that they differ from the log's contexts.
    keys = ("normalize", "frame_stack", "env_wrapper", "vec_env_wrapper")
    if changed := next((key for key in keys if getattr(model.spec, key)), None):
        raise UserError(f"{path} was trained with {changed}: it observes more than a log holds")
    agent = load_agent(model)
    if not isinstance(agent.action_space, spaces.Discrete):
        raise UserError(f"{path} chooses no arms: its actions are {agent.action_space}")
    log = model.spec.env_kwargs.get("log")
    return LoggedPolicy(str(path), agent, Path(log) if isinstance(log, str) else None)


def compare_policies(data: LoggedData, policies: Sequence[LoggedPolicy]) -> Comparison:
    """Evaluate policies, each arm as a constant policy, and the log's own policy.

    Raises UserError if a policy does not fit the log, or the log cannot support an estimate.
    """
    spaces_of_actions: list[Any] = [policy.agent.action_space for policy in policies]
    space = data.observation_space
    contexts = data.contexts if not isinstance(space, spaces.Discrete) else data.observations(space)
    n_arms = max([data.n_arms, *(int(space.n) for space in spaces_of_actions)])
    with as_user_error(str(data.source), ValueError):
        # Means for Discrete contexts, else regressions.
        predicted = cross_fit(contexts, data.arms, data.rewards, n_arms)
    notes = [note for policy in policies for note in _notes(data, policy)]
    rows = [
        Judged(policy.name, _judge(data, policy.name, probabilities(policy, data), predicted), True)
        for policy in policies
    ]
    for arm in range(data.n_arms):
        always = np.tile(np.eye(n_arms)[arm], (len(data), 1))
        try:
            rows.append(Judged(f"always arm {arm}", _judge(data, f"arm {arm}", always, predicted)))
        except UserError as error:
            notes.append(str(error))
    as_logged = terms_as_logged(data.arms, data.rewards, predicted)
    if data.categories is not None:
        numbered = ", ".join(f"{i} {name}" for i, name in enumerate(data.categories))
        notes.append(f"{data.context_names[0]} was read as {numbered}")
    return Comparison(data, (*rows, Judged("as logged", as_logged)), tuple(notes))


def probabilities(policy: LoggedPolicy, data: LoggedData) -> Floats:
    """The probability of each arm at each logged pull, shape (n, arms of the agent).

    Raises UserError if the agent does not observe the log's contexts, or needs more than these.
    """
    from rl_yardstick.agents.policies import policy_matrix, why_not_exact

    agent: Any = policy.agent
    with as_user_error(policy.name, ValueError):
        observations = data.observations(agent.observation_space)
    if reason := why_not_exact(agent, observations):
        raise UserError(f"{policy.name} cannot be judged on a log: {reason}")
    return policy_matrix(agent, observations)


def _judge(data: LoggedData, name: str, policy: Floats, predicted: Floats) -> PolicyTerms:
    """Evaluate a policy that may have fewer arms than the log."""
    padded = np.zeros(predicted.shape)
    padded[:, : policy.shape[1]] = policy
    assert data.propensities is not None
    with as_user_error(f"{name} on {data.source}", ValueError):
        return evaluate_policy(padded, data.arms, data.rewards, data.propensities, predicted)


def _notes(data: LoggedData, policy: LoggedPolicy) -> list[str]:
    """Notes on an agent of a log; UserError if that log numbered text contexts differently."""
    if policy.log is None or not policy.log.is_file():
        return []
    if policy.log.resolve() == Path(data.source).resolve():
        return [f"{policy.name} was trained on this log: its figures flatter it; judge by another"]
    trained = read_logged(policy.log)
    if trained.categories != data.categories:
        theirs, ours = (", ".join(log.categories or ["numbers"]) for log in (trained, data))
        raise UserError(
            f"{policy.name} was trained on {policy.log}, whose contexts are {theirs}; those of "
            f"{data.source} are {ours}"
        )
    return []
