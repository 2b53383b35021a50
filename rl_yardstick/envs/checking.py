"""Check an environment's transition model against its `step` and `reset`."""

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

from rl_yardstick.envs.finite_env import first_above
from rl_yardstick.envs.model_claims import Claim, claim_of, one_line
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

Env = gym.Env[Any, Any]

N_STEPS = 60_000
# Where the environment has no limit of its own.
EPISODE_LIMIT = 1000

DIFFERENT = "the environment's P is not what step does: "
SEED = 0

# Attributes that change while an environment is played, and do not affect its dynamics.
PLAYED = frozenset({"s", "lastaction", "spec", "render_mode", "_np_random", "_np_random_seed"})
PLAYED_KINDS = (np.random.Generator, np.random.RandomState, random.Random, gym.Space)


@dataclass(frozen=True)
class ModelCheck:
    """The result of a check of a model against `step`.

    Attributes:
        refusal: why the model is rejected, in one line; None where it is accepted.
        bit_for_bit: whether the environment samples as Gymnasium's toy_text environments do: one
            uniform number for each start and each step, looked up in the cumulative sum of the
            probabilities in the order of ``P``; or has nothing to sample. Sampling from the model
            with the same generator then gives the same episodes.
        state_can_be_set: whether setting the attribute ``s`` sets the environment's state.
        n_steps: the steps that were compared with the model.
    """

    refusal: str | None
    bit_for_bit: bool = False
    state_can_be_set: bool = False
    n_steps: int = 0


_checks: dict[tuple[Any, ...], ModelCheck] = {}
_kept_alive: list[object] = []  # objects that are identified by their id


def check_transition_model(env: Env, n_steps: int = N_STEPS) -> ModelCheck:
    """Compare an environment's own model with its `step` and `reset`.

    A copy of the environment, without its wrappers, plays random episodes, up to their time limit
    or 1000 steps. Then, if trials show that its attribute ``s`` sets the state, it takes every
    action in every state that the model can reach, and most often those whose frequencies fit
    worst; otherwise it follows plans to the states and actions seen least.

    - An event of probability zero in the model (a next state, a reward that differs in single
      precision, a termination or none, a start, an observation that is not the state's number, a
      truncation) is found as soon as it happens once.
    - Frequencies are tested against the model's probabilities: of starts, for each state and
      action, and for all with equal probabilities together. A correct model is rejected with a
      probability of at most one in a million, if ``s``, where it can be set, is the whole state.

    The Markov property is not tested: where frequencies depend on time or history, but agree with
    the model on average, the model is accepted. Nor does the check find events too rare to happen,
    states that neither episodes nor setting ``s`` lead to, and changes after the check. The copy is
    a deep one, or another environment made alike: the caller's episode and generators do not
    change, but objects that copies share, such as class attributes, may. The same environment
    always gets the same result, unless it draws from a generator that `reset` does not seed.

    Args:
        env: an environment that has ``P`` and ``initial_state_distrib``, wrapped or not.
        n_steps: steps to take; more where there are more states and actions.

    Raises:
        ValueError: if the environment has no model.
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
    """As `check_transition_model`, cached for environments of the same attributes."""
    kind = (type(base), _limit(base))
    now = (*kind, _digest(base, claim.model))
    if now not in _checks:
        # During an episode the attributes differ from those of a new environment: try both.
        new = (*kind, _digest_when_new(base, claim.model))
        if new not in _checks:
            _checks[new] = _check(base, claim, N_STEPS)
        _checks[now] = _checks[new]
    return _checks[now]


def _check(base: Env, claim: Claim, n_steps: int) -> ModelCheck:
    try:
        with _global_generators_apart():
            twin = _copy_of(base)
            other = claim_of(twin)
            if other is None or _model_digest(other.model) != _model_digest(claim.model):
                raise ValueError("another environment made in the same way has another P")
            trial = Trial(twin, claim, _limit(base))
            can_be_set = trial.run(n_steps)
    except DisagreementError as error:
        return ModelCheck(DIFFERENT + str(error))
    except ValueError as error:
        return ModelCheck(f"the environment's P cannot be held against step: {error}")
    odd, n_done = odd_frequency(trial), len(trial.steps[0])
    if odd is not None:
        return ModelCheck(DIFFERENT + odd, n_steps=n_done)
    return ModelCheck(None, trial.draws_as_toy_text(), can_be_set, n_done)


def _limit(base: Env) -> int:
    limit = None if base.spec is None else base.spec.max_episode_steps
    return limit or EPISODE_LIMIT


def _digest_when_new(base: Env, model: TransitionModel) -> bytes:
    """The digest that the environment has at the beginning of an episode."""
    try:
        with _global_generators_apart():
            twin = _copy_of(base)
            twin.reset(seed=SEED)
    except Exception:  # noqa: BLE001  # the check will report it
        return _digest(base, model)
    return _digest(twin, model)


def _digest(base: Env, model: TransitionModel) -> bytes:
    """What an environment's dynamics may depend on: its model and its attributes."""
    found = hashlib.blake2b(_model_digest(model))
    for name, value in sorted(vars(base).items()):
        if name in PLAYED or isinstance(value, PLAYED_KINDS):
            continue
        try:
            # Pickled for comparison, and never loaded.
            found.update(pickle.dumps((name, value)))
        except Exception:  # noqa: BLE001  # such as a lambda: identified by its id
            _kept_alive.append(value)
            found.update(f"{name} {id(value)}".encode())
    return found.digest()


def _model_digest(model: TransitionModel) -> bytes:
    found = hashlib.blake2b(repr(model.prob.shape).encode())
    for part in (model.prob, model.next_state, model.reward, model.terminated, model.initial):
        found.update(part.tobytes())
    return found.digest()


def _copy_of(base: Env) -> Env:
    """A deep copy without rendering; where that fails, an environment of the same spec."""
    for name in ("step", "reset"):
        if name in vars(base):  # that of a copy may act on the original
            raise ValueError(f"its {name} was replaced by hand, and cannot be tried on a copy")
    try:
        twin = copy.deepcopy(base)
    except Exception as error:
        reason = f"be copied ({one_line(error)})"
        if base.spec is None:
            raise ValueError(f"it cannot {reason}") from error
        try:
            spec = copy.deepcopy(base.spec)
            spec.kwargs.pop("render_mode", None)  # not every class has this argument
            twin = gym.make(spec).unwrapped
        except Exception as new:
            raise ValueError(f"it can neither {reason} nor made anew ({one_line(new)})") from new
    if twin.render_mode is not None:
        vars(twin)["render_mode"] = None
    return twin


@contextmanager
def _global_generators_apart() -> Iterator[None]:
    """Seed the global generators, which some environments use, and restore them afterwards."""
    kept = random.getstate(), np.random.get_state()  # noqa: NPY002  # not to draw from it
    random.seed(SEED)
    np.random.seed(SEED)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(kept[0])
        np.random.set_state(kept[1])  # noqa: NPY002


# An observed step: row (``state * A + action``), next state, reward in single precision, and
# whether the episode terminated.
Observed = tuple[int, int, float, bool]

# Probabilities within this of one are one, and rows this alike are the same.
TOLERANCE = 1e-9


class OutcomeClasses:
    """A model's outcomes in classes: outcomes that are observed alike form one class."""

    def __init__(self, model: TransitionModel) -> None:
        n_rows = model.n_states * model.n_actions
        prob = model.prob.reshape(n_rows, -1)
        possible = prob > 0
        rows, _ = np.nonzero(possible)
        with np.errstate(over="ignore"):
            reward = model.reward.astype(np.float32)
        arrays: tuple[Any, ...] = (model.next_state, reward, model.terminated)
        seen = (part.reshape(n_rows, -1)[possible].tolist() for part in arrays)
        # The number of each class; those of a row follow each other, in the model's order.
        self.ids: dict[Observed, int] = {}
        classes = [
            self.ids.setdefault(key, len(self.ids))
            for key in zip(rows.tolist(), *seen, strict=True)
        ]
        self.row: Ints = np.array([key[0] for key in self.ids])  # of each class, shape (C,)
        # The index of each class among those of its row, shape (C,).
        self.place: Ints = np.arange(len(self.row)) - np.searchsorted(self.row, self.row)
        self.of_outcome = np.full(prob.shape, -1)  # the class of each outcome of a row
        self.of_outcome[possible] = classes
        self.prob = np.zeros((n_rows, int(self.place.max()) + 1))
        self.prob[self.row, self.place] = np.bincount(classes, prob[possible])
        self.prob[self.prob > 1 - TOLERANCE] = 1

    def prob_of(self, observed: Observed) -> float:
        """The probability that the model gives to what was observed."""
        found = self.ids.get(observed)
        return 0.0 if found is None else float(self.prob[observed[0], self.place[found]])


class DisagreementError(Exception):
    """An environment did what its model rules out; the message is one line."""


# Shares of the budget: random episodes, then all states and actions alike, then those in doubt.
EPISODE_SHARE, SPREAD_SHARE, DOUBT_SHARE = 0.4, 0.35, 0.25
STARTS_PER_STEP = 0.02
# In each round of doubt, the number of states and actions among which its steps are shared.
DOUBTFUL = (64, 16, 4)
STEERED_PARTS = 6
STEERED_STEPS = 200
# The number of steps from states that were set, after which an episode begins anew.
STEPS_FROM_SET_STATES = 25
# The number of attempts at setting the state, and the log-likelihood ratio that shows success.
N_ATTEMPTS = 500
CERTAIN = 20.0
RARE = 1e-3
MAX_MISSES = N_ATTEMPTS // 50


class Trial:
    """Plays a copy of an environment, and compares each step with its claimed model."""

    def __init__(self, env: Env, claim: Claim, limit: int) -> None:
        self.env: Any = env
        self.claim, self.model = claim, claim.model
        self.n_states, self.n_actions = self.model.n_states, self.model.n_actions
        self.limit = limit  # steps after which an episode is left
        self.classes = OutcomeClasses(self.model)
        self.state, self.time, self.over = 0, 0, True
        # The starting state of each episode, and the class of each step's outcome; each followed
        # by the number of uniform numbers drawn before, if each start and step draws one.
        self._starts, self._steps, self._rewards = array("q"), array("q"), array("d")
        self._n_drawn = 0
        self._rng = np.random.default_rng(SEED)

    def run(self, n_steps: int) -> bool:
        """Play random episodes, then visit all states and actions, then those that seem wrong.

        Where the state cannot be set, episodes follow plans made on the model instead, to states
        and actions seen least. Returns whether the state can be set; raises DisagreementError as
        soon as something happens that the model rules out.
        """
        n_random = int(EPISODE_SHARE * n_steps)
        for action in self._rng.integers(self.n_actions, size=n_random).tolist():
            if self.over or self.time >= self.limit:
                self._reset()
            self._step(action)
        for _ in range(int(STARTS_PER_STEP * n_steps)):
            self._reset()
        if not self._obeys():
            self._play_steered(int((1 - EPISODE_SHARE) * n_steps))
            return False
        states = np.flatnonzero(self.model.reachable)
        rows = (states[:, None] * self.n_actions + np.arange(self.n_actions)).ravel()
        for _ in range(max(int(SPREAD_SHARE * n_steps / len(rows)), 1)):
            self._visit(self._rng.permutation(rows))
        each = DOUBT_SHARE * n_steps / len(DOUBTFUL)
        for number in DOUBTFUL:
            doubtful = self._most_doubtful(number)
            self._visit(np.tile(doubtful, math.ceil(each / max(len(doubtful), 1))))
        return True

    @property
    def starts(self) -> Ints:
        """The state in which each episode began, shape (n,)."""
        return np.array(self._starts[::2])

    @property
    def steps(self) -> tuple[Ints, Ints]:
        """The row of each step, and which of its classes was seen; each of shape (n,)."""
        outcomes = np.array(self._steps[::2])
        return self.classes.row[outcomes], self.classes.place[outcomes]

    def draws_as_toy_text(self) -> bool:
        """Whether all outcomes are those of toy_text's sampling with the same generator."""
        generator, _ = seeding.np_random(SEED)
        uniforms = generator.random(self._n_drawn)
        starts_upto, drawn = np.cumsum(self.model.initial), uniforms[self._steps[1::2]]
        first = [first_above(starts_upto, uniform) for uniform in uniforms[self._starts[1::2]]]
        rows, _ = self.steps
        upto = np.cumsum(self.model.prob, axis=2).reshape(self.classes.of_outcome.shape)
        chosen = np.zeros(len(rows), np.int64)  # the first, where rounding leaves none
        for k in reversed(range(upto.shape[1])):
            chosen[upto[rows, k] > drawn] = k
        return (
            np.array_equal(first, self.starts)
            and np.array_equal(self.classes.of_outcome[rows, chosen], self._steps[::2])
            and np.array_equal(self.model.reward.reshape(upto.shape)[rows, chosen], self._rewards)
        )

    def row_text(self, row: int) -> str:
        """A state and an action in words."""
        state, action = divmod(row, self.n_actions)
        return f"state {state}, action {action}"

    def _visit(self, rows: Ints) -> None:
        """Take a step from each of many states, with the action that belongs to it."""
        for i, row in enumerate(rows.tolist()):
            if self.over or i % STEPS_FROM_SET_STATES == 0:
                self._reset()
            state, action = divmod(row, self.n_actions)
            if self._put(state):
                self._step(action)
            else:
                self._reset()

    def _most_doubtful(self, number: int) -> Ints:
        """The rows whose counts speak most against the model."""
        rows, _, evidence = frequencies(*self.steps, self.classes.prob)
        strongest = evidence.max(axis=1)
        order = np.argsort(-strongest, kind="stable")[:number]
        doubtful: Ints = rows[order][np.isfinite(strongest[order])]
        return doubtful

    def _obeys(self) -> bool:
        """Whether setting ``s`` sets the whole state, so that the environment goes on from there.

        Only states and actions that episodes have seen are tried, in which the environment did what
        the model says. If it does not now, ``s`` is not the whole state.
        """
        n_actions, evidence, misses = self.n_actions, 0.0, 0
        rows = np.unique(self.steps[0])
        for i, row in enumerate(self._rng.choice(rows, N_ATTEMPTS).tolist()):
            if self.over or i % STEPS_FROM_SET_STATES == 0:
                self._reset()
            before = self.state
            if not (self._states_agree() and self._put(row // n_actions)):
                return False
            try:
                seen, _ = self._act(row % n_actions)
            except DisagreementError:
                return False
            stayed: Observed = (before * n_actions + row % n_actions, *seen[1:])
            there, here = (self.classes.prob_of(where) for where in (seen, stayed))
            misses += there == 0
            evidence += math.log(max(there, RARE) / max(here, RARE))
        is_sure = self.n_states == 1 or evidence > CERTAIN
        return is_sure and misses <= MAX_MISSES

    def _play_steered(self, n_steps: int) -> None:
        horizon = min(self.limit, STEERED_STEPS)
        for _ in range(STEERED_PARTS):
            actions = self._plan_to_the_unseen(horizon)
            self._reset()
            for _ in range(n_steps // STEERED_PARTS):
                if self.over or self.time >= horizon:
                    self._reset()
                left = min(horizon - self.time, len(actions))
                self._step(int(actions[left - 1, self.state]))

    def _plan_to_the_unseen(self, horizon: int) -> Ints:
        """Actions with 1, 2, ... steps left that lead to what was seen least, shape (m, S)."""
        from rl_yardstick.mdp.finite_horizon import finite_horizon_optimum

        visits = np.bincount(self.steps[0], minlength=len(self.classes.prob))
        prize: Floats = 1 / (1.0 + visits.reshape(self.n_states, -1, 1))
        wanted = replace(self.model, reward=np.broadcast_to(prize, self.model.prob.shape))
        return finite_horizon_optimum(wanted, horizon).actions_left.astype(np.int64)

    def _reset(self) -> None:
        try:
            # Seeded once, as trainings are: what comes later follows from it.
            obs, _ = self.env.reset(seed=None if self._starts else SEED)
        except Exception as error:
            raise DisagreementError(f"reset raised {_error_text(error)}") from error
        self.state = self._state_of(obs, None)
        if self.model.initial[self.state] <= 0:
            raise DisagreementError(
                f"reset gave state {self.state}, "
                "where initial_state_distrib says that no episode begins"
            )
        self._starts.extend((self.state, self._n_drawn))
        self._n_drawn += 1
        self.time, self.over = 0, False

    def _step(self, action: int) -> None:
        """Take a step and count its outcome."""
        n_drawn = self._n_drawn
        seen, reward = self._act(action)
        outcome = self.classes.ids.get(seen)
        if outcome is None:
            here = [key for key in self.classes.ids if key[0] == seen[0]]
            said = " or ".join(map(outcome_text, here[:3]))
            more = f" or {len(here) - 3} others" if len(here) > 3 else ""
            text = f"P says {said}{more}, step gave {outcome_text(seen)}"
            raise self._disagreement(seen[0], text)
        self._steps.extend((outcome, n_drawn))
        self._rewards.append(reward)
        self.time += 1

    def _act(self, action: int) -> tuple[Observed, float]:
        """The outcome of an action as observed, and the reward in full precision."""
        row = self.state * self.n_actions + action
        try:
            obs, reward, terminated, truncated, _ = self.env.step(action)
            reward, self.over = float(reward), bool(terminated)
        except Exception as error:
            raise self._disagreement(row, f"step raised {_error_text(error)}") from error
        self._n_drawn += 1
        self.state = self._state_of(obs, row)
        if truncated:
            text = "step gave truncated, which no model holds: leave time limits to"
            raise self._disagreement(row, f"{text} max_episode_steps")
        return (row, self.state, float(np.float32(reward)), self.over), reward

    def _put(self, state: int) -> bool:
        """Put the environment into a state, if it lets its attribute ``s`` be set."""
        try:
            self.env.s = state
        except Exception:  # noqa: BLE001  # a setter may refuse in any way
            return False
        self.state = state
        return self._states_agree()

    def _states_agree(self) -> bool:
        """Whether the environment's attribute ``s`` equals the observed state."""
        try:
            return operator.index(self.env.s) == self.state
        except (AttributeError, TypeError):
            return False

    def _state_of(self, obs: Any, row: int | None) -> int:
        """The state after a row, or a start (None), from the observation or ``s``."""
        by_obs = self.claim.observes_states
        found: Any = obs if by_obs else getattr(self.env, "s", None)
        try:
            state = operator.index(found)
        except TypeError:
            what = "observation" if by_obs else "attribute s"
            text = f"the {what} is {found!r}, not the number of a state"
            raise self._disagreement(row, text) from None
        if not 0 <= state < self.n_states:
            text = f"P has states 0 to {self.n_states - 1}, this led to {state}"
            raise self._disagreement(row, text)
        expected = self.claim.observations
        if not (by_obs or expected is None or np.array_equal(expected[state], obs)):
            text = f"state {state} was observed as {obs}, not {expected[state]}"
            raise self._disagreement(row, text)
        return state

    def _disagreement(self, row: int | None, text: str) -> DisagreementError:
        where = "reset" if row is None else self.row_text(row)
        return DisagreementError(" ".join(f"{where}: {text}".split()))


def outcome_text(seen: Observed) -> str:
    """An outcome in words."""
    _, state, reward, terminated = seen
    # The shortest number that is the same in single precision.
    return f"state {state} with reward {np.float32(reward)}{', terminated' if terminated else ''}"


def _error_text(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


# A test of frequencies at a fixed number of draws is invalid where outcomes decide what is drawn
# next, as the states of episodes do. A test by likelihood ratio is valid: under the right
# probabilities, the likelihood ratio of any mixture of others to them is a martingale with mean
# one, and ever exceeds 1/alpha with probability alpha at most (Ville, Étude critique de la notion
# de collectif, 1939; Robbins, Annals of Mathematical Statistics 41, 1970). It is exact for any
# number of draws.

# The probability that a correct model is rejected, over all tests.
FALSE_ALARMS = 1e-6
N_FAMILIES = 3


def odd_frequency(trial: Trial) -> str | None:
    """What an environment did too often or too seldom, in one line."""
    initial, prob = trial.model.initial, trial.classes.prob
    possible = np.flatnonzero(initial)
    starts = np.searchsorted(possible, trial.starts)
    odd = _oddest(0 * starts, starts, initial[possible][None], len(possible))
    if odd is not None:
        says = f"initial_state_distrib says state {possible[odd.outcome]}"
        return f"{says} {odd.shares.format('reset')}"
    rows, places = trial.steps
    odd, where = _oddest(rows, places, prob, len(trial.classes.row)), ""
    if odd is None:
        rounded = (prob / TOLERANCE).round()
        _, first, pattern = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
        patterns, alike = pattern.reshape(-1)[rows], prob[first]
        odd = _oddest(patterns, places, alike, int(np.count_nonzero(alike)))
        if odd is None:
            return None
        odd = odd._replace(group=int(rows[np.argmax(patterns == odd.group)]))
        where = ", counted over all that P gives these probabilities"
    first_of_row = int(np.searchsorted(trial.classes.row, odd.group))
    outcome = list(trial.classes.ids)[first_of_row + odd.outcome]
    says = f"{trial.row_text(odd.group)}: P says {outcome_text(outcome)}"
    return f"{says} {odd.shares.format('step')}{where}"


class Odd(NamedTuple):
    """The oddest count: of which outcome in which group, and the shares in words."""

    group: int
    outcome: int
    shares: str


def _oddest(groups: Ints, outcomes: Ints, probabilities: Floats, n_tests: int) -> Odd | None:
    """The count with the most evidence against its probability, if that is significant.

    ``n_tests`` counts all groups and outcomes that may be drawn, whether they were or not.
    """
    groups, counts, evidence = frequencies(groups, outcomes, probabilities)
    group, outcome = np.unravel_index(np.argmax(evidence), evidence.shape)
    if evidence[group, outcome] < math.log(N_FAMILIES * n_tests / FALSE_ALARMS):
        return None
    trials, said = counts[group].sum(), probabilities[groups[group], outcome]
    share = counts[group, outcome] / trials
    return Odd(
        int(groups[group]),
        int(outcome),
        f"in {said:.1%} of cases, {{}} gave it in {share:.1%} of {trials:,}",
    )


def frequencies(groups: Ints, outcomes: Ints, probabilities: Floats) -> tuple[Ints, Ints, Floats]:
    """The groups with draws, the counts of their outcomes, and the evidence of each count.

    ``groups`` and ``outcomes``, of shape (n,), are those of each draw, ``probabilities``, of shape
    (H, K), those of the outcomes in each group. Shapes returned: (G,), (G, K), (G, K).
    """
    n_outcomes = probabilities.shape[1]
    found, index = np.unique(groups, return_inverse=True)
    cells = index * n_outcomes + outcomes
    counts = np.bincount(cells, minlength=len(found) * n_outcomes).reshape(-1, n_outcomes)
    return found, counts, log_evidence(counts, counts.sum(1, keepdims=True), probabilities[found])


def log_evidence(counts: Ints, trials: Ints, prob: Floats) -> Floats:
    """The log-likelihood ratio of counts: an unknown probability against ``prob``.

    The unknown probability is drawn from Beta(1/2, 1/2); Krichevsky and Trofimov, IEEE Transactions
    on Information Theory 27, 1981. Minus infinity where ``prob`` is 0 or 1: these are refuted by a
    single draw, or not at all.
    """
    from scipy.special import betaln

    open_ = (prob > 0) & (prob < 1)
    inside = np.where(open_, prob, 0.5)
    mixture = betaln(counts + 0.5, trials - counts + 0.5) - betaln(0.5, 0.5)
    doubted = counts * np.log(inside) + (trials - counts) * np.log1p(-inside)
    return np.where(open_, mixture - doubted, -np.inf)
