"""Check an environment's transition model against its `step` and `reset`."""

from __future__ import annotations

import copy
import hashlib
import math
import operator
import random
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding

from rl_yardstick.envs.finite_env import first_above
from rl_yardstick.envs.model_claims import Claim, claim_of, is_changed, one_line
from rl_yardstick.mdp.transition_model import Floats, Ints, TransitionModel

Env = gym.Env[Any, Any]

N_STEPS = 60_000
# Where the environment has no limit of its own.
EPISODE_LIMIT = 1000

DIFFERENT = "the environment's P is not what step does: "
SEED = 0


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


def check_transition_model(env: Env, n_steps: int = N_STEPS) -> ModelCheck:
    """Compare an environment's own model with its `step` and `reset`.

    A copy of the environment, without its wrappers, plays random episodes, up to their time limit
    or 1000 steps. Then, if trials show that its attribute ``s`` sets the state, it takes every
    action in every state that the model can reach; otherwise it plays further episodes.

    - An event of probability zero in the model (a next state, a reward that differs in single
      precision, a termination or none, a start, an observation that is not the state's number, a
      truncation) is found as soon as it happens once.
    - The frequencies of starts, and of the outcomes of each state and action, are tested against
      the model's probabilities. A correct model is rejected with a probability of at most one in a
      million, if ``s``, where it can be set, is the whole state.

    The Markov property is not tested: where frequencies depend on time or history, but agree with
    the model on average, the model is accepted. Nor does the check find events too rare to happen,
    states that neither episodes nor setting ``s`` lead to, and changes after the check.

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
    """As `check_transition_model`, once for environments of the same class, arguments and model."""
    arguments = base if base.spec is None else repr(base.spec.kwargs)
    key = type(base), _limit(base), arguments, _digest(claim.model)
    if key not in _checks:
        _checks[key] = _check(base, claim, N_STEPS)
    return _checks[key]


def _check(base: Env, claim: Claim, n_steps: int) -> ModelCheck:
    try:
        with _global_generators_apart():
            trial = Trial(_copy_of(base), claim, _limit(base))
            can_be_set = trial.run(n_steps)
        refusal = trial.odd_frequency()
    except DisagreementError as error:
        return ModelCheck(DIFFERENT + one_line(error))
    except Exception as error:  # noqa: BLE001  # the environment may raise any
        text = f"{type(error).__name__}: {one_line(error)}"
        return ModelCheck(f"the environment's P cannot be held against step, which raised {text}")
    if refusal is not None:
        return ModelCheck(DIFFERENT + refusal, n_steps=trial.n_steps)
    return ModelCheck(None, trial.bit_for_bit, can_be_set, trial.n_steps)


def _limit(base: Env) -> int:
    limit = None if base.spec is None else base.spec.max_episode_steps
    return limit or EPISODE_LIMIT


def _digest(model: TransitionModel) -> bytes:
    found = hashlib.blake2b(repr(model.prob.shape).encode())
    for part in (model.prob, model.next_state, model.reward, model.terminated, model.initial):
        found.update(part.tobytes())
    return found.digest()


def _copy_of(base: Env) -> Env:
    """A deep copy without rendering; where that fails, an environment of the same spec."""
    if is_changed(base):  # a method of the copy may act on the original
        raise DisagreementError("a method was replaced by hand, and cannot be tried on a copy")
    try:
        twin = copy.deepcopy(base)
    except Exception:
        if base.spec is None:
            raise
        twin = gym.make(base.spec).unwrapped
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


class DisagreementError(Exception):
    """An environment did what its model rules out."""


# What was observed: the row (``state * A + action``, or START), the next state, the reward in
# single precision, and whether the episode terminated.
Observed = tuple[int, int, float, bool]
START = -1

# Share of the budget for the first episodes, before the state is set; and starts for each step.
EPISODE_SHARE, STARTS_PER_STEP = 0.4, 0.02
N_ATTEMPTS = 500  # at setting the state
# The probability that a correct model is rejected.
FALSE_ALARMS = 1e-6
# Probabilities within this of one are one.
TOLERANCE = 1e-9


class Trial:
    """Plays a copy of an environment, and compares each step with its claimed model."""

    def __init__(self, env: Env, claim: Claim, limit: int) -> None:
        self.env: Any = env
        self.claim, self.model, self.limit = claim, claim.model, limit
        self.n_actions = self.model.n_actions
        self.prob_of = _outcomes(self.model)
        self.counts: Counter[Observed] = Counter()
        self.n_of_row: Counter[int] = Counter()
        self.state, self.time, self.over = 0, 0, True
        self.bit_for_bit = True
        self._cumulative = np.cumsum(self.model.prob, axis=2)
        self._starts = np.cumsum(self.model.initial)
        self._rng = np.random.default_rng(SEED)
        self._uniforms = seeding.np_random(SEED)[0]  # those that toy_text would draw

    def run(self, n_steps: int) -> bool:
        """Play random episodes, then visit all states and actions.

        Returns whether the state can be set; raises DisagreementError as soon as something happens
        that the model rules out.
        """
        n_random = int(EPISODE_SHARE * n_steps)
        self._play(n_random)
        for _ in range(int(STARTS_PER_STEP * n_steps)):
            self._reset()
        alike = self.bit_for_bit
        if not self._obeys():
            self.bit_for_bit, self.over = alike, True
            self._play(n_steps - n_random)
            return False
        states = np.flatnonzero(self.model.reachable)
        rows = (states[:, None] * self.n_actions + np.arange(self.n_actions)).ravel()
        for _ in range(max((n_steps - n_random) // len(rows), 1)):
            for row in self._rng.permutation(rows).tolist():
                if self._put(row // self.n_actions):
                    self._count(self._act(row % self.n_actions))
        return True

    def odd_frequency(self) -> str | None:
        """The outcome with the most evidence against its probability, if that is significant.

        A test by likelihood ratio is valid although outcomes decide what is drawn next: under the
        right probabilities, the ratio of any mixture of others to them is a martingale with mean
        one, and ever exceeds 1/alpha with probability alpha at most (Ville, Étude critique de la
        notion de collectif, 1939; Robbins, Annals of Mathematical Statistics 41, 1970).
        """
        possible = [seen for seen in self.prob_of if self.n_of_row[seen[0]]]
        trials = np.array([self.n_of_row[seen[0]] for seen in possible])
        counts = np.array([self.counts[seen] for seen in possible])
        prob = np.array([self.prob_of[seen] for seen in possible])
        evidence = log_evidence(counts, trials, prob)
        place = int(evidence.argmax())
        if evidence[place] < math.log(len(self.prob_of) / FALSE_ALARMS):
            return None
        share = counts[place] / trials[place]
        says = f"{self._said(possible[place])} in {prob[place]:.1%} of cases"
        return f"{says}, it came in {share:.1%} of {trials[place]:,}"

    def _play(self, n_steps: int) -> None:
        for action in self._rng.integers(self.n_actions, size=n_steps).tolist():
            if self.over or self.time >= self.limit:
                self._reset()
            self._count(self._act(action))

    def _obeys(self) -> bool:
        """Whether setting ``s`` sets the whole state, so that the environment goes on from there.

        Only states and actions that episodes have seen are tried, in which the environment did what
        the model says. If it does not now, ``s`` is not the whole state.
        """
        rows = np.array([row for row in self.n_of_row if row != START])
        was_set = self.model.n_states == 1
        for row in self._rng.choice(rows, N_ATTEMPTS).tolist():
            before = self.state
            try:
                if not self._put(row // self.n_actions):
                    return False
                _, *outcome = self._act(row % self.n_actions)
            except Exception:  # noqa: BLE001  # the environment may raise any in such a state
                return False
            if (row, *outcome) not in self.prob_of:
                return False
            stayed = before * self.n_actions + row % self.n_actions
            was_set |= (stayed, *outcome) not in self.prob_of
        return was_set

    def _reset(self) -> None:
        # Seeded once, as trainings are: the rest follows from it.
        obs, _ = self.env.reset(seed=None if self.n_of_row[START] else SEED)
        self.state = self._state_of(obs, START)
        self.time, self.over = 0, False
        predicted = first_above(self._starts, self._uniforms.random())
        self.bit_for_bit &= predicted == self.state
        self._count((START, self.state, 0.0, False))

    def _count(self, seen: Observed) -> None:
        if seen not in self.prob_of:
            said = next(key for key in self.prob_of if key[0] == seen[0])
            raise DisagreementError(f"{self._said(said)}, it gave {_outcome_text(seen)}")
        self.counts[seen] += 1
        self.n_of_row[seen[0]] += 1

    @property
    def n_steps(self) -> int:
        """The steps that were compared."""
        return self.n_of_row.total() - self.n_of_row[START]

    def _act(self, action: int) -> Observed:
        """The outcome of an action."""
        state, row = self.state, self.state * self.n_actions + action
        obs, reward, terminated, truncated, _ = self.env.step(action)
        reward, self.over = float(reward), bool(terminated)
        self.state = self._state_of(obs, row)
        if truncated:
            text = "step gave truncated, which no model holds: leave time limits to"
            raise DisagreementError(f"{self._where(row)}: {text} max_episode_steps")
        self.time += 1
        drawn = first_above(self._cumulative[state, action], self._uniforms.random())
        at, model = (state, action, drawn), self.model
        predicted = model.next_state[at], model.reward[at], model.terminated[at]
        self.bit_for_bit &= predicted == (self.state, reward, self.over)
        return row, self.state, float(np.float32(reward)), self.over

    def _put(self, state: int) -> bool:
        """Put the environment into a state, if it lets its attribute ``s`` be set."""
        if self.over or self.time >= self.limit:
            self._reset()
        try:
            self.env.s = self.state = state
            return operator.index(self.env.s) == state
        except Exception:  # noqa: BLE001  # a setter may refuse in any way
            return False

    def _state_of(self, obs: Any, row: int) -> int:
        """The state after a row, from the observation or ``s``."""
        by_obs, expected = self.claim.observes_states, self.claim.observations
        found: Any = obs if by_obs else getattr(self.env, "s", None)
        try:
            state = operator.index(found)
        except TypeError:
            state = -1
        if not 0 <= state < self.model.n_states:
            what = "observation" if by_obs else "attribute s"
            text = f"the {what} is {found!r}, not the number of a state in P"
            raise DisagreementError(f"{self._where(row)}: {text}")
        if not (by_obs or expected is None or np.array_equal(expected[state], obs)):
            text = f"state {state} was observed as {obs}, not {expected[state]}"
            raise DisagreementError(f"{self._where(row)}: {text}")
        return state

    def _where(self, row: int) -> str:
        if row == START:
            return "reset"
        return f"state {row // self.n_actions}, action {row % self.n_actions}"

    def _said(self, seen: Observed) -> str:
        source = "initial_state_distrib" if seen[0] == START else "P"
        return f"{self._where(seen[0])}: {source} says {_outcome_text(seen)}"


def _outcomes(model: TransitionModel) -> dict[Observed, float]:
    """The probability of each start and of each outcome that can be told from the others."""
    start = np.flatnonzero(model.initial).tolist()
    found: dict[Observed, float] = {
        (START, state, 0.0, False): float(model.initial[state]) for state in start
    }
    rows, actions, _ = at = np.nonzero(model.prob)
    with np.errstate(over="ignore"):
        reward = model.reward[at].astype(np.float32)
    columns = rows * model.n_actions + actions, model.next_state[at], reward, model.terminated[at]
    seen = zip(*(column.tolist() for column in columns), strict=True)
    for key, chance in zip(seen, model.prob[at].tolist(), strict=True):
        found[key] = found.get(key, 0.0) + chance
    return {key: 1.0 if chance > 1 - TOLERANCE else chance for key, chance in found.items()}


def _outcome_text(seen: Observed) -> str:
    row, state, reward, terminated = seen
    if row == START:
        return f"state {state}"
    # The shortest number that is the same in single precision.
    return f"state {state} with reward {np.float32(reward)}{', terminated' if terminated else ''}"


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
