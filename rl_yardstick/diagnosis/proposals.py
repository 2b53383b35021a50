"""Proposes changes of a run's settings that may close its gap to the optimum, the likeliest first.

Planning gives the share of the gap that another discount or unchanged rewards close. The rest has
causes in learning. There, a change has a weight, a rule of thumb from exact quantities: how often
the actions on the best path were updated, and would be with other exploration; how much their
initial values still count; and how far a setting is from the shipped one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import bdtr

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.planning import PlanningAgent, RandomAgent
from rl_yardstick.agents.policies import is_network
from rl_yardstick.envs.known_models import time_limit
from rl_yardstick.mdp import (
    TransitionModel,
    policy_iteration,
    policy_return,
    state_values,
    state_visitation,
)
from rl_yardstick.mdp.transition_model import Floats, Ints
from rl_yardstick.pipeline.components import constructor_parameters
from rl_yardstick.pipeline.environments import make_single_env, training_changes
from rl_yardstick.pipeline.settings import literal, shipped_hyperparams
from rl_yardstick.pipeline.spec import TrainSpec

if TYPE_CHECKING:
    from rl_yardstick.diagnosis.explanation import Found, Part, Task

STEPS, EPISODES = "n_timesteps", "n_episodes"
VARIANT = ("train_env_kwargs", "train_env_wrapper")
FIRST, LAST, FRACTION, DECAY = EXPLORATION = (
    *("exploration_initial_eps", "exploration_final_eps"),
    *("exploration_fraction", "exploration_decay"),
)
# Settings with a rule of their own, and settings that are no cause.
_WITH_RULE = {*EXPLORATION, "gamma", "learning_rate", "initial_q", "policy_kwargs"}
_NO_CAUSE = {"policy", "engine", "mask_actions", "seed", "device", "verbose"}
# More of these than shipped does no harm.
_HARMLESS_ABOVE = {"buffer_size", "batch_size", "n_epochs", "planning_steps"}
FACTOR = 4  # for more steps, another step size, a larger network
ENOUGH = 10  # updates of an action
LEARNING = ("never tried", "not settled", "look-ahead", "learning")  # parts with causes in learning
MOMENTS = np.array([0.1, 0.3, 0.5, 0.7, 0.9])  # of the training, at which schedules are compared
# Relative to the spread of action values: what counts as equal where estimates have errors, or not.
BLUR, TIE = 0.02, 1e-9
# The agent's value of the start, as a share of the value of standing still, if it stands still.
STANDS_STILL = (0.8, 1.2)
MOST_OTHERS = 3  # settings that are proposed only because the shipped ones differ
DIFFERENT = 0.4  # the least distance from the shipped value
MOST_OUTCOMES = 20_000_000  # of all states at all steps, in which to predict updates

# A change, its weight among the causes in learning, and the share of the gap that planning gives.
_Change = tuple[Mapping[str, Any], float, float]


def proposals(spec: TrainSpec, found: Found, parts: tuple[Part, ...]) -> tuple[str, ...]:
    """Changes as ``--test`` takes them, the likeliest first; none for planners."""
    if isinstance(found.agent, PlanningAgent | RandomAgent):
        return ()
    case = _Case(spec, found, parts)
    scores: dict[str, float] = {}
    for change, weight, share in case.changes():
        kept = {key: value for key, value in change.items() if value != case.own.get(key)}
        text = " ".join(f"{key}:{_text(value)}" for key, value in kept.items())
        score = min(max(share, 0.0), 1.0) + case.rest * weight / (1 + weight)
        if kept:
            scores[text] = max(score, scores.get(text, 0.0))
    return tuple(sorted(scores, key=lambda one: -scores[one]))


class _Case:
    """A run, and the evidence for each change."""

    def __init__(self, spec: TrainSpec, found: Found, parts: tuple[Part, ...]) -> None:
        self.spec, self.found, self.gap = spec, found, found.split.gap
        self.lost = {part.name: part.loss / self.gap for part in parts}
        rest = sum(self.lost.get(name, 0.0) for name in LEARNING)
        self.rest = min(max(rest, 0.0), 1.0) if parts else 1.0
        parameters = constructor_parameters(load_algorithm(spec.algo)).values()
        known = {one.name: one.default for one in parameters if one.default is not one.empty}
        self.known = {*known} - _NO_CAUSE
        self.own = {**known, **spec.hyperparams}
        self.usual = {**known, **shipped_hyperparams(spec)}
        self.is_network = is_network(found.agent)
        self.model = found.model if found.task is None else found.task.model
        random = (self.model.prob > 0).sum(axis=2)[self.model.reachable].max() > 1
        self.has_errors = self.is_network or bool(random) or self.model.reward_variance is not None
        self.rates, self.epsilons = _course(self.own.get("learning_rate")), self._epsilons({})
        with closing(make_single_env(spec, training=True)) as env:
            self.limit = time_limit(env) or found.horizon
        # the best actions for the agent's own objective, and the share of each state in their
        # steps, shape (S,); 0 where they are unknown
        is_known = found.own_values is not None and found.groups is None
        values = found.split.action_values if found.own_values is None else found.own_values
        self.best: Ints = values.argmax(axis=1)
        visits = state_visitation(found.model, self.best, found.horizon)
        self.path: Floats = visits / visits.sum() * is_known
        is_short = is_known and self.limit < found.horizon
        self.out_of_reach = self._chance_out_of_reach() if is_short else 0.0
        # how often the best action of each state was updated, or may have been
        expected, counts = self._expected(self.epsilons), found.updates
        states = np.arange(len(self.best))
        self.updates: Floats = expected if counts is None else counts[states, self.best] * 1.0
        # the share of this path whose actions would lack updates even with more steps
        self.starved = self._lacking(self.updates + (FACTOR - 1) * expected)
        # how much the initial values of tried actions on it still count: an update passes a share
        # of the step size on by one step, so the end is learnt after as many successes as steps
        ones = replace(found.model, reward=np.ones_like(found.model.reward), reward_variance=None)
        steps = state_values(ones, self.best, found.horizon)
        if found.task is not None and found.task.discount < 1:
            steps = np.minimum(steps, 1 / (1 - found.task.discount))
        steps *= (1 - self.own.get("trace_decay", 0.0)) / self.own.get("n_steps", 1)
        steps = np.ones_like(steps) if "monte_carlo" in spec.algo else np.maximum(steps, 1)
        rate = 1.0 if self.rates is None else np.clip(self.rates, 0, 1).mean()
        tried = self.path * (self.updates > 0)
        unlearnt = bdtr(steps - 1, self.updates.astype(np.int64), rate)
        self.unlearnt = float(tried @ np.nan_to_num(unlearnt, nan=1.0) / max(tried.sum(), TIE))

    def changes(self) -> Iterator[_Change]:
        """All changes with their weights and shares."""
        yield from self._budget()
        if self.rates is not None and "learning_rate" in self.known:
            yield from self._step_size(self.rates)
        yield from self._exploration()
        yield from self._objective()
        given = [one.get("policy_kwargs") or {} for one in (self.own, self.usual)]
        given = [literal(one) if isinstance(one, str) else one for one in given]
        own, usual = ({"net_arch": [64, 64], **one} for one in given)
        widths, wide = own["net_arch"], usual["net_arch"]
        is_plain = all(isinstance(one, list) for one in (widths, wide))
        if self.is_network and is_plain and all(isinstance(one, int) for one in widths + wide):
            lacks = max(_distance(sum(wide), sum(widths)), 0.0)
            wide = wide if lacks > DIFFERENT else [FACTOR * max(one, 16) for one in widths or [16]]
            told = ",".join(f"{k}={_text(v)}" for k, v in {**own, "net_arch": wide}.items())
            yield {"policy_kwargs": f"dict({told})"}, 0.15 + lacks, 0.0
        others = [(self._away(key), key) for key in (self.known | {*VARIANT}) - _WITH_RULE]
        others = [one for one in others if abs(one[0]) > DIFFERENT and self.usual.get(one[1])]
        others = [one for one in others if one[0] < 0 or one[1] not in _HARMLESS_ABOVE]
        for away, key in sorted(others, key=lambda one: (-abs(one[0]), one[1]))[:MOST_OTHERS]:
            yield {key: self.usual[key]}, 0.5 * abs(away), 0.0

    def _away(self, key: str) -> float:
        """How far a setting lies above (+) or below (-) the shipped one."""
        return _distance(self.own.get(key), self.usual.get(key))

    def _objective(self) -> Iterator[_Change]:
        """Training on the task as it is, a discount nearer to 1, higher initial values."""
        own, found, task = self.own, self.found, self.found.task
        values, before = found.own_values, found.for_discount
        differs = {VARIANT[0]: bool(training_changes(self.spec)), VARIANT[1]: True}
        if changed := [key for key in VARIANT if own.get(key) and differs[key]]:
            odd, share = sum(own[key] != self.usual.get(key) for key in changed), 0.0
            if task is not None and before is not None:
                share = self._gain(found.model, task.discount, before)
            yield dict.fromkeys(changed), odd + 8 * self.out_of_reach, share
        if task is None or values is None:
            return
        nearer = round(1 - 0.5 / found.horizon, 7)
        if "gamma" in self.known and task.discount < nearer:
            weight = 4.0 * (STANDS_STILL[0] <= self._standing_still(task) <= STANDS_STILL[1])
            yield {"gamma": "auto"}, weight, self._gain(task.lived, nearer, values)
        if "initial_q" in self.known:
            best = values.max(axis=1)[task.model.reachable]
            usual, high = self.usual["initial_q"], float(f"{best.max():.3g}")
            high = usual if usual > own["initial_q"] else high
            # Values below all true ones hide every action that was not tried.
            far = (best.min() - own["initial_q"]) / max(np.ptp(best), TIE)
            weight = self.starved + self.lost.get("never tried", 0.0) + min(max(far, 0.0), 4.0)
            if high > own["initial_q"]:
                yield {"initial_q": high}, (1 - self.out_of_reach) * weight, 0.0

    def _standing_still(self, task: Task) -> float:
        """The agent's start value divided by that of standing still; 0 if free or unknown."""
        model, tables = task.model, getattr(self.found.agent.policy, "q_tables", None)
        stays = (model.next_state == np.arange(model.n_states)[:, None, None]) & ~model.terminated
        stays &= (model.prob > 0) & model.reachable[:, None, None]
        observations = self.found.evaluator.observations
        if tables is None or not stays.any() or task.discount >= 1 or observations.ndim != 1:
            return 0.0
        standing = float(model.reward[stays].max()) / (1 - task.discount)
        values = tables.numpy().mean(axis=0)[observations].max(axis=1)
        return float(model.initial @ values) / standing if standing < 0 else 0.0

    def _gain(self, model: TransitionModel, discount: float, before: Floats) -> float:
        """The share of the gap that planning with another model or discount closes."""
        try:
            after = policy_iteration(model, discount).action_values
        except ValueError:  # without a discount, where episodes need not end
            return 0.0
        returns = []
        for values in (after, before):
            near = np.ptp(values.max(axis=1)[model.reachable]) * (BLUR if self.has_errors else TIE)
            equal = (values >= values.max(axis=1, keepdims=True) - near) * 1.0
            policy = equal / equal.sum(axis=1, keepdims=True)
            played = policy_return(self.found.model, policy, self.found.horizon)
            returns.append(played.expected_return)
        return (returns[0] - returns[1]) / self.gap

    def _budget(self) -> Iterator[_Change]:
        """More steps or episodes: four times as many, and at least the shipped ones."""
        key = EPISODES if self.own.get(EPISODES) else STEPS
        steps = max(self.found.agent.num_timesteps, 1)
        now = self.own.get(key) or steps
        usual = self.usual.get(key) or (self.usual.get(STEPS) or 0) * now / steps
        more = int(float(f"{max(FACTOR * now, usual):.2g}"))
        weight = 0.4 + 0.5 * max(np.log(max(usual, 1) / now), 0.0)
        if not self.is_network:
            fed = self._lacking(self.updates) - self._lacking(self.updates * more / now)
            weight += 2 * fed + 3 * self.unlearnt
        yield {key: more}, weight * (1 - 0.7 * self.starved), 0.0

    def _step_size(self, rates: Floats) -> Iterator[_Change]:
        """A larger step size, and, for a network or against noise, a smaller or falling one."""
        key, away = "learning_rate", self._away("learning_rate")
        own, usual = self.own[key], self.usual[key]
        more = max(-away, 0.0)
        larger = (
            usual if more > DIFFERENT else _scaled(own, FACTOR, np.inf if self.is_network else 1)
        )
        base = 0.2 if self.is_network else 2 * self.unlearnt
        if _distance(larger, own) > 0:
            yield {key: larger}, base * (1 + 2 * more) + 0.3 * more, 0.0
        if self.is_network:
            smaller = usual if away > DIFFERENT else _scaled(own, 1 / FACTOR)
            yield {key: smaller}, 0.3 + 0.7 * max(away, 0.0), 0.0
        elif rates[-1] > 0 and (self.has_errors or "exploring" in self.lost):
            ends, falls = _course(usual), f"exp_{rates.max():.2g}_{rates[-1] / 10:.2g}"
            lower = np.log(rates[-1] / ends[-1]) if ends is not None and ends[-1] > 0 else 0.0
            yield {key: usual if lower > DIFFERENT else falls}, 0.1 + max(lower, 0.0), 0.0

    def _exploration(self) -> Iterator[_Change]:
        """More exploration and less, by epsilon, a temperature, noise or a bonus for entropy."""
        own, kind = self.own, self.own.get("exploration")
        is_used = {"ent_coef": True, "temperature": kind == "boltzmann"}
        for key in (key for key in is_used if is_used[key] and key in self.known):
            if isinstance(own[key], int | float):
                away = self._away(key)
                more = self.usual[key] if away < -DIFFERENT else FACTOR * own[key] or 0.02
                yield {key: more}, 3 * self.starved + max(-away, 0.0), 0.0
        if self.epsilons is None:
            return
        raised, ends = {FIRST: 1.0, FRACTION: 1.0}, {DECAY: "linear", LAST: 0.0}
        if own.get(DECAY) == "constant":
            raised = {FIRST: min(max(round(3 * own[FIRST], 3), 0.3), 1.0)}
        elif all(own[key] == value for key, value in raised.items()):
            raised = {LAST: min(max(round(3 * own[LAST], 3), 0.3), 1.0)}
        ends = {key: value for key, value in ends.items() if key in self.known}
        usual = {key: self.usual[key] for key in EXPLORATION if key in self.known}
        for change in (raised, ends, usual):
            then = self._epsilons(change)
            if then is None or np.allclose(then, self.epsilons):
                continue
            away = abs(_distance(then.mean() + 0.01, self.epsilons.mean() + 0.01))
            fed = max(self._lacking(self.updates) - self._lacking(self._expected(then)), 0.0)
            weight = (1 - self.out_of_reach) * 3 * fed + (away if change is usual else 0.0)
            share = self.lost.get("exploring", 0.0) if then[-1] < self.epsilons[-1] else 0.0
            yield change, weight, share

    def _epsilons(self, change: Mapping[str, Any]) -> Floats | None:
        """Epsilon at some moments of the training; None for agents without it."""
        settings = {**self.own, **change}
        is_used = settings.get("exploration", "epsilon_greedy") == "epsilon_greedy"
        if FIRST not in self.known or not is_used:
            return None
        first, last, share = (float(settings[key]) for key in EXPLORATION[:3])
        decay, passed = settings.get(DECAY), np.minimum(MOMENTS / max(share, TIE), 1)
        if decay == "exponential":
            return np.asarray(first * (last / first) ** passed)
        return np.asarray(first + (decay != "constant") * passed * (last - first))

    # --- what was tried ---------------------------------------------------------------------------

    def _chance_out_of_reach(self) -> float:
        """The share of best episodes that meet states beyond the time limit of training."""
        model = self.model
        here, goes = model.initial > 0, (model.prob > 0) & ~model.terminated
        for _ in range(min(self.limit, model.n_states) - 1):
            here[model.next_state[here][goes[here]]] = True
        meets = ~here[model.next_state] & goes
        ends = replace(model, terminated=model.terminated | meets, reward=meets.astype(np.float64))
        ends = replace(ends, reward_variance=None)
        return policy_return(ends, self.best, self.found.horizon).expected_return

    def _expected(self, epsilons: Floats | None) -> Floats:
        """Expected updates of the best actions with exploration around the present policy, (S,)."""
        n_actions, greedy = self.model.n_actions, np.eye(self.model.n_actions)[self.found.taken]
        policies = [greedy]
        if self.model.prob.size * self.limit > MOST_OUTCOMES:  # these many take seconds
            return np.full(len(greedy), float(self.found.agent.num_timesteps))
        if epsilons is not None:
            policies = [(1 - epsilon) * greedy + epsilon / n_actions for epsilon in epsilons]
        else:
            with suppress(TypeError, ValueError):  # an agent's probabilities may not be known
                policies = [self.found.evaluator.policy(self.found.agent, deterministic=False)]
        total = np.zeros(len(greedy))
        for policy in policies:
            visits = state_visitation(self.model, policy, self.limit)
            total += visits / visits.sum() * policy[np.arange(len(greedy)), self.best]
        return np.asarray(total * self.found.agent.num_timesteps / len(policies))

    def _lacking(self, updates: Floats) -> float:
        """The share of the best path whose actions lack updates."""
        return float(self.path @ (1 - np.minimum(updates / ENOUGH, 1)))


def _course(value: Any) -> Floats | None:
    """A number or a schedule at some moments of the training; None for other values."""
    if isinstance(value, str) and value[:4] in ("lin_", "exp_"):
        first, last = [*map(float, value[4:].split("_")), 0.0][:2]
        is_linear = value.startswith("lin_")
        share = MOMENTS * (last - first) if is_linear else (last / first) ** MOMENTS
        return np.asarray(first + share if is_linear else first * share)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return np.full(len(MOMENTS), float(value)) if is_number else None


def _distance(own: Any, usual: Any) -> float:
    """The logarithm of the factor between two numbers; 1 between other values that differ."""
    one, other = _course(own), _course(usual)
    if one is None or other is None:
        return 0.0 if own == usual else 1.0
    a, b = float(one.mean()), float(other.mean())
    if min(a, b) < 0 or a == b:
        return float(np.sign(a - b))
    least = max(a, b) * 1e-3  # for zeros
    return float(np.log(max(a, least) / max(b, least)))


def _scaled(value: Any, factor: float, most: float = np.inf) -> Any:
    """A number or a schedule times a factor."""
    if not isinstance(value, str):
        return float(f"{min(factor * value, most):.3g}")
    kind, *ends = value.split("_")
    return "_".join([kind, *(f"{min(factor * float(end), most):.3g}" for end in ends)])


def _text(value: Any) -> str:
    """A value as ``--test`` takes it, without spaces."""
    is_short = isinstance(value, float) and float(f"{value:g}") == value
    return "null" if value is None else f"{value:g}" if is_short else str(value).replace(" ", "")
