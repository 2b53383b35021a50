"""n-step methods against their formulas, and against the one-step agents that they extend."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm
from agents.common.exploration import EPSILON_GREEDY, action_probabilities
from tests.agents.hand_fed import ENDS, SHARES, Fed, episodes, greedy, tables

GAMMA, ALPHA = 0.75, 0.25


def textbook_table(table, steps, end, n, ahead, backed_up):
    """The table after an episode that ends in state 0, by the boxes of chapter 7.

    Args:
        ahead: value of (table, state, action), where a target ends.
        backed_up: value of (table, state, action, later return), where it goes on.
    """
    table, total = np.array(table, dtype=float), len(steps)
    for time in range(total + n - 1):
        if time == total - 1:
            last = 0, greedy(table, 0)
        start = time - n + 1
        if start < 0:
            continue
        stop = min(start + n, total)
        later = 0.0
        if stop < total or end == "truncated":
            later = ahead(table, *(steps[stop][:2] if stop < total else last))
        for k in range(stop - 1, start - 1, -1):
            if k < stop - 1:
                later = backed_up(table, *steps[k + 1][:2], later)
            later = steps[k][2] + GAMMA * later
        table[steps[start][:2]] += ALPHA * (later - table[steps[start][:2]])
    return table


def entry(table, state, action):
    return table[state, action]


def sampled(table, state, action, later):
    return later


@given(table=tables(), steps=episodes(), end=ENDS, n=st.integers(1, 5))
def test_n_step_sarsa(table, steps, end, n):
    fed = Fed("n_step_sarsa", table, learning_rate=ALPHA, gamma=GAMMA, n_steps=n)
    for _ in range(2):  # nothing is left over from the first episode
        before = fed.table.copy()
        taken = fed.committed_episode(steps, end)
        expected = textbook_table(before, taken, end, n, entry, sampled)
        np.testing.assert_allclose(fed.table, expected, rtol=0, atol=1e-12)


@settings(max_examples=50)
@given(table=tables(), steps=episodes(), end=ENDS, n=st.integers(1, 5), epsilon=SHARES)
@pytest.mark.parametrize("target_policy", ["exploring", "greedy"])
def test_tree_backup(table, steps, end, n, epsilon, target_policy):
    def policy(table, state):
        if target_policy == "greedy":
            # Tied actions are worth the same: any share of them gives the same mean.
            return np.eye(len(table[state]))[greedy(table, state)]
        return action_probabilities(EPSILON_GREEDY, table, epsilon, random_ties=False)[state]

    def mean(table, state, action):
        return policy(table, state) @ table[state]

    def tree(table, state, action, later):
        shares = policy(table, state)
        if target_policy == "greedy" and table[state, action] == table[state].max():
            shares = np.eye(len(shares))[action]
        leaves = [shares[b] * table[state, b] for b in range(len(shares)) if b != action]
        return sum(leaves) + shares[action] * later

    fed = Fed(
        "n_step_tree_backup",
        table,
        epsilon,
        learning_rate=ALPHA,
        gamma=GAMMA,
        n_steps=n,
        target_policy=target_policy,
    )
    for _ in range(2):
        expected = textbook_table(fed.table, steps, end, n, mean, tree)
        fed.episode(steps, end)
        np.testing.assert_allclose(fed.table, expected, rtol=0, atol=1e-12)


def test_two_steps_by_hand():
    # 1 + .5 * 2 + .25 * Q(2, 0) = 2 + .25 * 8 = 4, half-way from 10 on: 7.
    table = [[10, 0], [0, 0], [8, 0]]
    fed = Fed("n_step_sarsa", table, learning_rate=0.5, gamma=0.5, n_steps=2)
    fed.step(0, 0, 1, 1)
    assert fed.table.tolist() == table
    assert fed.agent.mean_td_error == 0
    assert fed.step(1, 0, 2, 2)[0, 0] == 7
    assert fed.agent.mean_td_error == 6
    # The end: 2 + .5 * 4 = 4 from state 1 on, half-way from 0 on; 4 from state 2 on.
    assert fed.step(2, 0, 4, 0, "terminated").tolist() == [[7, 0], [2, 0], [6, 0]]
    # Another episode's first step is not learnt from: the last errors, 4 and 4, go on standing.
    fed.step(0, 0, 1, 1)
    assert fed.agent.mean_td_error == 4
    # A greedy tree: in state 1 action 1 is best with 6, so that action 0 tells nothing beyond.
    table = [[10, 0], [0, 6], [8, 0]]
    fed = Fed(
        "n_step_tree_backup",
        table,
        learning_rate=0.5,
        gamma=0.5,
        n_steps=2,
        target_policy="greedy",
    )
    fed.step(0, 0, 1, 1)
    assert fed.step(1, 0, 2, 2)[0, 0] == 10 + 0.5 * (1 + 0.5 * 6 - 10)


def trained(name, n_envs, **kwargs):
    env = make_vec_env("envs:Warehouse-v0", n_envs, seed=3, env_kwargs={"slip": 0.2})
    return load_algorithm(name)(env=env, seed=1, **kwargs).learn(4000)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize(
    ("name", "one_step", "settings_"),
    [
        ("n_step_sarsa", "sarsa", {"exploration": "gaussian_noise"}),
        ("n_step_tree_backup", "expected_sarsa", {"exploration": "boltzmann"}),
        ("n_step_tree_backup", "qlearning", {"target_policy": "greedy"}),
    ],
)
def test_one_step_is_the_one_step_agent(name, one_step, settings_, n_envs):
    rest = {key: value for key, value in settings_.items() if key != "target_policy"}
    model = trained(name, n_envs, n_steps=1, **settings_)
    other = trained(one_step, n_envs, **rest)
    assert np.array_equal(model.policy.q_table, other.policy.q_table)
    assert np.array_equal(model.policy.visit_counts, other.policy.visit_counts)
    assert model.mean_td_error == other.mean_td_error
    assert model.rng.bit_generator.state == other.rng.bit_generator.state


@pytest.mark.parametrize("name", ["n_step_sarsa", "n_step_tree_backup"])
def test_prediction_on_the_random_walk(name):
    """Example 6.2: the true values of its five states are 1/6 to 5/6."""
    env = make_vec_env("envs:RandomWalk-v0", seed=0)
    average = {"gamma": 1.0, "learning_rate": "sample_average", "n_steps": 3}
    model = load_algorithm(name)(env=env, seed=0, **average).learn(100_000)
    # Over 10,000 episodes a mean of returns of 0 and 1 has a standard error below 0.005.
    np.testing.assert_allclose(model.policy.q_table[1:-1, 0], np.arange(1, 6) / 6, atol=0.02)


def test_refusals():
    agent = load_algorithm("n_step_tree_backup")
    for n_steps in (0, 1.5, True, "4"):
        with pytest.raises(ValueError, match="n_steps must be a whole number of at least 1, not"):
            agent(env="FrozenLake-v1", n_steps=n_steps)
    with pytest.raises(ValueError, match="target_policy: exploring needs the probabilities"):
        agent(env="FrozenLake-v1", exploration="gaussian_noise")
    agent(env="FrozenLake-v1", exploration="gaussian_noise", target_policy="greedy")
    with pytest.raises(ValueError, match="skip_terminal_update is for the agents that learn from"):
        agent(env="FrozenLake-v1", skip_terminal_update=True)
    with pytest.raises(ValueError, match="n_steps must be at most 25000000, not 25000001"):
        agent(env=make_vec_env("FrozenLake-v1", 2), n_steps=25_000_001)
