"""Optimism in the face of uncertainty: Q-learning with confidence bounds, and R-max."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Unpack

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv

from agents.common.settings import (
    TieBreaking,
    check_above_zero,
    check_at_least,
    check_finite,
    check_share,
    check_whole,
    settings_of,
)
from agents.compiled.engine import EngineChoice
from agents.tabular.algorithm import MaskedArguments, TabularAlgorithm
from agents.tabular.dyna import ModelKeeper, ModelPolicy
from agents.tabular.updates import TabularAgent, best_value
from machine_code.compiling import inlined
from mdp.transition_model import Bools, Floats, Ints

# What agents share that explore by optimism: a table that begins at the most that can be.


class OptimisticAlgorithm(TabularAlgorithm):
    """Takes the best action at every step, and what it knows too little of for very good.

    Nothing is left to chance but ties, so that there is no exploration to set, and the step sizes
    follow from how often a pair was tried.

    Args:
        policy: ``"QTablePolicy"``.
        env: environment with `Discrete` observations and actions, or its id.
        gamma: discount factor.
        value_bound: the most that any state can be worth, at which the table begins. By default
            1 / (1 - gamma), which is right where no reward is above 1. Below what a state is worth
            it is optimism no more; far above it costs time.
        tie_breaking: as in `LearningAlgorithm`.
        engine: as in `TabularAlgorithm`.
        policy_kwargs: further arguments of the policy.
        kwargs: as in `TabularAlgorithm`.

    Raises:
        ValueError: if an argument lies outside its range, a space does not fit, or ``gamma`` is 1
            and there is no ``value_bound``.
    """

    parameters = {"highest_worth": np.float64}  # noqa: RUF012

    def __init__(
        self,
        policy: str | type[BasePolicy] = "QTablePolicy",
        env: GymEnv | str | None = None,
        gamma: float = 0.99,
        value_bound: float | None = None,
        tie_breaking: TieBreaking = "random",
        engine: EngineChoice = "auto",
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Unpack[MaskedArguments],
    ) -> None:
        self.value_bound = value_bound
        super().__init__(
            policy,
            env,
            gamma=gamma,
            exploration_decay="constant",
            exploration_initial_eps=0.0,
            tie_breaking=tie_breaking,
            engine=engine,
            policy_kwargs=policy_kwargs,
            **kwargs,
        )

    def _check_arguments(self) -> None:
        check_share(settings_of(self, "gamma"))
        if self.value_bound is not None:
            check_finite(settings_of(self, "value_bound"))
        elif self.gamma == 1:
            raise ValueError("value_bound has to be given where gamma is 1")
        self.initial_q = self.highest_worth
        super()._check_arguments()

    @property
    def highest_worth(self) -> float:
        """What no state is worth more than."""
        if self.value_bound is None:
            return 1.0 / (1.0 - self.gamma) if self.gamma < 1 else math.inf
        return self.value_bound


# Q-learning with upper confidence bounds.


@inlined
def optimistic_update(agent: TabularAgent, env: Any) -> float:
    """Move one entry towards its target and a bonus for what is seldom tried; its TD error."""
    settings, tables = agent.settings, agent.tables
    tables.visit_counts[0, env.obs, env.action] += 1
    count = tables.visit_counts[0, env.obs, env.action]
    target = env.reward + settings.bonus_scale / math.sqrt(count)
    if not env.terminated:
        best = best_value(tables, env.next_obs, agent.room)
        target += settings.gamma * min(best, settings.highest_worth)
    size = (settings.steps_remembered + 1.0) / (settings.steps_remembered + count)
    td_error = target - tables.values[0, env.obs, env.action]
    tables.values[0, env.obs, env.action] += size * td_error
    return float(td_error)


@inlined
def learn_with_bonus(agent: TabularAgent, envs: Any, progress: Any) -> None:
    """An update for each environment, in order."""
    total_error = 0.0
    for i in range(len(envs)):
        total_error += abs(optimistic_update(agent, envs[i]))
        envs[i].obs = envs[i].new_obs
    progress.mean_td_error = total_error / len(envs)


class QLearningUCB(OptimisticAlgorithm):
    """Q-learning with a bonus of ``bonus_scale`` / sqrt(N) in the target of a pair's N-th update.

    As Jin and others have it ("Is Q-learning provably efficient?", 2018), next states count for
    ``value_bound`` at most, and step sizes are (H + 1) / (H + N). As in Dong and others
    ("Q-learning with UCB exploration is sample efficient for infinite-horizon MDP", 2020), it
    discounts and has one table for all times. They prove that for rewards in [0, 1], with
    probability 1 - p, the policy is within epsilon of the best on all steps but
    O(S A / (epsilon^2 (1 - gamma)^7)), up to logarithms: with a scale of
    c sqrt(H ln(S A (N + 1) (N + 2) / p)) / (1 - gamma), which is far more than what serves here,
    and with values that never rise again. For this agent nothing is proven; what it keeps is why
    that works: a pair looks better than it is until it was tried often, and so does all that leads
    there.

    Args:
        args: as in `OptimisticAlgorithm`.
        bonus_scale: c of the bonus c / sqrt(N).
        horizon: H of the step sizes: the first estimates are forgotten after some H visits. By
            default 1 / (1 - gamma); 0 makes the mean of all targets.
        kwargs: as in `OptimisticAlgorithm`.

    Raises:
        ValueError: as `OptimisticAlgorithm`, and if ``gamma`` is 1 and there is no ``horizon``.
    """

    parameters = {"bonus_scale": np.float64, "steps_remembered": np.float64}  # noqa: RUF012
    learn_from_step = learn_with_bonus

    def __init__(
        self, *args: Any, bonus_scale: float = 0.1, horizon: float | None = None, **kwargs: Any
    ) -> None:
        self.bonus_scale = bonus_scale
        self.horizon = horizon
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_at_least(0.0, settings_of(self, "bonus_scale", "horizon"))
        check_finite(settings_of(self, "bonus_scale"))
        if self.horizon is not None:
            check_finite(settings_of(self, "horizon"))
        elif self.gamma == 1:
            raise ValueError("horizon has to be given where gamma is 1")

    @property
    def steps_remembered(self) -> float:
        """H of the step sizes."""
        if self.horizon is None:
            return 1.0 / (1.0 - self.gamma) if self.gamma < 1 else math.inf
        return self.horizon


# What an agent has counted of its environment, and what is best if that is all there is to it.
#
# Compiled functions. What is not known is as good as can be.

# Of the largest value: what one sweep after the other goes on changing by rounding.
ROUNDING = 1e-13


class CountedModel(NamedTuple):
    """How often each pair of state and action had which outcome, until it is known."""

    next_obs: Ints  # the outcomes that differ: where they led, shape (S, A, m)
    rewards: Floats  # what they earned together, shape (S, A, m)
    terminated: Bools  # whether they ended the episode, shape (S, A, m)
    tallies: Ints  # how often they were seen, 0 where there is none, shape (S, A, m)
    counts: Ints  # how often the pair was tried, at most m, shape (S, A)
    # Those in which something is known, in the order in which it became so, shape (S,).
    states: Ints
    n_states: Ints  # how many these are, shape (1,)


@inlined
def count_outcome(model: CountedModel, env: Any) -> None:
    """Count the environment's last step among the outcomes of its pair."""
    obs, action, k = env.obs, env.action, 0
    while model.tallies[obs, action, k] > 0 and (
        model.next_obs[obs, action, k] != env.next_obs
        or model.terminated[obs, action, k] != env.terminated
    ):
        k += 1
    model.next_obs[obs, action, k] = env.next_obs
    model.terminated[obs, action, k] = env.terminated
    model.rewards[obs, action, k] += env.reward
    model.tallies[obs, action, k] += 1
    model.counts[obs, action] += 1


@inlined
def known_value(agent: TabularAgent, obs: int, action: int) -> float:
    """What a known pair is worth by the values of the states that it led to."""
    model = agent.memory
    total = 0.0
    for k in range(model.tallies.shape[2]):
        tally = model.tallies[obs, action, k]
        if tally == 0:
            break
        total += model.rewards[obs, action, k]
        if not model.terminated[obs, action, k]:
            following = best_value(agent.tables, model.next_obs[obs, action, k], agent.room)
            total += agent.settings.gamma * tally * following
    return float(total / model.counts[obs, action])


@inlined
def note_known_state(model: CountedModel, obs: int) -> None:
    """List a state in which a first pair has become known."""
    n_known = 0
    for action in range(model.counts.shape[1]):
        n_known += model.counts[obs, action] == model.tallies.shape[2]
    if n_known == 1 and model.n_states[0] < len(model.states):
        model.states[model.n_states[0]] = obs
        model.n_states[0] += 1


@inlined
def sweep_states(agent: TabularAgent) -> tuple[float, float]:
    """Work out all known pairs anew, the latest states first."""
    model, values = agent.memory, agent.tables.values
    change = largest = 0.0
    for i in range(model.n_states[0] - 1, -1, -1):
        obs = model.states[i]
        for action in range(values.shape[2]):
            if model.counts[obs, action] == model.tallies.shape[2]:
                value = known_value(agent, obs, action)
                change = max(change, abs(value - values[0, obs, action]))
                largest = max(largest, abs(value))
                values[0, obs, action] = value
    return change, largest


@inlined
def replan(agent: TabularAgent) -> None:
    """Sweep until values are within the tolerance of the model's optimum, or rounding is left.

    A sweep that changes them by d leaves them within d gamma / (1 - gamma) of it.
    """
    gamma = agent.settings.gamma
    while True:
        change, largest = sweep_states(agent)
        off = change * gamma / (1.0 - gamma)
        if off <= agent.settings.tolerance or change <= ROUNDING * largest:
            return


# R-max.


@inlined
def learn_and_replan(agent: TabularAgent, envs: Any, progress: Any) -> None:
    """For each environment, in order: count its step, and plan if that makes its pair known."""
    model, total_error = agent.memory, 0.0
    for i in range(len(envs)):
        env = envs[i]
        following = 0.0 if env.terminated else best_value(agent.tables, env.next_obs, agent.room)
        target = env.reward + agent.settings.gamma * following
        total_error += abs(target - agent.tables.values[0, env.obs, env.action])
        agent.tables.visit_counts[0, env.obs, env.action] += 1
        if model.counts[env.obs, env.action] < model.tallies.shape[2]:
            count_outcome(model, env)
            if model.counts[env.obs, env.action] == model.tallies.shape[2]:
                note_known_state(model, env.obs)
                replan(agent)
        env.obs = env.new_obs
    progress.mean_td_error = total_error / len(envs)


class CountedModelPolicy(ModelPolicy):
    """The policy of R-max."""

    model_type: ClassVar[Any] = CountedModel

    def _nothing_learnt(self, n_states: int, n_actions: int, n: int) -> dict[str, Any]:
        arrays = super()._nothing_learnt(n_states, n_actions, n)
        del arrays["pairs"], arrays["n_pairs"]
        return {
            **arrays,
            "tallies": np.zeros((n_states, n_actions, n), dtype=np.int64),
            "states": np.zeros(n_states, dtype=np.int64),
            "n_states": np.zeros(1, dtype=np.int64),
        }

    def _places(self, n_states: int, n_pairs: int) -> Mapping[str, tuple[int, int]]:
        most = self.outcomes_kept + 1
        limits = {"states": (0, n_states), "n_states": (0, n_states + 1)}
        return {"next_obs": (0, n_states), "counts": (0, most), "tallies": (0, most), **limits}

    def check_places(self) -> None:
        """Refuse a model that points beside its tables, or whose counts are none."""
        super().check_places()
        if not np.array_equal(self.model.tallies.sum(axis=2), self.model.counts):
            raise ValueError("holds no counts: model_tallies and model_counts disagree")


class RMax(ModelKeeper, OptimisticAlgorithm):
    """R-max (Brafman and Tennenholtz, 2002): what is not known is as good as can be.

    A pair of state and action is known once it was tried ``known_after`` times; from then on its
    outcomes are taken to be what was seen, and no longer counted. Pairs that are not known are
    worth ``value_bound`` (in the paper they lead to a state that earns the most for ever). Whenever
    a pair becomes known, the optimum of that model is worked out anew, by sweeps over the states in
    which something is known. The agent does what is best in it, and so either earns nearly the most
    that can be earned, or comes to what it does not know.

    With enough tries it is probably approximately correct: of rewards in [0, 1], with probability
    1 - p, it does worse than within epsilon of the best on at most
    O(S^2 A / (epsilon^3 (1 - gamma)^6)) steps, up to logarithms (Strehl, Li and Littman,
    "Reinforcement learning in finite MDPs: PAC analysis", 2009; Kakade, 2003). The ``known_after``
    of that proof, in the order of S / (epsilon^2 (1 - gamma)^4), is far more than what serves here.
    Where nothing is random, one try is enough.

    Planning takes the longer the closer ``gamma`` is to 1, and is done once for each pair.

    Args:
        args: as in `OptimisticAlgorithm`.
        known_after: m, the number of tries after which a pair is known.
        tolerance: how far values may be from the optimum of the model.
        kwargs: as in `OptimisticAlgorithm`.

    Raises:
        ValueError: as `OptimisticAlgorithm`, and if ``gamma`` is 1.
    """

    policy_aliases = {"QTablePolicy": CountedModelPolicy}  # noqa: RUF012
    parameters = {"tolerance": np.float64}  # noqa: RUF012
    learn_from_step = learn_and_replan

    def __init__(
        self, *args: Any, known_after: int = 10, tolerance: float = 1e-4, **kwargs: Any
    ) -> None:
        self.known_after = known_after
        self.tolerance = tolerance
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.gamma == 1:
            raise ValueError("gamma must be below 1, so that planning comes to an end")
        check_whole(1, settings_of(self, "known_after"))
        check_above_zero(settings_of(self, "tolerance"))
        check_finite(settings_of(self, "tolerance"))

    @property
    def outcomes_kept(self) -> int:  # type: ignore[override]
        """Room for as many outcomes as a pair can have had."""
        return self.known_after
