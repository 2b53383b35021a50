"""Evaluates trained agents on logged pulls, for ``compare.py --logged``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from rl_yardstick.envs.bandits import LoggedData
from rl_yardstick.experiments.off_policy.estimators import (
    CrossFit,
    PolicyTerms,
    check_rewards,
    cross_fit,
    evaluate_policy,
    terms_as_logged,
)
from rl_yardstick.experiments.off_policy.policy_files import PolicyFile, read_logged
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.policies import policy_matrix, why_not_exact
from rl_yardstick.pipeline.models.load import load_model
from rl_yardstick.pipeline.user_modules import UserModule


@dataclass(frozen=True)
class LoggedPolicy:
    """A trained agent for evaluation on a log."""

    name: str  # its path, as given
    agent: BaseAlgorithm  # the loaded agent
    # The log of its training; None if there was none, or it is unknown.
    log: Path | None


@dataclass(frozen=True)
class Judged:
    """One row of the comparison."""

    name: str  # of the policy
    terms: PolicyTerms  # the terms of its estimates
    # Whether the user asked about this policy; otherwise it is an alternative.
    is_given: bool = False


@dataclass(frozen=True)
class Comparison:
    """The comparison of policies on one log."""

    data: LoggedData  # the log
    # The user's policies; then each arm as a constant policy, and the log's own policy.
    rows: tuple[Judged, ...]
    notes: tuple[str, ...]  # notes for reading the figures


def load_policy(found: PolicyFile, modules: Iterable[UserModule] = ()) -> LoggedPolicy:
    """Load an agent; ``modules`` are the typed modules, which it may need.

    Raises:
        UserError: if it cannot be loaded, or its actions are not numbered.
    """
    agent = load_model(found.algo, found.model, modules=modules, device="cpu")
    if not isinstance(agent.action_space, spaces.Discrete):
        raise UserError(f"{found.name} chooses no arms: its actions are {agent.action_space}")
    return LoggedPolicy(found.name, agent, found.log)


def compare_policies(data: LoggedData, policies: Sequence[LoggedPolicy]) -> Comparison:
    """Evaluate policies, each arm as a constant policy, and the log's own policy.

    Raises:
        UserError: if a policy does not fit the log, or the log cannot support an estimate.
    """
    model = reward_model(data, max([data.n_arms, *(n_arms(p.agent) for p in policies)]))
    notes = [note for policy in policies for note in _notes(data, policy)]
    rows = [
        Judged(policy.name, _judge(data, policy.name, probabilities(policy, data), model), True)
        for policy in policies
    ]
    for arm in range(data.n_arms):
        always = np.zeros(model.predicted.shape)
        always[:, arm] = 1
        try:
            rows.append(Judged(f"always arm {arm}", _judge(data, f"arm {arm}", always, model)))
        except UserError as error:
            notes.append(str(error))
    as_logged = terms_as_logged(data.arms, data.rewards, model)
    if data.categories is not None:
        numbered = ", ".join(f"{i} {name}" for i, name in enumerate(data.categories))
        notes.append(f"{data.context_names[0]} was read as {numbered}")
    return Comparison(data, (*rows, Judged("as logged", as_logged)), tuple(notes))


def reward_model(data: LoggedData, n_arms: int) -> CrossFit:
    """Fit means of the rewards for Discrete contexts, else regressions.

    Raises:
        UserError: if there are too few pulls.
    """
    space = data.observation_space
    discrete = isinstance(space, spaces.Discrete)
    contexts = data.observations(space) if discrete else data.contexts
    try:
        check_rewards(data.rewards, len(data))
        return cross_fit(contexts, data.arms, data.rewards, n_arms)
    except ValueError as error:
        raise UserError(f"{data.source}: {one_line(error)}") from error


def probabilities(policy: LoggedPolicy, data: LoggedData) -> Floats:
    """The probability of each arm at each logged pull, shape (n, arms of the agent).

    Raises:
        UserError: if the agent does not observe the log's contexts, or needs further
            observations.
    """
    agent: Any = policy.agent
    try:
        observations = data.observations(agent.observation_space)
    except ValueError as error:
        raise UserError(f"{policy.name}: {one_line(error)}") from error
    reason = why_not_exact(agent, observations)
    if reason:
        raise UserError(f"{policy.name} cannot be judged on a log: {reason}")
    try:
        return policy_matrix(agent, observations)
    except (TypeError, ValueError) as error:
        raise UserError(f"{policy.name} cannot be judged on a log: {one_line(error)}") from error


def n_arms(agent: BaseAlgorithm) -> int:
    """The number of arms of an agent."""
    assert isinstance(agent.action_space, spaces.Discrete)
    return int(agent.action_space.n)


def _judge(data: LoggedData, name: str, policy: Floats, model: CrossFit) -> PolicyTerms:
    """Evaluate a policy that may have fewer arms than the log."""
    padded = np.zeros(model.predicted.shape)
    padded[:, : policy.shape[1]] = policy
    assert data.propensities is not None
    try:
        return evaluate_policy(padded, data.arms, data.rewards, data.propensities, model)
    except ValueError as error:
        raise UserError(f"{name} on {data.source}: {one_line(error)}") from error


def _notes(data: LoggedData, policy: LoggedPolicy) -> list[str]:
    """Notes on an agent that was trained on a log.

    Raises:
        UserError: if that log numbered text contexts differently.
    """
    if policy.log is None or not policy.log.is_file():
        return []
    if policy.log.resolve() == Path(data.source).resolve():
        return [f"{policy.name} was trained on this log: its figures flatter it; judge by another"]
    trained = read_logged(policy.log)
    if trained.categories != data.categories:
        raise UserError(
            f"{policy.name} was trained on {policy.log}, whose contexts are "
            f"{_listed(trained)}; those of {data.source} are {_listed(data)}"
        )
    return []


def _listed(data: LoggedData) -> str:
    return "numbers" if data.categories is None else ", ".join(data.categories)
