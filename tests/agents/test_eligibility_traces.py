"""Traces against the book's boxes, the online lambda-return, Monte Carlo, and one-step agents."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.tabular.traces import SMALLEST_TRACE
from tests.agents.hand_fed import (
    ACTIONS,
    ENDS,
    N_STATES,
    REWARDS,
    SHARES,
    Fed,
    episodes,
    greedy,
    tables,
)

GAMMA, ALPHA = 0.75, 0.25
NAMES = ("sarsa_lambda", "q_lambda")


def ahead(table, steps, k, end):
    """What the step after the k-th is worth; both agents take a best action's value here."""
    if k + 1 < len(steps):
        return table[steps[k + 1][0]].max()
    return table[0].max() if end == "truncated" else 0.0


def is_cut(name, table, state, action):
    return name == "q_lambda" and table[state, action] < table[state].max()


def by_the_box(name, table, steps, end, decay, trace_type):
    """The table after an episode, with a trace for each entry."""
    table = np.array(table, dtype=float)
    traces = np.zeros_like(table)
    for k, (state, action, reward) in enumerate(steps):
        traces *= 0.0 if is_cut(name, table, state, action) else GAMMA * decay
        traces[state, action] = 1 + (trace_type == "accumulating") * traces[state, action]
        td_error = reward + GAMMA * ahead(table, steps, k, end) - table[state, action]
        table += ALPHA * td_error * traces
    return table


def lambda_return(steps, values, decay, start, horizon):
    """From step ``start``, with values of the states after each step, up to the horizon."""
    total, discounted, weight = 0.0, 0.0, 1.0
    for k in range(start, horizon):
        discounted += GAMMA ** (k - start) * steps[k][2]
        target = discounted + GAMMA ** (k - start + 1) * values[k]
        is_last = k == horizon - 1
        total += weight * (1.0 if is_last else 1.0 - decay) * target
        weight *= decay
    return total


def by_online_lambda_returns(name, table, steps, end, decay, step_sizes):
    """The table after an episode, all of whose updates are done anew at each step.

    After a cut only what follows it is done anew.
    """
    now = np.array(table, dtype=float)
    first, start, values = 0, now.copy(), []
    for k, (state, action, _) in enumerate(steps):
        if is_cut(name, now, state, action):
            first, start = k, now.copy()
        values.append(ahead(now, steps, k, end))
        now = start.copy()
        for j in range(first, k + 1):
            error = lambda_return(steps, values, decay, j, k + 1) - now[steps[j][:2]]
            now[steps[j][:2]] += step_sizes[j] * error
    return now


def taken_by(fed, name, steps, end):
    if name == "sarsa_lambda":
        return fed.committed_episode(steps, end)
    fed.episode(steps, end)
    return steps


@settings(max_examples=50)
@given(table=tables(), steps=episodes(), end=ENDS, decay=SHARES)
@pytest.mark.parametrize("trace_type", ["accumulating", "replacing"])
@pytest.mark.parametrize("name", NAMES)
def test_traces_of_the_box(name, trace_type, table, steps, end, decay):
    settings_ = {"learning_rate": ALPHA, "gamma": GAMMA, "trace_decay": decay}
    fed = Fed(name, table, trace_type=trace_type, **settings_)
    for _ in range(2):  # nothing is left over from the first episode
        before = fed.table.copy()
        taken = taken_by(fed, name, steps, end)
        expected = by_the_box(name, before, taken, end, decay, trace_type)
        np.testing.assert_allclose(fed.table, expected, rtol=0, atol=1e-9)


@settings(max_examples=50)
@given(table=tables(), steps=episodes(), end=ENDS, decay=SHARES)
# With a step size of 3 traces become negative.
@pytest.mark.parametrize("learning_rate", [ALPHA, 3.0, "sample_average"])
@pytest.mark.parametrize("name", NAMES)
def test_dutch_traces_are_the_online_lambda_return(name, learning_rate, table, steps, end, decay):
    settings_ = {"learning_rate": learning_rate, "gamma": GAMMA, "trace_decay": decay}
    fed = Fed(name, table, trace_type="dutch", **settings_)
    counts = fed.agent.policy.visit_counts.numpy()[0]
    for _ in range(2):
        before, visits, step_sizes = fed.table.copy(), counts.copy(), []
        taken = taken_by(fed, name, steps, end)
        for state, action, _ in taken:
            visits[state, action] += 1
            step_sizes.append(
                1 / visits[state, action] if learning_rate == "sample_average" else learning_rate
            )
        expected = by_online_lambda_returns(name, before, taken, end, decay, step_sizes)
        np.testing.assert_allclose(fed.table, expected, rtol=1e-9, atol=1e-9)


@given(
    table=tables(),
    states=st.permutations(range(N_STATES)),
    action=ACTIONS,
    rewards=st.lists(REWARDS, min_size=N_STATES, max_size=N_STATES),
)
@pytest.mark.parametrize("trace_type", ["accumulating", "replacing", "dutch"])
def test_whole_traces_are_monte_carlo(trace_type, table, states, action, rewards):
    """Where no entry is visited twice, learning on the way comes to the same."""
    settings_ = {"learning_rate": ALPHA, "gamma": GAMMA}
    fed = Fed("sarsa_lambda", table, trace_type=trace_type, trace_decay=1.0, **settings_)
    steps = [(state, action, reward) for state, reward in zip(states, rewards, strict=True)]
    taken = fed.committed_episode(steps, "terminated")
    other = Fed("monte_carlo", table, **settings_)
    other.episode(taken, "terminated")
    np.testing.assert_allclose(fed.table, other.table, rtol=0, atol=1e-12)


@given(table=tables(), steps=episodes())
def test_whole_traces_add_up_to_every_visit_monte_carlo_of_a_frozen_table(table, steps):
    table = np.array(table, dtype=float)
    fed = Fed("sarsa_lambda", table, learning_rate=ALPHA, gamma=GAMMA, trace_decay=1.0)
    fed.agent.trace_type = "accumulating"
    changes, taken = np.zeros_like(table), []
    for k, (state, action, reward) in enumerate(steps):
        taken.append((state, action if k == 0 else greedy(table, state), reward))
        is_last = k == len(steps) - 1
        next_obs = 0 if is_last else steps[k + 1][0]
        changes += fed.step(*taken[-1], next_obs, "terminated" if is_last else "") - table
        fed.table[:] = table
    expected, later = np.zeros_like(table), 0.0
    for state, action, reward in reversed(taken):
        later = reward + GAMMA * later
        expected[state, action] += ALPHA * (later - table[state, action])
    np.testing.assert_allclose(changes, expected, rtol=0, atol=1e-12)


def test_watkins_cut_by_hand():
    # Greedy in state 0, and then in state 1 not: only that entry learns of what follows.
    fed = Fed("q_lambda", [[4, 0], [0, 8]], learning_rate=0.5, gamma=0.5, trace_decay=1.0)
    # 2 + .5 * 8 - 4 = 2, half of it.
    assert fed.step(0, 0, 2, 1).tolist() == [[5, 0], [0, 8]]
    assert fed.step(1, 0, 6, 0, "terminated").tolist() == [[5, 0], [3, 8]]
    # And where it is greedy: 6 - 8 = -2, half of it, and half of that for state 0.
    fed = Fed("q_lambda", [[4, 0], [0, 8]], learning_rate=0.5, gamma=0.5, trace_decay=1.0)
    fed.step(0, 0, 2, 1)
    assert fed.step(1, 1, 6, 0, "terminated").tolist() == [[4.5, 0], [0, 7]]


def test_a_trace_that_has_faded_is_forgotten():
    fed = Fed("sarsa_lambda", np.zeros((4, 3)), learning_rate=1.0, gamma=1.0, trace_decay=0.02)
    lengths = []
    for k in range(11):
        fed.step(k % 4, k % 3, 1, (k + 1) % 4)
        lengths.append(int(fed.agent._memory.lengths[0]))
    assert 0.02**8 < SMALLEST_TRACE < 0.02**7
    assert lengths == [1, 2, 3, 4, 5, 6, 7, 8, 8, 8, 8]


def trained(name, n_envs, **kwargs):
    env = make_vec_env("envs:Warehouse-v0", n_envs, seed=3, env_kwargs={"slip": 0.2})
    return load_algorithm(name)(env=env, seed=1, **kwargs).learn(4000)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("trace_type", ["accumulating", "replacing", "dutch"])
@pytest.mark.parametrize(
    ("name", "one_step"), [("sarsa_lambda", "sarsa"), ("q_lambda", "qlearning")]
)
def test_without_traces_it_is_the_one_step_agent(name, one_step, trace_type, n_envs):
    model = trained(name, n_envs, trace_decay=0.0, trace_type=trace_type)
    other = trained(one_step, n_envs)
    assert np.array_equal(model.policy.q_table, other.policy.q_table)
    assert model.mean_td_error == other.mean_td_error
    assert model.rng.bit_generator.state == other.rng.bit_generator.state


def test_refusals():
    agent = load_algorithm("sarsa_lambda")
    with pytest.raises(ValueError, match="trace_type must be one of accumulating, replacing, dut"):
        agent(env="FrozenLake-v1", trace_type="green")
    with pytest.raises(ValueError, match=r"trace_decay must lie between 0 and 1, not 1\.1"):
        agent(env="FrozenLake-v1", trace_decay=1.1)
    with pytest.raises(ValueError, match="skip_terminal_update is for the agents that learn from"):
        agent(env="FrozenLake-v1", skip_terminal_update=True)
