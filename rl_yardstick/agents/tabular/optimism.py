"""Optimism in the face of uncertainty: Q-learning with confidence bounds, and R-max."""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np

from rl_yardstick.agents.common.settings import (
    EPSILONS,
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    whole,
)
from rl_yardstick.agents.tabular.algorithm import TabularAlgorithm
from rl_yardstick.agents.tabular.dyna import ModelArray, ModelKeeper, ModelPolicy
from rl_yardstick.agents.tabular.updates import TabularAgent, best_value, learning_in_turn
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints


class OptimisticAlgorithm(TabularAlgorithm):
    """Takes the best action at every step, with optimistic values of pairs tried too rarely.

    Only ties are random, so there are no exploration settings. The step sizes depend on how often a
    pair was tried.

    Args:
        policy: ``"QTablePolicy"``.
        env: environment with `Discrete` observations and actions, or its id.
        gamma: discount factor.
        value_bound: upper bound on all state values, at which the table begins. By default
            1 / (1 - gamma), which is right if no reward is above 1. With a bound below a state's
            value the agent is not optimistic; a bound far above it costs time.
        tie_breaking: as in `LearningAlgorithm`.
        engine: as in `TabularAlgorithm`.
        policy_kwargs: further arguments of the policy.

    Raises:
        ValueError: if an argument is outside its range, a space does not fit, or ``gamma`` is 1
            without a ``value_bound``.
    """

    parameters = {"highest_worth": np.float64}  # noqa: RUF012
    ranges = {"value_bound": FINITE}  # noqa: RUF012
    learn_from_step = learning_in_turn
    hidden_arguments = (
        *("learning_rate", "exploration", "exploration_decay", *EPSILONS, "temperature"),
        *("noise_std", "initial_q", "initial_q_std", "skip_terminal_update"),
    )

    def __init__(self, *args: Any, value_bound: float | None = None, **kwargs: Any) -> None:
        self.value_bound = value_bound
        super().__init__(*args, exploration_decay="constant", exploration_initial_eps=0.0, **kwargs)

    def _check_arguments(self) -> None:
        if self.value_bound is None and self.gamma == 1:
            raise ValueError("value_bound has to be given where gamma is 1")
        self.initial_q = self.highest_worth
        super()._check_arguments()

    @property
    def highest_worth(self) -> float:
        """The upper bound on state values: ``value_bound``, or its default."""
        if self.value_bound is None:
            return 1.0 / (1.0 - self.gamma) if self.gamma < 1 else math.inf
        return self.value_bound


@inlined
def optimistic_update(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Move one entry towards its target plus a bonus for rare tries; return its absolute error."""
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
    return float(abs(td_error))


class QLearningUCB(OptimisticAlgorithm):
    """Q-learning with a bonus of ``bonus_scale`` / sqrt(N) in the target of a pair's N-th update.

    As in Jin et al. ("Is Q-learning provably efficient?", 2018), values of next states are clipped
    to ``value_bound``, and step sizes are (H + 1) / (H + N). As in Dong et al. ("Q-learning with
    UCB exploration is sample efficient for infinite-horizon MDP", 2020), there is a discount and
    one table for all times. Dong et al. prove for rewards in [0, 1] that, with probability 1 - p,
    the policy is within epsilon of the optimum on all steps but
    O(S A / (epsilon^2 (1 - gamma)^7)), up to logarithms. Their bonus scale is
    c sqrt(H ln(S A (N + 1) (N + 2) / p)) / (1 - gamma), far larger than useful here, and their
    values never increase. Nothing is proven for this agent. It keeps the idea of the proof: a pair
    looks better than it is until it was tried often, and so do all pairs that lead there.

    Args:
        bonus_scale: c of the bonus c / sqrt(N).
        horizon: H of the step sizes: the first estimates are forgotten after about H visits. By
            default 1 / (1 - gamma); with 0 an entry is the mean of all its targets.

    Raises:
        ValueError: as `OptimisticAlgorithm`, and if ``gamma`` is 1 without a ``horizon``.
    """

    parameters = {"bonus_scale": np.float64, "steps_remembered": np.float64}  # noqa: RUF012
    ranges = {"bonus_scale": NOT_NEGATIVE, "horizon": NOT_NEGATIVE}  # noqa: RUF012
    learn_in = optimistic_update

    def __init__(
        self, *args: Any, bonus_scale: float = 0.1, horizon: float | None = None, **kwargs: Any
    ) -> None:
        self.bonus_scale = bonus_scale
        self.horizon = horizon
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.horizon is None and self.gamma == 1:
            raise ValueError("horizon has to be given where gamma is 1")

    @property
    def steps_remembered(self) -> float:
        """H of the step sizes."""
        if self.horizon is None:
            return 1.0 / (1.0 - self.gamma) if self.gamma < 1 else math.inf
        return self.horizon


# The counts of outcomes, and planning on the model that they make.
#
# Compiled functions. Unknown pairs have the highest value.

# Changes of this share of the largest value are rounding errors, which sweeps never end.
ROUNDING = 1e-13


class CountedModel(NamedTuple):
    """The outcomes of each pair of state and action, counted until the pair is known."""

    next_obs: Ints  # next states of the distinct outcomes, shape (S, A, m)
    rewards: Floats  # sums of their rewards, shape (S, A, m)
    terminated: Bools  # whether they ended the episode, shape (S, A, m)
    tallies: Ints  # number of times each was seen, 0 for an empty place, shape (S, A, m)
    counts: Ints  # tries of the pair, at most m, shape (S, A)
    # States with a known pair, in the order in which they got one, shape (S,).
    states: Ints
    n_states: Ints  # the number of these states, shape (1,)


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
    """The value of a known pair, from the values of its next states."""
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
    """Add a state to the list when its first pair has become known."""
    n_known = 0
    for action in range(model.counts.shape[1]):
        n_known += model.counts[obs, action] == model.tallies.shape[2]
    if n_known == 1 and model.n_states[0] < len(model.states):
        model.states[model.n_states[0]] = obs
        model.n_states[0] += 1


@inlined
def sweep_states(agent: TabularAgent) -> tuple[float, float]:
    """Update all known pairs, the latest states first; return the largest change and value."""
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
    """Sweep until values are within the tolerance of the model's optimum, up to rounding.

    After a sweep that changes values by at most d, they are within d gamma / (1 - gamma) of it.
    """
    gamma = agent.settings.gamma
    while True:
        change, largest = sweep_states(agent)
        off = change * gamma / (1.0 - gamma)
        if off <= agent.settings.tolerance or change <= ROUNDING * largest:
            return


@inlined
def learn_and_replan(agent: TabularAgent, env: Any, progress: Any, i: int) -> float:
    """Count the environment's step, and plan if that makes its pair known."""
    model, obs, action = agent.memory, env.obs, env.action
    following = 0.0 if env.terminated else best_value(agent.tables, env.next_obs, agent.room)
    target = env.reward + agent.settings.gamma * following
    error = abs(target - agent.tables.values[0, obs, action])
    agent.tables.visit_counts[0, obs, action] += 1
    if model.counts[obs, action] < model.tallies.shape[2]:
        count_outcome(model, env)
        if model.counts[obs, action] == model.tallies.shape[2]:
            note_known_state(model, obs)
            replan(agent)
    return float(error)


class CountedModelPolicy(ModelPolicy):
    """The policy of R-max."""

    model_type: ClassVar[Any] = CountedModel

    def _arrays(self) -> dict[str, ModelArray]:
        n_states, n_actions = self.visit_counts.shape[1:]
        n = self.outcomes_kept
        return {
            **super()._arrays(),
            "tallies": ModelArray((n_states, n_actions, n), n + 1),
            "counts": ModelArray((n_states, n_actions), n + 1),
            "states": ModelArray((n_states,), n_states),
            "n_states": ModelArray((1,), n_states + 1),
        }

    def check_places(self) -> None:
        """Raise ValueError for a model with indices out of range or inconsistent counts."""
        super().check_places()
        if not np.array_equal(self.model.tallies.sum(axis=2), self.model.counts):
            raise ValueError("holds no counts: model_tallies and model_counts disagree")


class RMax(ModelKeeper, OptimisticAlgorithm):
    """R-max (Brafman and Tennenholtz, 2002): optimism about unknown pairs.

    A pair of state and action is known after ``known_after`` tries; from then on the model has the
    outcomes seen so far, and counts no more. Unknown pairs have the value ``value_bound`` (in the
    paper they lead to a state with the highest reward for ever). Whenever a pair becomes known,
    the agent computes the optimum of the model again, by sweeps over the states with known pairs.
    The optimal policy of the model either has a nearly optimal return, or reaches an unknown pair.

    With enough tries it is probably approximately correct: for rewards in [0, 1], with probability
    1 - p, its policy is more than epsilon worse than the optimum on at most
    O(S^2 A / (epsilon^3 (1 - gamma)^6)) steps, up to logarithms (Strehl, Li and Littman,
    "Reinforcement learning in finite MDPs: PAC analysis", 2009; Kakade, 2003). The ``known_after``
    of that proof, of the order of S / (epsilon^2 (1 - gamma)^4), is far larger than useful here. In
    deterministic environments, one try is enough.

    Planning is done once for each pair, and takes longer if ``gamma`` is closer to 1.

    Args:
        known_after: m, the number of tries after which a pair is known.
        tolerance: maximal distance of values from the optimum of the model.

    Raises:
        ValueError: as `OptimisticAlgorithm`, and if ``gamma`` is 1.
    """

    policy_aliases = {"QTablePolicy": CountedModelPolicy}  # noqa: RUF012
    parameters = {"tolerance": np.float64}  # noqa: RUF012
    ranges = {"known_after": whole(1), "tolerance": POSITIVE}  # noqa: RUF012
    learn_in = learn_and_replan

    def __init__(
        self, *args: Any, known_after: int = 10, tolerance: float = 1e-4, **kwargs: Any
    ) -> None:
        self.known_after = known_after
        self.tolerance = tolerance
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if self.gamma == 1:
            raise ValueError("gamma must be below 1: with 1, planning would not end")

    @property
    def outcomes_kept(self) -> int:  # type: ignore[override]
        """The largest number of distinct outcomes of a pair."""
        return self.known_after
