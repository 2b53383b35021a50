"""What an agent has counted of its environment, and what is best if that is all there is to it.

Compiled functions. What is not known is as good as can be.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from agents.tabular.temporal_difference import TabularAgent
from agents.tabular.value_tables import best_value
from machine_code.compiling import inlined
from mdp.array_types import Bools, Floats, Ints

# Of the largest value: what one sweep after the other goes on changing by rounding.
ROUNDING = 1e-13


class CountedModel(NamedTuple):
    """How often each pair of state and action had which outcome, until it is known.

    Attributes:
        next_obs: the outcomes that differ: where they led, shape (S, A, m).
        rewards: what they earned together, shape (S, A, m).
        terminated: whether they ended the episode, shape (S, A, m).
        tallies: how often they were seen, 0 where there is none, shape (S, A, m).
        counts: how often the pair was tried, at most m, shape (S, A).
        states: those in which something is known, in the order in which it became so, shape (S,).
        n_states: how many these are, shape (1,).
    """

    next_obs: Ints
    rewards: Floats
    terminated: Bools
    tallies: Ints
    counts: Ints
    states: Ints
    n_states: Ints


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
    """Work out all known pairs anew, the latest states first.

    Returns:
        The largest change of a value, and the largest value without its sign.
    """
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
