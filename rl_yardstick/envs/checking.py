"""What environments claim about their dynamics, and a check of claims against `step` and `reset`.

Gymnasium's FrozenLake, CliffWalking, Taxi and Blackjack and this project's own classes are trusted:
tests confirm that they follow their models. All other models, those of subclasses too, are claims.
"""

from __future__ import annotations

import copy
import math
import operator
import random
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.toy_text.blackjack import BlackjackEnv
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.envs.toy_text.taxi import TaxiEnv
from gymnasium.utils import seeding
from numpy.typing import NDArray

from rl_yardstick.envs.bandits.clicks import ClickBandit
from rl_yardstick.envs.blackjack_model import blackjack_model, blackjack_observations
from rl_yardstick.envs.finite_env import FiniteEnv, first_above
from rl_yardstick.envs.grid import GridWorld
from rl_yardstick.mdp.transition_model import TransitionModel

Env = gym.Env[Any, Any]

TRUSTED_CLASSES = (FrozenLakeEnv, CliffWalkingEnv, TaxiEnv, BlackjackEnv)
OWN_CLASSES = (ClickBandit, FiniteEnv)
N_STEPS = 60_000
EPISODE_LIMIT = 1000  # where the environment has no limit of its own
# The share of steps in random episodes, before states are set; and starts for each step.
EPISODE_SHARE, STARTS_PER_STEP = 0.4, 0.02
N_ATTEMPTS = 500  # at setting the state
FALSE_ALARMS = 1e-6  # the probability that a correct model is rejected
TOLERANCE = 1e-9  # probabilities within this of one are one
SEED = 0
START = -1  # the row of `reset`; that of an action is ``state * n_actions + action``
Observed = tuple[int, int, float, bool]  # row, next state, reward in single precision, termination


@dataclass(frozen=True, eq=False)
class Claim:
    """An environment's claim about its dynamics, without wrappers, computed on first access."""

    base: Env

    @cached_property
    def model(self) -> TransitionModel:
        """The dynamics."""
        base = self.base
        if isinstance(base, OWN_CLASSES):
            return base.transition_model()
        if isinstance(base, BlackjackEnv):
            return blackjack_model(bool(base.natural), bool(base.sab))
        P = base.get_wrapper_attr("P")  # noqa: N806 (Gymnasium's own name)
        return TransitionModel.from_gymnasium(P, base.get_wrapper_attr("initial_state_distrib"))

    @cached_property
    def observations(self) -> NDArray[Any] | None:
        """The observation of each state, states along the first axis; None if unknown."""
        if isinstance(self.base, FiniteEnv):
            return np.asarray(self.base.observation_of(np.arange(self.model.n_states)))
        if isinstance(self.base, BlackjackEnv):
            return blackjack_observations()
        space: Any = self.base.observation_space
        return np.arange(space.n) + space.start if isinstance(space, gym.spaces.Discrete) else None


def claim_of(base: Env) -> Claim | None:
    """The claim of an environment without wrappers about its dynamics, None without a model.

    Raises:
        ValueError: where the model is invalid, in one line.
    """
    if isinstance(base, OWN_CLASSES):
        brings_model = not isinstance(base, GridWorld) or base.is_stationary
    elif isinstance(base, BlackjackEnv):
        brings_model = is_trusted(base)  # a subclass could not even be checked
    else:
        has_model = isinstance(getattr(base, "P", None), Mapping)
        if has_model and not hasattr(base, "initial_state_distrib"):
            missing = "initial_state_distrib, the probabilities of the starting states, shape (S,)"
            raise ValueError(f"the environment has P, but not {missing}")
        # A fickle passenger of Taxi changes his mind outside of P.
        brings_model = has_model and not getattr(base, "fickle_passenger", False)
    if not brings_model:
        return None
    claim = Claim(base)
    if isinstance(base, OWN_CLASSES) and is_trusted(base):
        return claim
    try:
        model, actions, observations = claim.model, base.action_space, claim.observations
        if not isinstance(actions, gym.spaces.Discrete) or actions.n != model.n_actions:
            raise ValueError(f"it has {model.n_actions} actions, where the space is {actions}")
        if observations is not None and len(observations) != model.n_states:
            space = base.observation_space
            raise ValueError(f"it has {model.n_states} states, where the space is {space}")
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"the environment's P is no model: {text}") from error
    return claim


def is_trusted(base: Env) -> bool:
    """Whether an environment's claim about its dynamics needs no check."""
    ours = isinstance(base, OWN_CLASSES) and type(base).__module__.startswith("rl_yardstick.envs.")
    return (ours or type(base) in TRUSTED_CLASSES) and not is_changed(base)


def is_changed(base: Env) -> bool:
    """Whether a method of this very object was replaced by hand."""
    return any(callable(getattr(type(base), name, None)) for name in vars(base))


@dataclass(frozen=True)
class ModelCheck:
    """The result of a check of a model against `step`."""

    refusal: str | None  #: why the model is rejected, in one line; None where it is accepted
    #: whether the environment samples as toy_text does, one uniform number for each start and step,
    #: or has nothing to sample: then the model gives the same episodes with the same generator
    bit_for_bit: bool = False
    state_can_be_set: bool = False  #: whether setting the attribute ``s`` sets the state


_checks: dict[tuple[Any, ...], ModelCheck] = {}


def check_transition_model(env: Env, n_steps: int = N_STEPS) -> ModelCheck:
    """Compare an environment's own model with its `step` and `reset`.

    A copy without wrappers plays random episodes, up to their time limit or 1000 steps. Then, if
    trials show that its attribute ``s`` sets the state, it takes every action in every state that
    the model can reach; otherwise it plays on. A correct model is rejected with a probability of at
    most one in a million. Not found are frequencies that depend on time or history but are right on
    average, and events too rare.

    Args:
        env: an environment that has ``P`` and ``initial_state_distrib``, wrapped or not.
        n_steps: steps to take; more where there are more states and actions.

    Raises:
        ValueError: if the environment has no model.
    """
    try:
        claim = claim_of(env.unwrapped)
    except ValueError as error:
        return ModelCheck(str(error))
    if claim is None:
        raise ValueError(f"{env.unwrapped} brings no model to check: no P, initial_state_distrib")
    return _check(claim, n_steps)


def checked(claim: Claim) -> ModelCheck:
    """As `check_transition_model`, once for environments of the same class, arguments and model."""
    base, model = claim.base, claim.model
    arguments = base if base.spec is None else (repr(base.spec.kwargs), base.spec.max_episode_steps)
    parts = model.prob, model.next_state, model.reward, model.terminated, model.initial
    key = type(base), arguments, model.prob.shape, *(hash(part.tobytes()) for part in parts)
    if key not in _checks:
        _checks[key] = _check(claim, N_STEPS)
    return _checks[key]


def _check(claim: Claim, n_steps: int) -> ModelCheck:
    if is_changed(claim.base):  # a method of the copy may act on the original
        return ModelCheck("a method was replaced by hand: P cannot be compared with it on a copy")
    # Some environments draw from the global generators, which must not show this.
    kept = random.getstate(), np.random.get_state()  # noqa: NPY002
    random.seed(SEED)
    np.random.seed(SEED)  # noqa: NPY002
    try:
        trial = Trial(_copy_of(claim.base), claim)
        can_be_set = trial.run(n_steps)
        trial.test_frequencies()
        return ModelCheck(None, trial.bit_for_bit, can_be_set)
    except DisagreementError as error:
        text = f"is not what step does: {error}"
    except Exception as error:  # noqa: BLE001  # the environment may raise any
        text = f"cannot be held against step, which raised {type(error).__name__}: {error}"
    finally:
        random.setstate(kept[0])
        np.random.set_state(kept[1])  # noqa: NPY002
    return ModelCheck(f"the environment's P {' '.join(text.split())}")


def _copy_of(base: Env) -> Any:
    """A deep copy without rendering; where that fails, an environment of the same spec."""
    try:
        twin = copy.deepcopy(base)
    except Exception:
        if base.spec is None:
            raise
        twin = gym.make(base.spec).unwrapped
    vars(twin)["render_mode"] = None
    return twin


class DisagreementError(Exception):
    """An environment did what its model rules out."""


class Trial:
    """Plays a copy of an environment, and compares each step with its claimed model."""

    def __init__(self, env: Any, claim: Claim) -> None:
        self.env, self.model, self.n_actions = env, claim.model, claim.model.n_actions
        self.limit = (env.spec and env.spec.max_episode_steps) or EPISODE_LIMIT
        self.observations = known = claim.observations
        states = np.arange(self.model.n_states)
        self.observes_states = known is not None and np.array_equal(known, states)
        self.prob_of = _outcomes(self.model)
        self.counts: Counter[Observed] = Counter()
        self.n_of_row: Counter[int] = Counter()
        self.state, self.time, self.over, self.bit_for_bit = 0, 0, True, True
        self._rng = np.random.default_rng(SEED)
        self._uniforms = seeding.np_random(SEED)[0]  # those that toy_text would draw

    def run(self, n_steps: int) -> bool:
        """Play random episodes, then visit all states and actions; whether ``s`` can be set."""
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
                self._count(self._step(*divmod(row, self.n_actions)))
        return True

    def test_frequencies(self) -> None:
        """Test the frequency of each outcome.

        Outcomes decide what is drawn next, so the test is by likelihood ratio: under the right
        probabilities, the ratio of a mixture of others to them is a martingale with mean one, and
        ever exceeds 1/alpha with probability alpha at most (Ville, Étude critique de la notion de
        collectif, 1939). The mixture is Beta(1/2, 1/2) (Krichevsky and Trofimov, IEEE Transactions
        on Information Theory 27, 1981). A single draw refutes outcomes that are sure.
        """
        from scipy.special import betaln

        tested = [seen for seen, p in self.prob_of.items() if p < 1 and self.n_of_row[seen[0]]]
        trials = np.array([self.n_of_row[seen[0]] for seen in tested])
        counts = np.array([self.counts[seen] for seen in tested])
        prob = np.array([self.prob_of[seen] for seen in tested])
        mixture = betaln(counts + 0.5, trials - counts + 0.5) - betaln(0.5, 0.5)
        evidence = mixture - (counts * np.log(prob) + (trials - counts) * np.log1p(-prob))
        if evidence.max(initial=0.0) >= math.log(len(self.prob_of) / FALSE_ALARMS):
            at = int(evidence.argmax())
            came = f"it came in {counts[at] / trials[at]:.1%} of {trials[at]:,}"
            self._refuse(tested[at], f" in {prob[at]:.1%} of cases, {came}")

    def _play(self, n_steps: int) -> None:
        for action in self._rng.integers(self.n_actions, size=n_steps).tolist():
            self._count(self._step(None, action))

    def _obeys(self) -> bool:
        """Whether setting ``s`` sets the whole state, so that the environment goes on from there.

        Only states and actions that episodes have seen are tried, in which the environment did what
        the model says. If it does not now, ``s`` is not the whole state.
        """
        rows = np.array([row for row in self.n_of_row if row != START])
        was_set = self.model.n_states == 1
        for row in self._rng.choice(rows, N_ATTEMPTS).tolist():
            if self.over or self.time >= self.limit:
                self._reset()
            stayed = self.state * self.n_actions + row % self.n_actions
            try:
                seen = self._step(*divmod(row, self.n_actions))
            except Exception:  # noqa: BLE001  # the environment may refuse the state in any way
                return False
            if seen not in self.prob_of:
                return False
            was_set |= (stayed, *seen[1:]) not in self.prob_of
        return was_set

    def _reset(self) -> None:
        # Seeded once, as trainings are: the rest follows from it.
        obs, _ = self.env.reset(seed=None if self.n_of_row[START] else SEED)
        self.state, self.time, self.over = self._state_of(obs), 0, False
        predicted = first_above(self.model.initial.cumsum(), self._uniforms.random())
        self.bit_for_bit &= predicted == self.state
        self._count((START, self.state, 0.0, False))

    def _step(self, state: int | None, action: int) -> Observed:
        """The outcome of an action, in a state that is set before unless it is None."""
        if self.over or self.time >= self.limit:
            self._reset()
        if state is not None:
            self.env.s = self.state = state
        model, at = self.model, (self.state, action)
        obs, reward, terminated, truncated, _ = self.env.step(action)
        if truncated:
            text = "step gave truncated, which no model holds: leave time limits to"
            raise DisagreementError(f"{text} max_episode_steps")
        self.state, self.over = self._state_of(obs), bool(terminated)
        self.time += 1
        k = first_above(model.prob[at].cumsum(), self._uniforms.random())
        predicted = model.next_state[at][k], model.reward[at][k], model.terminated[at][k]
        self.bit_for_bit &= predicted == (self.state, float(reward), self.over)
        row = at[0] * self.n_actions + action
        return row, self.state, float(np.float32(reward)), self.over

    def _state_of(self, obs: Any) -> int:
        """The state, from the observation or ``s``."""
        what = "observation" if self.observes_states else "attribute s"
        found: Any = obs if self.observes_states else getattr(self.env, "s", None)
        state = operator.index(found) if hasattr(found, "__index__") else -1
        if not 0 <= state < self.model.n_states:
            raise DisagreementError(f"the {what} is {found!r}, not the number of a state in P")
        if self.observations is None or np.array_equal(self.observations[state], obs):
            return state
        right = self.observations[state]
        raise DisagreementError(f"state {state} was observed as {obs}, not {right}")

    def _count(self, seen: Observed) -> None:
        if seen not in self.prob_of:
            said = next(key for key in self.prob_of if key[0] == seen[0])
            self._refuse(said, f", it gave {_text(seen)}")
        self.counts[seen] += 1
        self.n_of_row[seen[0]] += 1

    def _refuse(self, said: Observed, found: str) -> None:
        state, action = divmod(said[0], self.n_actions)
        says = f"state {state}, action {action}: P says"
        says = "reset: initial_state_distrib says" if said[0] == START else says
        raise DisagreementError(f"{says} {_text(said)}{found}")


def _outcomes(model: TransitionModel) -> dict[Observed, float]:
    """The probability of each start and of each outcome that can be told from the others."""
    starts = enumerate(model.initial.tolist())
    found: dict[Observed, float] = {(START, s, 0.0, False): p for s, p in starts if p > 0}
    states, actions, _ = at = np.nonzero(model.prob)
    rows, reward = states * model.n_actions + actions, model.reward[at].astype(np.float32)
    columns = rows, model.next_state[at], reward, model.terminated[at], model.prob[at]
    for *seen, prob in zip(*(column.tolist() for column in columns), strict=True):
        key: Any = tuple(seen)
        found[key] = found.get(key, 0.0) + prob
    return {key: 1.0 if prob > 1 - TOLERANCE else prob for key, prob in found.items()}


def _text(seen: Observed) -> str:
    row, state, reward, terminated = seen
    # The shortest number that is the same in single precision.
    paid = "" if row == START else f" with reward {np.float32(reward)}"
    return f"state {state}{paid}{', terminated' if terminated else ''}"
