"""Whether an environment's model is what its `step` and `reset` do."""

from __future__ import annotations

import copy
import hashlib
import math
import operator
import pickle
import random
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from numpy.random import Generator

from envs.model_claims import Claim, claim_of
from mdp.array_types import Floats, Ints
from mdp.transition_model import TransitionModel

Env = gym.Env[Any, Any]

N_STEPS = 60_000
# Where the environment has no limit of its own.
EPISODE_LIMIT = 1000

DIFFERENT = "the environment's P is not what step does: "
SEED = 0

# What changes while an environment is played, and says nothing of its dynamics.
PLAYED = frozenset({"s", "lastaction", "spec", "render_mode", "_np_random", "_np_random_seed"})
PLAYED_KINDS = (np.random.Generator, np.random.RandomState, random.Random, gym.Space)


@dataclass(frozen=True)
class ModelCheck:
    """What came of holding a model against `step`.

    Attributes:
        refusal: why the model is not believed, in one line; None where it is.
        bit_for_bit: whether the environment draws as Gymnasium's toy_text environments do, one
            uniform number for each start and each step, looked up in the cumulative sum of the
            probabilities as ``P`` orders them, or never has anything to draw. Whoever draws so
            from the model, by the same generator, gets the very same episodes.
        state_can_be_set: whether the environment goes on from where its attribute ``s`` is put.
        n_steps: the steps that were held against the model.
    """

    refusal: str | None
    bit_for_bit: bool = False
    state_can_be_set: bool = False
    n_steps: int = 0


_checks: dict[tuple[Any, ...], ModelCheck] = {}
_kept_alive: list[object] = []


def check_transition_model(env: Env, n_steps: int = N_STEPS) -> ModelCheck:
    """Hold the model that an environment brings against what its `step` and `reset` do.

    A copy of the environment, without its wrappers, plays random episodes, up to their time limit
    or 1000 steps. Then, where its attribute ``s`` can be set, which is tried out, it takes every
    action in every state that the model says can be reached, and most often those whose frequencies
    fit least; elsewhere it is steered to where it was least.

    - Whatever the model gives no chance (a next state, a reward that differs in single precision,
      a termination or none, a start, an observation that is not the state's number, a truncation)
      is found as soon as it happens once.
    - Frequencies are held against the model's probabilities: of starts, for each state and action,
      and for all that should be alike together. A right model is refused with a chance of at most
      one in a million, if ``s``, where it can be set, is all of the state.

    A model has no memory, and is not asked for any: where frequencies depend on the time or on what
    happened before, and are on the whole as the model says, it is believed. Not found either is
    what happens too seldom to be seen, what is hidden in states that neither episodes nor setting
    ``s`` lead to, and what changes after the check. The copy is a deep one, or another environment
    made alike (see `copy_of`): the caller's episode and generators stay as they are, but what the
    environment shares with its copies, such as an attribute of its class, is used. The same
    environment is always judged in the same way, unless it draws from a generator that `reset`
    does not seed.

    Args:
        env: an environment that has ``P`` and ``initial_state_distrib``, wrapped or not.
        n_steps: steps to take; more where there are more states and actions.

    Raises:
        ValueError: if it brings no model.
    """
    base = env.unwrapped
    try:
        claim = claim_of(base)
    except ValueError as error:
        return ModelCheck(str(error))
    if claim is None:
        raise ValueError(f"{base} brings no model to check: no P and initial_state_distrib")
    return _check(base, claim, n_steps)


def checked(base: Env, claim: Claim) -> ModelCheck:
    """As `check_transition_model`, worked out once for environments of the same attributes."""
    kind = (type(base), _limit(base))
    now = (*kind, _digest(base, claim.model))
    if now not in _checks:
        # An environment that is being played differs from a new one, and yet is the same.
        new = (*kind, _digest_when_new(base, claim.model))
        if new not in _checks:
            _checks[new] = _check(base, claim, N_STEPS)
        _checks[now] = _checks[new]
    return _checks[now]


def _check(base: Env, claim: Claim, n_steps: int) -> ModelCheck:
    try:
        with global_generators_apart(SEED):
            twin = copy_of(base)
            _require_same(claim, twin)
            watched = WatchedEnv(twin, claim)
            can_be_set = sample(watched, n_steps, _limit(base))
    except DisagreementError as error:
        return ModelCheck(DIFFERENT + str(error))
    except ValueError as error:
        return ModelCheck(f"the environment's P cannot be held against step: {error}")
    odd = odd_frequency(watched)
    n_done = len(watched.steps.row)
    if odd is not None:
        return ModelCheck(DIFFERENT + odd, n_steps=n_done)
    return ModelCheck(None, watched.draws_as_toy_text(), can_be_set, n_done)


def _require_same(claim: Claim, twin: Env) -> None:
    """Make sure that a copy says the same of itself.

    Raises:
        ValueError: if it does not.
    """
    other = claim_of(twin)
    if other is None or _model_digest(other.model) != _model_digest(claim.model):
        raise ValueError("another environment made in the same way has another P")


def _limit(base: Env) -> int:
    limit = None if base.spec is None else base.spec.max_episode_steps
    return limit or EPISODE_LIMIT


def _digest_when_new(base: Env, model: TransitionModel) -> bytes:
    """The digest that the environment has at the beginning of an episode."""
    try:
        with global_generators_apart(SEED):
            twin = copy_of(base)
            twin.reset(seed=SEED)
    except Exception:  # noqa: BLE001  # whatever it is, the check will say
        return _digest(base, model)
    return _digest(twin, model)


def _digest(base: Env, model: TransitionModel) -> bytes:
    """What an environment's dynamics may depend on: its model and its attributes."""
    found = hashlib.blake2b(_model_digest(model))
    for name, value in sorted(vars(base).items()):
        if name in PLAYED or isinstance(value, PLAYED_KINDS):
            continue
        try:
            # Written to be compared, and never read.
            found.update(pickle.dumps((name, value)))
        except Exception:  # noqa: BLE001  # such as a function without a name: that very object
            _kept_alive.append(value)
            found.update(f"{name} {id(value)}".encode())
    return found.digest()


def _model_digest(model: TransitionModel) -> bytes:
    found = hashlib.blake2b(repr(model.prob.shape).encode())
    for part in (model.prob, model.next_state, model.reward, model.terminated, model.initial):
        found.update(part.tobytes())
    return found.digest()


# --- copies to try things on ----------------------------------------------------------------------


def copy_of(base: Env) -> Env:
    """An environment like this one, which draws nothing on the screen.

    It is a deep copy. Where that cannot be had (an open window, a file), another one is made as
    `gymnasium.make` made this one, and what was changed by hand since then is not in it.

    Args:
        base: an environment without wrappers.

    Raises:
        ValueError: if neither works, or if ``step`` or ``reset`` of this very object was replaced:
            that of a copy may well act on the original.
    """
    for name in ("step", "reset"):
        if name in vars(base):
            raise ValueError(f"its {name} was replaced by hand, and cannot be tried on a copy")
    try:
        twin = copy.deepcopy(base)
    except Exception as error:  # noqa: BLE001  # whatever it is that cannot be copied
        twin = _made_anew(base, error)
    if twin.render_mode is not None:
        vars(twin)["render_mode"] = None
    return twin


def _made_anew(base: Env, reason: Exception) -> Env:
    if base.spec is None:
        raise ValueError(f"it cannot be copied ({_one_line(reason)})") from reason
    try:
        return gym.make(base.spec, render_mode=None).unwrapped
    except Exception as error:
        text = f"it can neither be copied ({_one_line(reason)}) nor made anew ({_one_line(error)})"
        raise ValueError(text) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def global_generators_apart(seed: int) -> Iterator[None]:
    """Within, the generators that all code shares start from a seed; afterwards they are as before.

    Environments should not draw from them. Some do.
    """
    kept = random.getstate(), np.random.get_state()  # noqa: NPY002  # not to draw from it
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(kept[0])
        np.random.set_state(kept[1])  # noqa: NPY002


# --- what may be seen of a step -------------------------------------------------------------------

Observed = tuple[int, int, float, bool]
"""Row, next state, reward in single precision, and whether the episode terminated."""

# Probabilities within this of one are one, and rows this alike are the same.
TOLERANCE = 1e-9
MAX_TABLE = 4_000_000


class OutcomeClasses:
    """Classes of outcomes that cannot be told apart.

    Args:
        model: the transition model.

    Attributes:
        ids: the class of everything that may be observed; classes of a row follow each other, in
            the model's order.
        row: the row of each class, shape (C,).
        place: which of its row's classes it is, from 0 on, shape (C,).
        row_prob: probabilities of a row's classes, padded with zeros, shape (S * A, M).
        pattern: rows with the same probabilities have the same pattern, shape (S * A,).
        pattern_prob: the probabilities of each pattern, shape (P, M).
    """

    def __init__(self, model: TransitionModel) -> None:
        self._model = model
        n_rows = model.n_states * model.n_actions
        prob = model.prob.reshape(n_rows, -1)
        possible = prob > 0
        rows, _ = np.nonzero(possible)
        with np.errstate(over="ignore"):
            reward = model.reward.astype(np.float32)
        arrays: tuple[Any, ...] = (model.next_state, reward, model.terminated)
        seen = (part.reshape(n_rows, -1)[possible].tolist() for part in arrays)
        self.ids: dict[Observed, int] = {}
        classes = [
            self.ids.setdefault(key, len(self.ids))
            for key in zip(rows.tolist(), *seen, strict=True)
        ]
        self._of_outcome = np.full(prob.shape, -1)
        self._of_outcome[possible] = classes
        self.row: Ints = np.array([key[0] for key in self.ids])
        self.place: Ints = np.arange(len(self.row)) - np.searchsorted(self.row, self.row)
        self.row_prob = np.zeros((n_rows, int(self.place.max()) + 1))
        self.row_prob[self.row, self.place] = np.bincount(classes, prob[possible])
        self.row_prob[self.row_prob > 1 - TOLERANCE] = 1
        rounded = (self.row_prob / TOLERANCE).round()
        _, first, pattern = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
        self.pattern: Ints = pattern.reshape(-1)
        self.pattern_prob: Floats = self.row_prob[first]

    def prob_of(self, observed: Observed) -> float:
        """The probability that the model gives to what was observed."""
        found = self.ids.get(observed)
        return 0.0 if found is None else float(self.row_prob[observed[0], self.place[found]])

    def predicted(self, rows: Ints, uniforms: Floats) -> tuple[Ints, Floats]:
        """What `categorical_sample` of Gymnasium's toy_text makes of uniform numbers.

        Args:
            rows: where they are drawn, shape (n,).
            uniforms: the numbers, shape (n,).

        Returns:
            Classes, shape (n,), -1 where an outcome without probability is drawn; and rewards in
            full precision, likewise.
        """
        n_rows, n_outcomes = self._of_outcome.shape
        cumulative = np.cumsum(self._model.prob, axis=2).reshape(n_rows, -1)
        chosen = np.zeros(len(rows), np.int64)
        for start in range(0, len(rows), max(MAX_TABLE // n_outcomes, 1)):
            part = slice(start, start + max(MAX_TABLE // n_outcomes, 1))
            chosen[part] = np.argmax(cumulative[rows[part]] > uniforms[part, None], axis=1)
        reward = self._model.reward.reshape(n_rows, -1)
        return self._of_outcome[rows, chosen], reward[rows, chosen]


# --- an environment that is watched ---------------------------------------------------------------


class DisagreementError(Exception):
    """An environment did what its model rules out; the message is one line."""


class Steps(NamedTuple):
    """Steps as they are written down; all arrays have shape (n,)."""

    row: Ints  # ``state * A + action``
    outcome: Ints  # its class in `OutcomeClasses`
    draw: Ints  # how many uniform numbers had been drawn, if one is for each step and each start


class WatchedEnv:
    """Steps a copy of an environment, and holds each step against the model that it claims.

    After an error it is where nobody knows: `reset` it.
    """

    def __init__(self, env: Env, claim: Claim) -> None:
        self.env: Any = env
        self.claim = claim
        self.classes = OutcomeClasses(claim.model)
        self._log, self._rewards = array("q"), array("d")
        # Where episodes began, and the number of draws before that.
        self.starts: list[tuple[int, int]] = []
        # Where it is, the steps since the episode began, and whether it has ended.
        self.state, self.time, self.over = 0, 0, True
        self._initial = claim.model.initial.tolist()
        self._n_actions = claim.model.n_actions
        self._draws = 0

    def reset(self) -> None:
        """Begin an episode, which may begin where the model rules it out: DisagreementError."""
        try:
            # Seeded once, as trainings are: what comes later follows from it.
            obs, _ = self.env.reset(seed=None if self.starts else SEED)
        except Exception as error:
            raise DisagreementError(f"reset raised {_error_text(error)}") from error
        self.state = self._state_of(obs, None)
        if self._initial[self.state] <= 0:
            raise DisagreementError(
                f"reset gave state {self.state}, "
                "where initial_state_distrib says that no episode begins"
            )
        self.starts.append((self.state, self._draws))
        self._draws += 1
        self.time, self.over = 0, False

    def step(self, action: int) -> None:
        """Take a step and write it down, unless the model rules it out: DisagreementError."""
        row = self.state * self._n_actions + action
        n_drawn = self._draws
        seen, reward = self._act(row)
        outcome = self.classes.ids.get(seen)
        if outcome is None:
            raise DisagreementError(f"{self._where(row)}: {self._difference(seen)}")
        self._log.extend((row, outcome, n_drawn))
        self._rewards.append(reward)
        self.time += 1

    @property
    def steps(self) -> Steps:
        """All steps but those of `try_action`."""
        return Steps(*np.array(self._log).reshape(-1, len(Steps._fields)).T)

    def put(self, state: int) -> bool:
        """Put the environment into a state, if it lets its attribute ``s`` be set."""
        try:
            self.env.s = state
        except Exception:  # noqa: BLE001  # a setter may refuse in any way
            return False
        self.state = state
        return self.states_agree

    def try_action(self, action: int) -> Observed | None:
        """Act without holding what comes of it against the model; None if that cannot be done."""
        try:
            return self._act(self.state * self._n_actions + action)[0]
        except DisagreementError:
            return None

    @property
    def states_agree(self) -> bool:
        """Whether the environment's attribute ``s`` is where it is."""
        try:
            return operator.index(self.env.s) == self.state
        except (AttributeError, TypeError):
            return False

    def draws_as_toy_text(self) -> bool:
        """Whether all that was seen is what toy_text makes of the generator's uniform numbers.

        Of one for each start and each step, by `OutcomeClasses.predicted`.
        """
        generator, _ = seeding.np_random(SEED)
        uniforms = generator.random(self._draws)
        steps = self.steps
        predicted, rewards = self.classes.predicted(steps.row, uniforms[steps.draw])
        starts = np.array(self.starts)
        cumulative = np.cumsum(self.claim.model.initial)
        first = [np.argmax(cumulative > uniform) for uniform in uniforms[starts[:, 1]]]
        return (
            np.array_equal(predicted, steps.outcome)
            and np.array_equal(rewards, np.array(self._rewards))
            and np.array_equal(first, starts[:, 0])
        )

    def _act(self, row: int) -> tuple[Observed, float]:
        try:
            obs, reward, terminated, truncated, _ = self.env.step(row % self._n_actions)
            reward, self.over = float(reward), bool(terminated)
        except Exception as error:
            text = f"{self._where(row)}: step raised {_error_text(error)}"
            raise DisagreementError(text) from error
        self._draws += 1
        self.state = self._state_of(obs, row)
        if truncated:
            raise DisagreementError(
                f"{self._where(row)}: step gave truncated, which no model holds: "
                "leave time limits to max_episode_steps"
            )
        return (row, self.state, float(np.float32(reward)), self.over), reward

    def _state_of(self, obs: Any, row: int | None) -> int:
        """Where the environment is after a row, or a start, by what is observed."""
        by_obs = self.claim.observes_states
        found: Any = obs if by_obs else getattr(self.env, "s", None)
        try:
            state = operator.index(found)
        except TypeError:
            what = "observation" if by_obs else "attribute s"
            text = f"{self._where(row)}: the {what} is {found!r}, not the number of a state"
            raise DisagreementError(" ".join(text.split())) from None
        if not 0 <= state < len(self._initial):
            text = f"P has states 0 to {len(self._initial) - 1}, this led to {state}"
            raise DisagreementError(f"{self._where(row)}: {text}")
        expected = self.claim.observations
        if not (by_obs or expected is None or np.array_equal(expected[state], obs)):
            text = f"{self._where(row)}: state {state} was observed as {obs}, not {expected[state]}"
            raise DisagreementError(" ".join(text.split()))
        return state

    def _where(self, row: int | None) -> str:
        return "reset" if row is None else row_text(row, self._n_actions)

    def _difference(self, seen: Observed) -> str:
        classes = self.classes
        here = [key for key in classes.ids if key[0] == seen[0]]
        said = " or ".join(map(outcome_text, here[:3]))
        more = f" or {len(here) - 3} others" if len(here) > 3 else ""
        return f"P says {said}{more}, step gave {outcome_text(seen)}"


def outcome_text(seen: Observed) -> str:
    """An outcome in words."""
    _, state, reward, terminated = seen
    # The shortest number that is the same in single precision.
    return f"state {state} with reward {np.float32(reward)}{', terminated' if terminated else ''}"


def row_text(row: int, n_actions: int) -> str:
    """A state and an action in words."""
    state, action = divmod(row, n_actions)
    return f"state {state}, action {action}"


def _error_text(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


# --- which steps to take --------------------------------------------------------------------------

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


def sample(watched: WatchedEnv, n_steps: int, limit: int) -> bool:
    """Play random episodes, then visit all states and actions, then those that seem wrong.

    Where the state cannot be set, episodes are steered instead, by plans on the model itself, to
    states and actions that were seen least.

    Args:
        watched: the environment.
        n_steps: steps in all, where there are no more states and actions than that.
        limit: steps after which an episode is left.

    Returns:
        Whether the environment obeys where its state is set.

    Raises:
        DisagreementError: as soon as something happens that the model rules out.
    """
    rng = np.random.default_rng(SEED)
    _play_at_random(watched, rng, int(EPISODE_SHARE * n_steps), limit)
    for _ in range(int(STARTS_PER_STEP * n_steps)):
        watched.reset()
    if not _obeys(watched, rng):
        _play_steered(watched, int((1 - EPISODE_SHARE) * n_steps), limit)
        return False
    model = watched.claim.model
    states = np.flatnonzero(model.reachable)
    rows = (states[:, None] * model.n_actions + np.arange(model.n_actions)).ravel()
    for _ in range(max(int(SPREAD_SHARE * n_steps / len(rows)), 1)):
        _visit(watched, rng.permutation(rows))
    each = DOUBT_SHARE * n_steps / len(DOUBTFUL)
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
    found = frequencies(steps.row, classes.place[steps.outcome], classes.row_prob)
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


# --- counts that the right probabilities would not have led to ------------------------------------
# A test at a fixed number of draws goes wrong where what is seen decides what is drawn next, as the
# states of episodes do. A likelihood ratio does not: where the probabilities are right, that of any
# mixture of others to them is a martingale with mean one, and exceeds 1/alpha, ever, with
# probability alpha at most (Ville, Étude critique de la notion de collectif, 1939; Robbins, Annals
# of Mathematical Statistics 41, 1970). Nothing is approximated, at any number of draws.

# The chance that counts of a right model are called odd: over all that is looked at.
FALSE_ALARMS = 1e-6
N_FAMILIES = 3


def odd_frequency(watched: WatchedEnv) -> str | None:
    """What an environment did too often or too seldom, in one line.

    Under the right probabilities there is one with a chance of at most `FALSE_ALARMS`, however the
    steps were chosen.
    """
    initial = watched.claim.model.initial
    possible = np.flatnonzero(initial)
    starts = np.searchsorted(possible, [state for state, _ in watched.starts])
    odd = _oddest(0 * starts, starts, initial[possible][None], len(possible))
    if odd is not None:
        return (
            f"initial_state_distrib says state {possible[odd.outcome]} in "
            f"{initial[possible[odd.outcome]]:.1%} of cases, reset gave it in "
            f"{odd.times / odd.trials:.1%} of {odd.trials:,}"
        )
    steps, classes = watched.steps, watched.classes
    rows, places = steps.row, classes.place[steps.outcome]
    odd, where = _oddest(rows, places, classes.row_prob, len(classes.row)), ""
    if odd is None:
        patterns, n_tests = classes.pattern[rows], int(np.count_nonzero(classes.pattern_prob))
        odd = _oddest(patterns, places, classes.pattern_prob, n_tests)
        if odd is None:
            return None
        odd = odd._replace(group=int(rows[np.argmax(patterns == odd.group)]))
        where = ", counted over all that P gives these probabilities"
    outcome = list(classes.ids)[int(np.searchsorted(classes.row, odd.group)) + odd.outcome]
    return (
        f"{row_text(odd.group, watched.claim.model.n_actions)}: P says {outcome_text(outcome)} in "
        f"{classes.row_prob[odd.group, odd.outcome]:.1%} of cases, step gave it in "
        f"{odd.times / odd.trials:.1%} of {odd.trials:,}{where}"
    )


class Odd(NamedTuple):
    """The oddest count: of which outcome, in which group, how often, of how many."""

    group: int
    outcome: int
    times: int
    trials: int


def _oddest(groups: Ints, outcomes: Ints, probabilities: Floats, n_tests: int) -> Odd | None:
    """The count that speaks most against its probability, if that is beyond chance.

    ``n_tests`` counts all groups and outcomes that could be looked at, whether they came up or not.
    """
    if not len(groups):
        return None
    found = frequencies(groups, outcomes, probabilities)
    group, outcome = np.unravel_index(np.argmax(found.evidence), found.evidence.shape)
    if found.evidence[group, outcome] < math.log(N_FAMILIES * n_tests / FALSE_ALARMS):
        return None
    counts = found.counts[group]
    return Odd(int(found.groups[group]), int(outcome), int(counts[outcome]), int(counts.sum()))


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


def frequencies(groups: Ints, outcomes: Ints, probabilities: Floats) -> Frequencies:
    """Count draws, and hold each outcome's count against its probability.

    Args:
        groups: the group of each draw, from 0 on, shape (n,).
        outcomes: what was drawn, 0 to K - 1, shape (n,).
        probabilities: of the outcomes in each group, shape (H, K).
    """
    n_outcomes = probabilities.shape[1]
    found, index = np.unique(groups, return_inverse=True)
    cells = index * n_outcomes + outcomes
    counts = np.bincount(cells, minlength=len(found) * n_outcomes).reshape(-1, n_outcomes)
    evidence = log_evidence(counts, counts.sum(1, keepdims=True), probabilities[found])
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
