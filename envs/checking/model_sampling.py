"""Which steps to take of an environment, to see whether its model is right."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from envs.checking.watched_env import SEED, WatchedEnv
from mdp.array_types import Floats, Ints
from mdp.frequency_evidence import frequencies
from mdp.outcome_classes import Observed
from mdp.transition_model import TransitionModel

# Shares of the budget: random episodes, then all states and actions alike, then those in doubt.
EPISODE_SHARE, SPREAD_SHARE, DOUBT_SHARE = 0.4, 0.35, 0.25
STARTS_PER_STEP = 0.02
# In each round of doubt, the number of states and actions among which its steps are shared.
DOUBTFUL = (64, 16, 4)
STEERED_PARTS = 6
STEERED_STEPS = 200
# Steps from states that were set, after which an episode begins anew.
STEPS_FROM_SET_STATES = 25
# Attempts at setting the state, and how much more likely, as a logarithm, what follows has to be.
N_ATTEMPTS = 500
CERTAIN = 20.0
RARE = 1e-3
MAX_MISSES = N_ATTEMPTS // 50


@dataclass(frozen=True)
class Budget:
    """How much to try.

    Attributes:
        steps: in all, where there are no more states and actions than that.
        limit: steps after which an episode is left.
    """

    steps: int
    limit: int


def sample(watched: WatchedEnv, budget: Budget) -> bool:
    """Play random episodes, then visit all states and actions, then those that seem wrong.

    Where the state cannot be set, episodes are steered instead, by plans on the model itself, to
    states and actions that were seen least.

    Returns:
        Whether the environment obeys where its state is set.

    Raises:
        DisagreementError: as soon as something happens that the model rules out.
    """
    rng = np.random.default_rng(SEED)
    _play_at_random(watched, rng, int(EPISODE_SHARE * budget.steps), budget.limit)
    for _ in range(int(STARTS_PER_STEP * budget.steps)):
        watched.reset()
    if not _obeys(watched, rng):
        _play_steered(watched, int((1 - EPISODE_SHARE) * budget.steps), budget.limit)
        return False
    model = watched.claim.model
    states = np.flatnonzero(model.reachable)
    rows = (states[:, None] * model.n_actions + np.arange(model.n_actions)).ravel()
    for _ in range(max(int(SPREAD_SHARE * budget.steps / len(rows)), 1)):
        _visit(watched, rng.permutation(rows))
    each = DOUBT_SHARE * budget.steps / len(DOUBTFUL)
    for number in DOUBTFUL:
        doubtful = _most_doubtful(watched, number)
        _visit(watched, np.tile(doubtful, math.ceil(each / max(len(doubtful), 1))))
    return True


def _play_at_random(watched: WatchedEnv, rng: Generator, n_steps: int, limit: int) -> None:
    for action in rng.integers(watched.claim.model.n_actions, size=n_steps).tolist():
        if watched.over or watched.time >= limit:
            watched.reset()
        watched.step(action)


def _visit(watched: WatchedEnv, rows: Ints) -> None:
    """Take a step from each of many states, with the action that belongs to it."""
    n_actions = watched.claim.model.n_actions
    for i, row in enumerate(rows.tolist()):
        if watched.over or i % STEPS_FROM_SET_STATES == 0:
            watched.reset()
        state, action = divmod(row, n_actions)
        if watched.put(state):
            watched.step(action)
        else:
            watched.reset()


def _most_doubtful(watched: WatchedEnv, number: int) -> Ints:
    """The rows whose counts speak most against the model."""
    steps, classes = watched.steps, watched.classes
    found = frequencies(steps.row, classes.place[steps.outcome], classes.row_prob, 1)
    evidence = found.evidence.max(axis=1)
    order = np.argsort(-evidence, kind="stable")[:number]
    doubtful: Ints = found.groups[order][np.isfinite(evidence[order])]
    return doubtful


def _obeys(watched: WatchedEnv, rng: Generator) -> bool:
    """Whether the environment goes on from where it is put, by what it does there.

    What comes of a step is held against the model at two places: where the environment was put,
    and where it had been before. Only states and actions that episodes have seen are tried, of
    which it is known that they hardly ever do what the model rules out. If they do now, then more
    makes up the state than what was set.
    """
    n_actions, evidence, misses = watched.claim.model.n_actions, 0.0, 0
    rows = np.unique(watched.steps.row)
    for i, row in enumerate(rng.choice(rows, N_ATTEMPTS).tolist()):
        if watched.over or i % STEPS_FROM_SET_STATES == 0:
            watched.reset()
        before = watched.state
        if not (watched.states_agree and watched.put(row // n_actions)):
            return False
        seen = watched.try_action(row % n_actions)
        if seen is None:
            return False
        stayed: Observed = (before * n_actions + row % n_actions, *seen[1:])
        there, here = (watched.classes.prob_of(where) for where in (seen, stayed))
        misses += there == 0
        evidence += math.log(max(there, RARE) / max(here, RARE))
    is_sure = watched.claim.model.n_states == 1 or evidence > CERTAIN
    return is_sure and misses <= MAX_MISSES


def _play_steered(watched: WatchedEnv, n_steps: int, limit: int) -> None:
    horizon = min(limit, STEERED_STEPS)
    for _ in range(STEERED_PARTS):
        actions = _plan_to_the_unseen(watched, horizon)
        watched.reset()
        for _ in range(n_steps // STEERED_PARTS):
            if watched.over or watched.time >= horizon:
                watched.reset()
            left = min(horizon - watched.time, len(actions))
            watched.step(int(actions[left - 1, watched.state]))


def _plan_to_the_unseen(watched: WatchedEnv, horizon: int) -> Ints:
    """What to do with 1, 2, ... steps left to see what was seen least, shape (m, S)."""
    from mdp.finite_horizon import finite_horizon_optimum

    model: TransitionModel = watched.claim.model
    visits = np.bincount(watched.steps.row, minlength=model.n_states * model.n_actions)
    prize: Floats = 1 / (1.0 + visits.reshape(model.n_states, model.n_actions, 1))
    wanted = replace(model, reward=np.broadcast_to(prize, model.prob.shape))
    return finite_horizon_optimum(wanted, horizon).actions_left.astype(np.int64)
