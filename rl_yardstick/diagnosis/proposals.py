"""Proposes changes of a run's settings that may close its gap to the optimum, the likeliest first.

Planning gives the share of the gap that another discount or unchanged rewards close. The rest has
causes in learning. There, a change has a weight, a rule of thumb from exact quantities: how often
the actions on the best path were updated, and would be with other exploration; how much their
initial values still count; and how far a setting is from the shipped one. Where one setting is far
off, others have little weight, and a change with little weight is not proposed. Where several
settings differ from the shipped ones, the second proposal is all of these at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import bdtr

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.schedules import epsilon_schedule
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
from rl_yardstick.pipeline.components import constructor_parameters, schedule
from rl_yardstick.pipeline.environments import make_single_env, training_changes
from rl_yardstick.pipeline.settings import BUDGETS, entry_names, literal, shipped_hyperparams
from rl_yardstick.pipeline.spec import TrainSpec

if TYPE_CHECKING:
    from rl_yardstick.diagnosis.explanation import Found, Part, Task

STEPS, EPISODES = BUDGETS
VARIANT = ("train_env_kwargs", "train_env_wrapper")
FIRST, LAST = "exploration_initial_eps", "exploration_final_eps"
FRACTION, DECAY = "exploration_fraction", "exploration_decay"
EXPLORATION = (FIRST, LAST, FRACTION, DECAY)
# Settings with a rule of their own, and settings that are no cause.
_WITH_RULE = {*EXPLORATION, "gamma", "learning_rate", "initial_q", "policy_kwargs"}
_NO_CAUSE = {"policy", "engine", "mask_actions", "seed", "device", "verbose"}
# More of these than shipped does no harm.
_HARMLESS_ABOVE = {"buffer_size", "batch_size", "n_epochs", "planning_steps"}
# Settings of the training that are no arguments of the agent.
_AROUND = {*VARIANT, "normalize", "n_envs"}
FACTOR = 4  # for more steps, another step size, a larger network
ENOUGH = 10  # updates of an action
LEARNING = ("never tried", "not settled", "look-ahead", "learning")  # parts with causes in learning
MOMENTS = np.array([0.1, 0.3, 0.5, 0.7, 0.9])  # of the training, at which schedules are compared
# Relative to the spread of action values: what counts as equal where estimates have errors, or not.
BLUR, TIE = 0.02, 1e-9
# The agent's value of the start, as a share of the value of standing still, if it stands still.
STANDS_STILL = (0.8, 1.2)
HARDLY_MORE = 0.5  # the best value of the start, relative to the same, if the goal is hidden
MOST_OTHERS = 3  # settings that are proposed only because the shipped ones differ
DIFFERENT = 0.4  # the least distance from the shipped value
# How much less other changes weigh for each unit of distance: from an environment's own entry,
# and from an agent's default one.
BLAME, BLAME_OF_DEFAULT = 3.0, 0.5
SURELY_ODD = 3.0  # about twenty times the shipped value, or a twentieth
MOST_OF_GAMMA = 2.0  # beyond this distance of a discount, planning tells its effect
RARELY = 0.01  # a mean epsilon with which hardly anything new is tried
LEAST_SCORE, LEAST_RELATIVE = 0.05, 0.25  # of a proposal, and relative to the first one's
MOST_OUTCOMES = 20_000_000  # of all states at all steps, in which to predict updates

# A change, its weight among the causes in learning, and the share of the gap that planning gives.
_Change = tuple[Mapping[str, Any], float, float]


def proposals(spec: TrainSpec, found: Found, parts: tuple[Part, ...]) -> tuple[str, ...]:
    """Changes as ``--test`` takes them, the likeliest first; none for planners."""
    if isinstance(found.agent, PlanningAgent | RandomAgent):
        return ()
    case = _Case(spec, found, parts)
    scores: dict[str, tuple[float, float]] = {}
    worth: dict[str, float] = {}
    for change, weight, share in case.changes():
        kept = {key: value for key, value in change.items() if value != case.own.get(key)}
        if not kept:
            continue
        is_odd = not case.odd.keys().isdisjoint(kept)
        blamed = weight if is_odd else weight / (1 + case.blame)
        score, least = (
            min(max(share, 0.0), 1.0) + case.rest * one / (1 + one) for one in (blamed, weight)
        )
        typed = _typed(kept)
        # about equal scores go by their weights
        scores[typed] = max((round(score, 1), blamed), scores.get(typed, (0.0, 0.0)))
        worth[typed] = max(score if case.is_sure else least, worth.get(typed, 0.0))
    ranked = sorted(scores, key=scores.__getitem__, reverse=True)
    relative = LEAST_RELATIVE * max(worth.values(), default=0.0) if case.is_sure else 0.0
    ranked = [one for one in ranked if worth[one] >= max(LEAST_SCORE, relative)]
    # the second proposal changes other settings than the first
    ranked[1:] = sorted(ranked[1:], key=lambda one: not _topics(one).isdisjoint(_topics(ranked[0])))
    at_once = _typed({key: case.usual.get(key) for key in case.odd})
    if len(_topics(at_once)) > 1:
        ranked.insert(1, at_once)
    return tuple(dict.fromkeys(ranked))


def _topics(typed: str) -> set[str]:
    """The settings of a change; those of epsilon count as one."""
    keys = {one.partition(":")[0] for one in typed.split()}
    return {FIRST if key in EXPLORATION else key for key in keys}


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
        self.odd = self._far_off()
        oddest = max(map(abs, self.odd.values()), default=0.0)
        now, usual = self._budgets()
        self.short = max(float(np.log(max(usual, 1) / now)), 0.0)  # of steps
        self.is_entry = spec.env_id in entry_names(spec.algo)
        self.blame = BLAME if self.is_entry else BLAME_OF_DEFAULT
        self.blame *= max(oddest - self.short, 0.0)
        self.is_network = is_network(found.agent)
        self.model = found.model if found.task is None else found.task.model
        random = (self.model.prob > 0).sum(axis=2)[self.model.reachable].max() > 1
        self.has_errors = self.is_network or bool(random) or self.model.reward_variance is not None
        self.rates, self.epsilons = _course(self.own.get("learning_rate")), self._epsilons({})
        # a network has no counts of updates: only a setting that is very far off is a sure cause
        self.is_sure = not self.is_network or oddest > SURELY_ODD
        with closing(make_single_env(spec, training=True)) as env:
            self.limit = time_limit(env) or found.horizon
        # the best actions for the agent's own objective, and the share of each state in their
        # steps, shape (S,); 0 where they are unknown
        is_known = found.task is not None and found.groups is None
        values = found.split.action_values if found.task is None else found.task.own_values
        self.best: Ints = values.argmax(axis=1)
        visits = state_visitation(found.model, self.best, found.horizon)
        self.path: Floats = visits / visits.sum() * is_known
        # whether it learns from what it happens to do first: no exploration, no optimistic values
        is_greedy = self.epsilons is not None and self.epsilons.mean() < RARELY
        modest = self.own.get("initial_q", 0.0) < values.max(axis=1)[self.model.reachable].max()
        self.is_blind = is_greedy and modest and not self.is_network
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
        for key in [key for key in self.odd if key not in {*_WITH_RULE, *VARIANT}][:MOST_OTHERS]:
            ties = 2 * self.starved if key == "tie_breaking" else 0.0  # hide untried actions
            yield {key: self.usual.get(key)}, 0.5 * abs(self.odd[key]) + ties, 0.0

    def _far_off(self) -> dict[str, float]:
        """The distances of the settings that are far from the shipped ones, the largest first."""
        found = {key: self._away(key) for key in self.known | _AROUND}
        far = [(key, away) for key, away in found.items() if abs(away) > DIFFERENT]
        far = [(key, away) for key, away in far if away < 0 or key not in _HARMLESS_ABOVE]
        return dict(sorted(far, key=lambda one: (-abs(one[1]), one[0])))

    def _away(self, key: str) -> float:
        """How far a setting lies above (+) or below (-) the shipped one."""
        own, usual = self.own.get(key), self.usual.get(key)
        if key == "gamma" and isinstance(own, int | float) and isinstance(usual, int | float):
            # the inverse of the steps that it looks ahead
            return float(np.clip(_distance(1 - usual, 1 - own), -MOST_OF_GAMMA, MOST_OF_GAMMA))
        return _distance(own, usual)

    def _objective(self) -> Iterator[_Change]:
        """Training on the task as it is, another discount, other initial values."""
        own, found, task = self.own, self.found, self.found.task
        changed = [key for key in VARIANT if own.get(key) and training_changes(self.spec)]
        share = 0.0
        if changed and task is not None:
            share = self._gain(found.model, task.discount, task.for_discount)
        if odd := [key for key in VARIANT if key in self.odd]:
            change = {key: self.usual.get(key) for key in odd}
            yield change, len(odd) + 8 * self.out_of_reach, share
        if kept := [key for key in changed if key not in odd]:
            weight = 0.1 * self.is_network + 8 * self.out_of_reach
            yield dict.fromkeys(kept), weight, 0.0 if odd else share
        if task is None:
            return
        nearer = round(1 - 0.5 / found.horizon, 7)
        if self.odd.get("gamma", 0.0) > 0:
            yield {"gamma": self.usual["gamma"]}, 0.15 * self.odd["gamma"], 0.0
        if "gamma" in self.known and task.discount < nearer:
            # An agent that explores too much, or lacks steps, may value the start so as well.
            away = max(-self._away("gamma"), 0.0)
            own_start, best_start = self._standing_still(task)
            stands = STANDS_STILL[0] <= own_start <= STANDS_STILL[1] and best_start > HARDLY_MORE
            stands = stands and ("gamma" in self.odd or not self.is_entry)
            weight = 4.0 * stands + 0.15 * away
            yield {"gamma": "auto"}, weight, self._gain(task.lived, nearer, task.own_values)
        if "initial_q" in self.known:
            best = task.own_values.max(axis=1)[task.model.reachable]
            usual, high = self.usual["initial_q"], float(f"{best.max():.3g}")
            high = usual if usual > own["initial_q"] else high
            # Values below all true ones hide every action that was not tried.
            far = (best.min() - own["initial_q"]) / max(np.ptp(best), TIE)
            weight = (self.starved + self.lost.get("never tried", 0.0)) / (1 + 2 * self.short)
            weight += min(max(far, 0.0), 4.0) * ("initial_q" in self.odd)
            if high > own["initial_q"]:
                yield {"initial_q": high}, (1 - self.out_of_reach) * weight, 0.0
            # Values far above all true ones take many updates to fall.
            above = (own["initial_q"] - best.max()) / max(np.ptp(best), TIE)
            if above > 1 and usual < own["initial_q"]:
                yield {"initial_q": usual}, min(above, 4.0), 0.0

    def _standing_still(self, task: Task) -> tuple[float, float]:
        """Its start value, and the best, divided by that of standing still; 0 if unknown."""
        model, own, policy = task.model, self.found.beliefs, self.found.agent.policy
        own_state = np.arange(model.n_states)[:, None, None]
        stays = model.goes_on & (model.next_state == own_state) & model.reachable[:, None, None]
        if own is None or not hasattr(policy, "q_tables") or not stays.any() or task.discount >= 1:
            return 0.0, 0.0
        standing = float(model.reward[stays].max()) / (1 - task.discount)
        if standing >= 0:
            return 0.0, 0.0
        starts = [float(model.initial @ q.max(axis=1)) for q in (own, task.own_values)]
        return starts[0] / standing, starts[1] / standing

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

    def _budgets(self) -> tuple[float, float]:
        """The run's steps or episodes, and the shipped ones in the same unit."""
        steps = max(self.found.agent.num_timesteps, 1)
        key = EPISODES if self.own.get(EPISODES) else STEPS
        now = self.own.get(key) or steps
        return now, self.usual.get(key) or (self.usual.get(STEPS) or 0) * now / steps

    def _budget(self) -> Iterator[_Change]:
        """More steps or episodes: four times as many, and at least the shipped ones."""
        now, usual = self._budgets()
        more = int(float(f"{max(FACTOR * now, usual):.2g}"))
        weight = 0.4 + 0.5 * self.short
        if not self.is_network:
            fed = self._lacking(self.updates) - self._lacking(self.updates * more / now)
            weight += 2 * fed + 3 * self.unlearnt
        weight *= (1 - 0.7 * self.starved) * (1 - self.out_of_reach) * (not self.is_blind)
        yield {EPISODES if self.own.get(EPISODES) else STEPS: more}, weight, 0.0

    def _step_size(self, rates: Floats) -> Iterator[_Change]:
        """A larger step size, and, for a network or against noise, a smaller or falling one."""
        key, away = "learning_rate", self._away("learning_rate")
        own, usual = self.own[key], self.usual[key]
        more = max(-away, 0.0)
        most = np.inf if self.is_network else 1.0
        larger = usual if more > DIFFERENT else _scaled(own, FACTOR, most)
        # A table that lacks steps or exploration learns no more with larger ones.
        base = 2 * self.unlearnt * (1 - self.starved) * (not self.is_blind) / (1 + 4 * self.short)
        base = 0.2 if self.is_network else base
        if _distance(larger, own) > 0 and away < DIFFERENT:
            yield {key: larger}, base * (1 + 2 * more) + 0.3 * more, 0.0
        if self.is_network and more < DIFFERENT:
            smaller = usual if away > DIFFERENT else _scaled(own, 1 / FACTOR)
            yield {key: smaller}, 0.3 + 0.7 * max(away, 0.0), 0.0
        is_noisy = self.has_errors or self.lost.get("exploring")
        if not self.is_network and rates[-1] > 0 and is_noisy:
            ends, falls = _course(usual), f"exp_{rates.max():.2g}_{rates[-1] / 10:.2g}"
            lower = np.log(rates[-1] / ends[-1]) if ends is not None and ends[-1] > 0 else 0.0
            settled = (1 - self.unlearnt) * (1 - self.starved) * min(10 * rates[-1], 1.0)
            weight = 0.1 + max(lower, 0.0) + settled * (self.has_errors and self.short < DIFFERENT)
            yield {key: usual if lower > DIFFERENT else falls}, weight, 0.0

    def _exploration(self) -> Iterator[_Change]:
        """More exploration and less, by epsilon, a temperature, noise or a bonus for entropy."""
        own, kind = self.own, self.own.get("exploration")
        for key, is_used in (("ent_coef", True), ("temperature", kind == "boltzmann")):
            if is_used and key in self.known and isinstance(own[key], int | float):
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
            lacks = self._lacking(self._expected(then))
            fed = max(self._lacking(self.updates) - lacks, 0.0)
            is_more = then.mean() > self.epsilons.mean()
            away *= (1 - lacks * is_more) * (change is usual)
            weight = (1 - self.out_of_reach) * 3 * fed + away
            weight += 0.5 * (self.is_blind and then.mean() > RARELY)
            share = self.lost.get("exploring", 0.0) if then[-1] < self.epsilons[-1] else 0.0
            yield change, weight, share

    def _epsilons(self, change: Mapping[str, Any]) -> Floats | None:
        """Epsilon at some moments of the training; None for agents without it."""
        settings = {DECAY: "linear", **self.own, **change}
        if (
            FIRST not in self.known
            or settings.get("exploration", "epsilon_greedy") != "epsilon_greedy"
        ):
            return None
        return _at_moments(epsilon_schedule(SimpleNamespace(**settings)))

    # --- what was tried ---------------------------------------------------------------------------

    def _chance_out_of_reach(self) -> float:
        """The share of best episodes that meet states beyond the time limit of training."""
        model = self.model
        here, goes = model.initial > 0, model.goes_on
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


def _at_moments(course: Callable[[float], float]) -> Floats:
    return np.array([course(1 - moment) for moment in MOMENTS])


def _course(value: Any) -> Floats | None:
    """A number or a schedule at some moments of the training; None for other values."""
    if isinstance(value, str) and value.startswith(("lin_", "exp_")):
        return _at_moments(schedule(value, for_library=False))
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


def _typed(change: Mapping[str, Any]) -> str:
    """A change as ``--test`` takes it."""
    return " ".join(f"{key}:{_text(value)}" for key, value in change.items())


def _text(value: Any) -> str:
    """A value as ``--test`` takes it, without spaces."""
    is_short = isinstance(value, float) and float(f"{value:g}") == value
    return "null" if value is None else f"{value:g}" if is_short else str(value).replace(" ", "")
